"""What ``benchmarks.revisions`` times, run in each checkout: ``python revision_items.py ITEM SIZES``, a JSON object.

Prints a JSON object of facts when it is ready, then for every line on its standard input one round's seconds per unit.
Where the interface of revision 40d9ae0 differs, the item is set up by the helpers of that checkout's own benchmarks.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

Item = Callable[[dict[str, Any], Path], tuple[dict[str, float], Callable[[], float]]]
"""From sizes and an empty directory to facts and a call that returns seconds per unit."""


def pretrain(sizes: dict[str, Any], scratch: Path) -> tuple[dict[str, float], Callable[[], float]]:
    library, paths = helpers(), datasets(sizes, scratch)
    loss = library.fresh_loss(image_size=sizes["image_size"], prototypes=sizes["prototypes"])
    update = library.PretrainUpdates(loss, paths, batch_size=sizes["batch_size"], precision="auto")
    return {}, timed(update, 2)


def downstream(sizes: dict[str, Any], scratch: Path) -> tuple[dict[str, float], Callable[[], float]]:
    library, transitions = helpers(), sizes["transitions"]
    pretrained = library.fresh_pretrained(image_size=sizes["image_size"], prototypes=sizes["prototypes"])
    config = importlib.import_module("crptpro.training").DownstreamConfig(
        batch_size=sizes["batch_size"], replay_capacity=transitions, random_agent_steps=1, env_steps=500_000,
        action_repeat=2, features="dense",
    )  # fmt: skip
    if is_40d9ae0():
        stored = library.synthetic_episodes(transitions, sizes["image_size"])
        return {}, timed(library.DownstreamUpdates(pretrained, stored, config=config, run_dir=scratch), 2)
    run = library.Downstream(pretrained, config, env_factory=synthetic().make_drifting_env)
    run.fill(transitions)
    return {}, timed(run.update, 2)


def decision(sizes: dict[str, Any], scratch: Path) -> tuple[dict[str, float], Callable[[], float]]:
    """Whole runs of ``train_downstream``: half the median time between every second step of the world."""
    library, train = helpers(), importlib.import_module("crptpro.training").train_downstream
    pretrained = library.fresh_pretrained(image_size=sizes["image_size"], prototypes=sizes["prototypes"])
    first, count = sizes["batch_size"], sizes["decisions"]
    env_steps = 2 * (first + 20 + count)
    runs = iter(range(10**9))

    def one_run() -> float:
        steps: list[list[float]] = []  # by environment: the first one learns, the others evaluate

        def clocked(task: object, **settings: Any) -> Any:
            env = synthetic().make_drifting_env(task, length=100, **settings)
            own: list[float] = []
            step = env.step
            steps.append(own)

            def noted(td: Any) -> Any:
                own.append(time.perf_counter())
                return step(td)

            env.step = noted
            return env

        train(
            "drifting", pretrained, run_dir=scratch / str(next(runs)), env_factory=clocked, progress=False,
            env_steps=env_steps, action_repeat=2, batch_size=sizes["batch_size"], random_agent_steps=first,
            replay_capacity=env_steps // 2, features="dense", eval_episodes=1, eval_workers=0,
            eval_interval_env_steps=env_steps, checkpoint_interval_env_steps=env_steps,
        )  # fmt: skip
        starts = max(steps, key=len)[first + 20 :]
        gaps = sorted(later - earlier for earlier, later in zip(starts, starts[2:]))
        return gaps[len(gaps) // 2] / 2

    return {}, one_run


def dataset_sample(sizes: dict[str, Any], scratch: Path) -> tuple[dict[str, float], Callable[[], float]]:
    path = datasets(sizes, scratch)[0]
    dataset = importlib.import_module("crptpro.data").FrameDataset.open(path)
    facts = {"disk_bytes_per_transition": disk_bytes(path) / len(dataset)}
    return facts, timed(lambda: dataset.sample(sizes["batch_size"]), 10)


def replay_sample(sizes: dict[str, Any], scratch: Path) -> tuple[dict[str, float], Callable[[], float]]:
    replay = empty_replay(sizes, scratch / "replay")
    store(replay, sizes["transitions"], sizes)
    facts = {"disk_bytes_per_transition": disk_bytes(scratch / "replay") / len(replay)}
    return facts, timed(lambda: replay.sample(sizes["batch_size"]), 10)


def extend(sizes: dict[str, Any], scratch: Path) -> tuple[dict[str, float], Callable[[], float]]:
    """One transition after the other, as the loops store them."""
    replay = empty_replay(sizes, scratch / "replay")
    return {}, lambda: store(replay, 200, sizes)


def collect(sizes: dict[str, Any], scratch: Path) -> tuple[dict[str, float], Callable[[], float]]:
    """``collect_random`` of a world that costs nothing, one process, from its second episode on."""
    domain = importlib.import_module("crptpro.domains").Domain(
        "drifting", "drifting_go", make=synthetic().make_drifting, episode_env_steps=500
    )
    collect_random = importlib.import_module("crptpro.data").collect_random
    roots = iter(range(10**9))

    def one_collection() -> float:
        seconds = []
        for transitions in (500, 1_500):
            start = time.perf_counter()
            collect_random(
                domain, scratch / str(next(roots)), transitions=transitions, image_size=sizes["image_size"],
                progress=False,
            )  # fmt: skip
            seconds.append(time.perf_counter() - start)
        return (seconds[1] - seconds[0]) / 1_000

    return {}, one_collection


ITEMS: dict[str, Item] = {
    "pretrain": pretrain, "downstream": downstream, "decision": decision, "dataset-sample": dataset_sample,
    "replay-sample": replay_sample, "extend": extend, "collect": collect,
}  # fmt: skip


# --- what differs between revisions -----------------------------------------------------------------------------------


def is_40d9ae0() -> bool:
    """Whether this checkout has the interface of revision 40d9ae0."""
    return hasattr(importlib.import_module("crptpro.data").FrameReplay, "begin_episode")


def helpers() -> Any:
    return importlib.import_module("benchmarks.library_updates" if is_40d9ae0() else "benchmarks.library")


def synthetic() -> Any:
    """The worlds of this benchmark, which lie beside this file, in whatever checkout it runs."""
    return importlib.import_module("synthetic")


def datasets(sizes: dict[str, Any], scratch: Path) -> list[Path]:
    write = importlib.import_module("benchmarks.synthetic").write_dataset
    return [
        write(scratch / f"drifting_{seed}", transitions=sizes["transitions"], seed=seed, image_size=sizes["image_size"])
        for seed in range(3)
    ]  # fmt: skip


def empty_replay(sizes: dict[str, Any], path: Path) -> Any:
    replay = importlib.import_module("crptpro.data").FrameReplay
    shape = (3, sizes["image_size"], sizes["image_size"])
    return replay(sizes["transitions"], frame_shape=shape, action_dim=synthetic().ACTION_DIM, path=path)


def store(replay: Any, transitions: int, sizes: dict[str, Any]) -> float:
    """Store transitions one by one; returns seconds per transition, without the time that it takes to draw them."""
    drawn = synthetic().episodes(transitions, image_size=sizes["image_size"])
    rows = [row for episode in drawn for row in episode.unbind(0)]
    add = appending(replay) if is_40d9ae0() else replay.add
    start = time.perf_counter()
    for row in rows:
        add(row)
    return (time.perf_counter() - start) / len(rows)


def appending(replay: Any) -> Callable[[Any], None]:
    begins = True

    def append(row: Any) -> None:
        nonlocal begins
        following = row["next"]
        if begins:
            replay.begin_episode(row["pixels"])
        begins = bool(following["done"])
        replay.append(row["action"], float(following["reward"]), False, begins, following["pixels"])

    return append


# --- the process ------------------------------------------------------------------------------------------------------


def timed(call: Callable[[], Any], count: int) -> Callable[[], float]:
    def one_round() -> float:
        start = time.perf_counter()
        for _ in range(count):
            call()
        return (time.perf_counter() - start) / count

    return one_round


def disk_bytes(directory: Path) -> int:
    return sum(512 * file.stat().st_blocks for file in directory.rglob("*") if file.is_file())


def resident_bytes() -> int:
    """Memory of this process beyond the page cache."""
    lines = Path("/proc/self/status").read_text().splitlines()
    kb = {line.split(":")[0]: int(line.split()[1]) for line in lines if line.startswith("Rss")}
    return 1024 * (kb["RssAnon"] + kb["RssShmem"])


@contextlib.contextmanager
def stdout_to_stderr() -> Iterator[Any]:
    """Keep standard output for the answers: TorchRL announces storages on it."""
    answers, sys.stdout = sys.stdout, sys.stderr
    yield answers


def main(name: str, sizes: dict[str, Any]) -> None:
    import torch

    torch.set_num_threads(sizes["threads"])
    with stdout_to_stderr() as answers, tempfile.TemporaryDirectory(prefix="crptpro-revisions-") as scratch:
        facts, one_round = ITEMS[name](sizes, Path(scratch))
        one_round()  # warm-up
        print(json.dumps({**facts, "resident_bytes": resident_bytes()}), file=answers, flush=True)
        for _ in sys.stdin:
            print(json.dumps(one_round()), file=answers, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], json.loads(sys.argv[2]))
