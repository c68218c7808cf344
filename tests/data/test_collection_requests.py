"""What an interrupted, refused or failed request leaves behind never blocks the next one."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from toy_gymnasium import PAINTER
from toy_world import FAILING, FIXED, data_bytes, random_episode, run_in_order, variable_length
from toy_world import collection_request as request

from crptpro.data import FrameDataset, collect_group, collect_random
from crptpro.data import collection as collection_module
from crptpro.data.collection import DomainCollection
from crptpro.data.layout import CARD_FILE, COLLECTION_FILE
from crptpro.directory_lock import DirectoryLock
from crptpro.domains import Domain
from crptpro.envs import rendering
from crptpro.errors import CRPTproError, DatasetError, DiskSpaceError

HERE = Path(__file__).parent
SMALL = {"image_size": 8, "progress": False}


def test_a_request_that_the_disk_refused_does_not_block_a_smaller_one(tmp_path):
    with pytest.raises(DiskSpaceError):
        collect_random(FIXED, tmp_path, transitions=10**9, **SMALL)
    assert len(FrameDataset.open(collect_random(FIXED, tmp_path, transitions=5, **SMALL))) == 5


def test_an_environment_that_failed_does_not_block_the_repaired_one(tmp_path):
    with pytest.raises(CRPTproError, match="the simulator exploded"):
        collect_random(FAILING, tmp_path, transitions=50, camera=1, **SMALL)
    repaired = Domain(FAILING.name, FAILING.task, make=FIXED.make)
    path = collect_random(repaired, tmp_path, transitions=5, **SMALL)
    card = FrameDataset.open(path).card
    assert card["camera"] == 0
    assert len(card["sessions"]) == 1  # the failed one contributed nothing


@pytest.mark.parametrize("index", [0, 1])
def test_a_full_disk_is_named_and_what_was_kept_goes_on(tmp_path, monkeypatch, index):
    """Whether an episode is appended or, come before its turn, kept aside."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    collection = DomainCollection(tmp_path, request())
    collection.next_job(), collection.next_job()
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(DiskSpaceError, match="is full after 0 transitions"):
            collection.accept(index, random_episode(10, size=8))
    collection.close()
    assert not list(tmp_path.glob(".incoming/*"))
    run_in_order(DomainCollection(tmp_path, request()), 0)
    assert len(FrameDataset.open(tmp_path)) == 27


