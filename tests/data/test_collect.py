from __future__ import annotations

import json
import logging
import multiprocessing.connection
import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from toy_world import (
    DYING,
    FAILING,
    FIXED,
    HANGING,
    VARIABLE,
    ToyEnv,
    data_bytes,
    fixed_length,
    run_in_order,
    variable_length,
)
from toy_world import collection_request as request

from crptpro.data import FrameDataset, collect_group, collect_random
from crptpro.data.collect_worker import EpisodeRoller
from crptpro.data.collection import DomainCollection
from crptpro.data.incoming import INCOMING, dataset_path, write_incoming
from crptpro.errors import CRPTproError, DatasetError, DiskSpaceError, RenderingError, WorkerLostError
from crptpro.seeding import derive_seed

HERE = Path(__file__).parent
SMALL = {"image_size": 8, "progress": False}


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """Two domains, one with episodes of unknown length, by one process."""
    return collect_group([FIXED, VARIABLE], tmp_path_factory.mktemp("one"), transitions=65, seed=3, **SMALL)


def test_the_number_of_workers_does_not_change_the_data(collected, tmp_path):
    again = collect_group([VARIABLE, FIXED], tmp_path, transitions=65, seed=3, workers=2, **SMALL)
    for name, path in collected.items():
        assert data_bytes(again[name]) == data_bytes(path)


def test_an_episode_is_what_its_seeds_say(collected):
    dataset = FrameDataset.open(collected["toy-variable"])
    env = ToyEnv(lambda seed: 3 + seed % 9, seed=derive_seed(3, "collect", "toy-variable", 2))
    env.reset()
    torch.manual_seed(derive_seed(3, "collect-actions", "toy-variable", 2))
    inside = dataset.transitions["episode"] == 2
    rollout = env.rollout(100)  # draws its actions as RandomPolicy does
    assert torch.equal(dataset[inside]["action"], rollout["action"])
    assert torch.equal(dataset[inside]["next", "pixels"][:, -3:], rollout["next", "pixels"])


def test_the_last_episode_is_cut_to_the_transitions_asked_for(collected):
    dataset = FrameDataset.open(collected["toy-fixed"])
    assert len(dataset) == 65
    assert dataset.card["last_episode_cut"]
    assert dataset.card["episodes"] == 7
    last = dataset[-1]
    assert (last["step"].item(), last["next", "truncated"].item(), last["next", "terminated"].item()) == (
        4,
        True,
        False,
    )
    natural = dataset[9]
    assert natural["next", "truncated"].item()
    dataset.verify()


def test_actions_are_uniform(collected):
    actions = FrameDataset.open(collected["toy-fixed"]).transitions["action"]
    assert actions.abs().max() <= 1
    assert actions.mean().abs() < 0.2
    assert ((actions**2).mean() - 1 / 3).abs() < 0.1


def test_physics_is_stored_beside_each_frame(collected):
    dataset = FrameDataset.open(collected["toy-fixed"])
    physics = dataset.physics_at(torch.arange(11))
    assert physics["qpos"][:, 0].tolist() == list(range(11))
    assert physics["qvel"].unique().item() == derive_seed(3, "collect", "toy-fixed", 0)


def test_a_complete_dataset_is_returned_as_it_is(collected, caplog):
    written = {path: path.stat().st_mtime_ns for path in collected["toy-fixed"].rglob("*")}
    with caplog.at_level(logging.INFO, "crptpro"):
        again = collect_group([FIXED], collected["toy-fixed"].parent, transitions=65, seed=3, **SMALL)
    assert {path: path.stat().st_mtime_ns for path in collected["toy-fixed"].rglob("*")} == written
    assert again == {"toy-fixed": collected["toy-fixed"]}
    assert "is complete" in caplog.text


@pytest.mark.parametrize(("asked", "message"), [
    ({"seed": 4}, "seed 3 there, 4 asked for"),
    ({"transitions": 70}, "transitions 65 there, 70 asked for"),
    ({"quality": "fast"}, "quality 'exact' there, 'fast' asked for"),
    ({"image_size": 9}, "image_size 8 there, 9 asked for"),
])  # fmt: skip
def test_another_request_for_the_same_place_is_refused(collected, asked, message):
    request = {"transitions": 65, "seed": 3, **SMALL} | asked
    with pytest.raises(DatasetError, match=f"{message}.*choose another directory"):
        collect_random(FIXED, collected["toy-fixed"].parent, **request)