def test_what_another_process_finished_just_before_the_lock_was_free_is_taken(tmp_path, monkeypatch):
    def finished_by_another(*arguments: object, **options: object) -> DirectoryLock:
        with monkeypatch.context() as patched:
            patched.setattr(collection_module, "DirectoryLock", DirectoryLock)
            run_in_order(DomainCollection(tmp_path, request()), 0)
        return DirectoryLock(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(collection_module, "DirectoryLock", finished_by_another)
    assert DomainCollection(tmp_path, request()).is_complete
    DirectoryLock(tmp_path).release()


def test_an_accepted_episode_fixes_the_request(tmp_path):
    collection = DomainCollection(tmp_path / "toy", request())
    run_in_order(collection, 0, episodes=1)
    collection.close()
    with pytest.raises(DatasetError, match="was begun with other settings: seed 0 there, 1 asked for"):
        DomainCollection(tmp_path / "toy", request(seed=1))


@pytest.mark.parametrize("left", [[".lock"], [".lock", ".collection.json.k2j3h4x_"]])
def test_what_a_kill_at_the_very_start_leaves_is_an_empty_directory(tmp_path, left):
    for name in left:
        (tmp_path / name).write_text('{"format"')
    run_in_order(DomainCollection(tmp_path, request()), 0)
    assert not list(tmp_path.glob(".collection.json.*"))
    assert len(FrameDataset.open(tmp_path)) == 27


def test_only_the_locks_holder_removes_temporaries(tmp_path):
    collection = DomainCollection(tmp_path, request())
    (tmp_path / ".collection.json.k2j3h4x_").write_text("being written")
    with pytest.raises(DatasetError, match="Another process is writing"):
        DomainCollection(tmp_path, request())
    assert (tmp_path / ".collection.json.k2j3h4x_").exists()
    collection.close()


@pytest.mark.parametrize(("now", "message"), [
    ({"backend": "osmesa", "gl_renderer": "llvmpipe"}, "backend 'egl', now it is 'osmesa'.*MUJOCO_GL=egl"),
    ({"backend": "egl", "gl_renderer": "NVIDIA H200"}, "'llvmpipe', now it is 'NVIDIA H200'.*pixels differ"),
])  # fmt: skip
def test_another_backend_or_renderer_may_not_continue(tmp_path, now, message):
    rendered = {"backend": "egl", "gl_renderer": "llvmpipe"}
    collection = DomainCollection(tmp_path, request())
    collection.note_environment(rendered)
    run_in_order(collection, 0, episodes=1)
    collection.close()
    resumed = DomainCollection(tmp_path, request())
    resumed.note_environment(rendered)
    with pytest.raises(DatasetError, match=message):
        resumed.note_environment(now)
    resumed.close()


def test_before_the_first_episode_any_backend_may_begin(tmp_path):
    collection = DomainCollection(tmp_path, request())
    collection.note_environment({"backend": "egl", "gl_renderer": "NVIDIA H200"})
    collection.close()
    again = DomainCollection(tmp_path, request())
    again.note_environment({"backend": "osmesa", "gl_renderer": "llvmpipe"})
    run_in_order(again, 0)
    assert FrameDataset.open(tmp_path).card["render"]["backend"] == "osmesa"


def test_a_card_counts_its_own_domains_time(tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    collection = DomainCollection(tmp_path, request(transitions=10), 10)
    clock[0] += 50  # the pool collects another domain first
    run_in_order(collection, 0, on_job=lambda job: clock.__setitem__(0, clock[0] + 3))
    assert FrameDataset.open(tmp_path).card["wall_time_s"] == 3.0


def test_a_card_says_what_the_frames_are(tmp_path):
    path = collect_group([FIXED], tmp_path, transitions=5, seed=3, quality="fast", **SMALL)["toy-fixed"]
    card = json.loads((path / CARD_FILE).read_text())
    assert (card["pixels"], card["quality"], card["image_size"]) == ("uint8 0..255", "fast", 8)
    assert {"torch", "torchrl", "mujoco", "python"} <= set(card["versions"])
    assert card["sessions"][0]["versions"] == card["versions"]
    card["pixels"] = "float32 0..1"
    (path / CARD_FILE).write_text(json.dumps(card))
    with pytest.raises(
        DatasetError, match=r"pixels of .* are 'float32 0..1', this release reads 'uint8 0..255'"
    ):
        FrameDataset.open(path)


def test_a_make_that_cannot_be_sent_to_processes_is_named(tmp_path):
    domain = Domain("own", "own", make=lambda image_size: None)
    with pytest.raises(
        CRPTproError, match=r"'own' cannot be sent to worker processes.*module-level function"
    ):
        collect_random(domain, tmp_path, transitions=5, **SMALL)


def test_a_world_that_draws_by_itself_is_collected_without_gl(tmp_path, monkeypatch):
    monkeypatch.setattr(rendering, "select_backend", lambda **_: pytest.fail("a GL backend was proven"))
    path = collect_random(PAINTER, tmp_path, transitions=5, **SMALL)
    assert FrameDataset.open(path).card["render"]["backend"] == "none"


PROGRAM = """
    import sys
    sys.path.insert(0, {here!r})
    from toy_world import SLOW
    from crptpro.data import collect_random
    if __name__ == "__main__":
        collect_random(SLOW, {root!r}, transitions=30, seed=1, workers=2, image_size=8, progress=False)
"""


@pytest.mark.slow
def test_a_kill_before_the_first_episode_is_completed_by_the_same_command(tmp_path):
    whole, path = tmp_path / "whole", tmp_path / "data" / "toy-slow"
    asked = request(domain="toy-slow", seed=1, transitions=30)
    run_in_order(DomainCollection(whole, asked), 0, variable_length)
    program = tmp_path / "program.py"
    program.write_text(textwrap.dedent(PROGRAM.format(here=str(HERE), root=str(path.parent))))
    command = [sys.executable, str(program)]

    process = subprocess.Popen(command, start_new_session=True)  # one kill ends the program and its processes
    deadline = time.monotonic() + 120
    while not (path / COLLECTION_FILE).exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.002)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait(60)
    assert not (path / "journal.jsonl").exists()

    assert subprocess.run(command, timeout=240, check=False).returncode == 0
    assert data_bytes(path) == data_bytes(whole)
    shutil.rmtree(tmp_path)