def test_a_directory_with_something_else_is_left_alone(tmp_path):
    (tmp_path / "toy-fixed").mkdir()
    (tmp_path / "toy-fixed" / "thesis.tex").write_text("x")
    with pytest.raises(DatasetError, match="not empty and not a collection"):
        collect_random(FIXED, tmp_path, transitions=5, **SMALL)
    assert [file.name for file in (tmp_path / "toy-fixed").iterdir()] == ["thesis.tex"]


def test_nobody_else_may_collect_into_the_same_place(tmp_path):
    collection = DomainCollection(tmp_path / "toy", request())
    with pytest.raises(DatasetError, match="Another process is writing"):
        DomainCollection(tmp_path / "toy", request())
    collection.close()
    DomainCollection(tmp_path / "toy", request()).close()


def test_what_the_disk_cannot_hold_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(DiskSpaceError, match=r"Collecting toy-fixed, toy-variable needs .* GB"):
        collect_group([FIXED, VARIABLE], tmp_path, transitions=10**9)
    assert not list(tmp_path.rglob("*.memmap"))


def test_two_tasks_of_one_domain_are_not_mixed(tmp_path):
    with pytest.raises(DatasetError, match="Two of the domains"):
        collect_group([FIXED, replace(FIXED, task="toy_other")], tmp_path, transitions=5, **SMALL)


def test_what_two_letters_share_is_collected_once(tmp_path, monkeypatch):
    letters = {"X": (FIXED,), "Y": (FIXED, VARIABLE)}
    monkeypatch.setattr("crptpro.domains.GROUPS", letters)
    paths = collect_group(["X", "Y"], tmp_path, transitions=5, **SMALL)
    assert list(paths) == [FIXED.name, VARIABLE.name]


def test_a_domain_name_makes_a_safe_directory(tmp_path):
    assert dataset_path(tmp_path, "gymnasium:Half/Cheetah-v5") == tmp_path / "gymnasium-Half-Cheetah-v5"


def test_a_failing_environment_gives_one_clear_error(tmp_path):
    with pytest.raises(CRPTproError, match=r"episode 0 of toy-failing.*failed: the simulator exploded"):
        collect_random(FAILING, tmp_path, transitions=50, **SMALL)


def test_a_dying_process_gives_one_clear_error(tmp_path):
    with pytest.raises(
        WorkerLostError, match=r"episode 0 of toy-dying.* exited with status 7.*run the same command"
    ):
        collect_random(DYING, tmp_path, transitions=50, **SMALL)


def test_a_process_that_dies_in_the_middle_of_a_message_gives_one_clear_error(tmp_path, monkeypatch):
    def torn(connection):
        raise OSError("got end of file during message")

    monkeypatch.setattr(multiprocessing.connection.Connection, "recv", torn)
    with pytest.raises(CRPTproError, match="Every finished episode is kept: run the same command again"):
        collect_random(DYING, tmp_path, transitions=50, **SMALL)


def test_a_hanging_process_is_noticed_and_ended(tmp_path):
    with pytest.raises(RenderingError, match=r"episode 0 of toy-hanging.*no sign of life.*MUJOCO_GL"):
        collect_random(HANGING, tmp_path, transitions=50, stall_timeout_s=5, **SMALL)


@pytest.mark.parametrize("usual_length", [None, 10, 4, 50])
def test_order_of_arrival_and_wrong_lengths_do_not_change_the_data(tmp_path, usual_length):
    reference = DomainCollection(tmp_path / "reference", request(), 10)
    run_in_order(reference, 0)
    for order in range(4):
        path = tmp_path / str(order)
        collection = DomainCollection(path, request(), usual_length)
        run_in_order(collection, order)
        assert data_bytes(path) == data_bytes(tmp_path / "reference")
        assert not (path / INCOMING).exists()


def test_no_more_is_stepped_than_needed_when_the_length_is_known(tmp_path):
    jobs = run_in_order(DomainCollection(tmp_path, request(), 10), 0)
    assert [job.limit for job in jobs] == [27, 17, 7]


def test_an_endless_episode_is_cut(tmp_path, monkeypatch):
    monkeypatch.setattr("crptpro.data.collection.LONGEST_EPISODE_AGENT_STEPS", 12)
    run_in_order(DomainCollection(tmp_path, request()), 0, lambda seed: 10**9)
    dataset = FrameDataset.open(tmp_path)
    assert dataset.transitions["next", "truncated"].squeeze(-1).nonzero().flatten().tolist() == [11, 23, 26]
    assert not dataset.transitions["next", "terminated"].any()


def test_an_episode_that_waits_for_an_earlier_one_survives_a_kill(tmp_path):
    reference = DomainCollection(tmp_path / "reference", request(), 10)
    run_in_order(reference, 0)
    collection = DomainCollection(tmp_path / "killed", request(), 10)
    roller = EpisodeRoller(lambda: ToyEnv(fixed_length))
    jobs = [collection.next_job() for _ in range(3)]
    collection.accept(0, roller.roll(jobs[0]))
    collection.accept(2, roller.roll(jobs[2]))
    collection.close()
    write_incoming(tmp_path / "killed", 5, roller.roll(jobs[2]))
    (tmp_path / "killed" / INCOMING / "000005.npz").write_bytes(b"torn")
    resumed = DomainCollection(tmp_path / "killed", request(), 10)
    job = resumed.next_job()
    assert job == jobs[1]
    assert resumed.next_job() is None
    resumed.accept(1, roller.roll(job))
    roller.close()
    assert resumed.is_complete
    assert data_bytes(tmp_path / "killed") == data_bytes(tmp_path / "reference")


PROGRAM = """
    import sys
    sys.path.insert(0, {here!r})
    from toy_world import SLOW
    from crptpro.data import collect_random
    if __name__ == "__main__":
        collect_random(SLOW, {root!r}, transitions=400, seed=1, workers=2, image_size=8)
"""


def group_has_ended(group: int) -> bool:
    """Whether no process of the group is left, given a moment to end."""
    for _ in range(200):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def start_collecting(tmp_path, root):
    program = tmp_path / f"{root.name}.py"
    program.write_text(textwrap.dedent(PROGRAM.format(here=str(HERE), root=str(root))))
    # A group of its own, so that one kill ends the program and all its processes; and Ctrl-C heeded, although a
    # test suite that a script started in the background inherits that it is ignored.
    return subprocess.Popen(
        [sys.executable, str(program)],
        start_new_session=True,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def stop_while_collecting(process, journal, how, delay_s):
    """Send a signal to all processes of a collection, some time after it finished a further episode."""
    before = journal.stat().st_size if journal.exists() else 0
    deadline = time.monotonic() + 120
    while not (journal.exists() and journal.stat().st_size > before):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(delay_s)
    assert process.poll() is None
    os.killpg(process.pid, how)
    return process.communicate(timeout=60)[1]


@pytest.mark.slow
def test_interrupted_killed_and_started_again_gives_the_same_bytes(tmp_path):
    whole, path = tmp_path / "whole", tmp_path / "data" / "toy-slow"
    run_in_order(
        DomainCollection(whole, request(domain="toy-slow", seed=1, transitions=400)), 0, variable_length
    )
    rng = random.Random()

    process = start_collecting(tmp_path, path.parent)
    errors = stop_while_collecting(process, path / "journal.jsonl", signal.SIGINT, rng.uniform(0, 0.5))
    assert errors.count(b"Traceback") == 1  # as Ctrl-C does: the program's own, none of its processes'
    assert b"KeyboardInterrupt" in errors
    assert group_has_ended(process.pid)
    with pytest.raises(DatasetError, match="is unfinished"):
        FrameDataset.open(path)

    process = start_collecting(tmp_path, path.parent)
    stop_while_collecting(process, path / "journal.jsonl", signal.SIGKILL, rng.uniform(0, 0.5))
    assert not (path / "card.json").exists()

    assert start_collecting(tmp_path, path.parent).wait(120) == 0
    assert data_bytes(path) == data_bytes(whole)
    cards = [json.loads((root / "card.json").read_text()) for root in (whole, path)]
    assert cards[0]["crc32"] == cards[1]["crc32"]
