"""The library's loops as users call them, paused at every pass: what :class:`benchmarks.measure.Loop` runs.

``python -m benchmarks.loops ITEM SETTINGS`` pauses its loop, prints a JSON object of seconds per pass by what they were
spent on, and continues when it reads a line. No code of a loop is copied here: public methods that it calls are timed.
"""

from __future__ import annotations

import functools
import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any
from unittest import mock

import torch

from benchmarks import synthetic
from benchmarks.synthetic import make_drifting
from crptpro.data import FrameDataset, FrameReplay, collect_random
from crptpro.modules import PixelEncoder, Projector, Prototypes
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import Pretrained
from crptpro.training import pretrain, train_downstream

Hold = Callable[[dict[str, float]], None]


def fresh_loss(*, image_size: int, prototypes: int, seed: int = 0) -> ProtoLoss:
    """Return the pre-training loss with the paper's sizes; the same seed gives the same weights."""
    torch.manual_seed(seed)
    return ProtoLoss(PixelEncoder(image_size=image_size), num_prototypes=prototypes)


def fresh_pretrained(*, image_size: int, prototypes: int) -> Pretrained:
    """Return encoder, projector and prototypes at initialisation: their values do not change what they cost."""
    torch.manual_seed(0)
    encoder = PixelEncoder(image_size=image_size).requires_grad_(False).eval()
    projector, heads = Projector(encoder.feature_dim), Prototypes(prototypes)
    return Pretrained(encoder, projector, prototypes=heads, card={"method": "crptpro"})


class Laps:
    """Seconds of a loop by what they were spent on; ``hold`` gets their means every ``passes`` passes."""

    def __init__(self, hold: Hold, passes: int) -> None:
        self.hold, self.passes, self.done = hold, passes, 0
        self.seconds: dict[str, float] = defaultdict(float)
        self.since = time.perf_counter()

    def lap(self, name: str, *, waits: bool = False) -> None:
        """Attribute the time since the last lap to ``name``."""
        if waits and torch.cuda.is_initialized():
            torch.cuda.synchronize()
        now = time.perf_counter()
        self.seconds[name] += now - self.since
        self.since = now

    def begin(self, name: str) -> None:
        """End the last lap of a pass."""
        self.done += 1
        is_due = self.done % self.passes == 0
        self.lap(name, waits=is_due)
        if is_due:
            self.hold({lap: seconds / self.passes for lap, seconds in self.seconds.items()})
            self.seconds.clear()
            self.since = time.perf_counter()

    def clock(self, owner: type, name: str, before: Callable[..., None], after: str = "") -> Any:
        """Call ``before`` when a method begins, and record its duration as the lap ``after``, if given."""
        method = getattr(owner, name)

        @functools.wraps(method)
        def clocked(this: Any, *args: Any, **kwargs: Any) -> Any:
            before(this, *args)
            found = method(this, *args, **kwargs)
            if after:
                self.lap(after)
            return found

        return mock.patch.object(owner, name, clocked)


def pretraining(
    hold: Hold, *, image_size: int, prototypes: int, datasets: Sequence[str], batch_size: int, passes: int = 1,
    **settings: Any,
) -> None:  # fmt: skip
    """Time ``pretrain(...)``: one lap, ``update``."""
    laps = Laps(hold, passes)

    def begin(_: FrameDataset, count: int) -> None:
        if count == batch_size:  # other samples only inspect the dataset
            laps.begin("update")

    with laps.clock(FrameDataset, "sample", begin):
        loss = fresh_loss(image_size=image_size, prototypes=prototypes)
        pretrain(loss, datasets, batch_size=batch_size, progress=False, **settings)


def downstream(
    hold: Hold, *, image_size: int, prototypes: int, transitions: int, task: str = "", passes: int = 2, **settings: Any,
) -> None:  # fmt: skip
    """Time ``train_downstream(...)`` on the drifting environment or a task: laps ``update``, ``store`` and ``act``.

    The actor learns in every second pass. Drifting pictures are stored and encoded before the first update. ``store``
    begins when the next observation has been drawn, so that ``update`` includes the wait for it.
    """
    laps = Laps(hold, passes)
    to_fill = iter([transitions])

    def begin(replay: FrameReplay, *_: int) -> None:
        for count in to_fill:
            fill(replay, count, image_size, encodes=settings.get("features") != "reencode")
        laps.begin("act")

    store = laps.clock(FrameReplay, "extend", lambda *_: laps.lap("update", waits=True), after="store")
    with laps.clock(FrameReplay, "sample", begin), store:
        train_downstream(
            task or "drifting", fresh_pretrained(image_size=image_size, prototypes=prototypes), progress=False,
            env_steps=500_000, replay_capacity=transitions,
            random_agent_steps=1, eval_episodes=1, eval_workers=0,
            eval_interval_env_steps=500_000, **settings,
        )  # fmt: skip


def fill(replay: FrameReplay, transitions: int, image_size: int, *, encodes: bool) -> None:
    """Store episodes of the drifting environment, and encode them where the replay's transforms keep features."""
    action_dim = replay[:1]["action"].shape[-1] if len(replay) else synthetic.ACTION_DIM
    env = make_drifting(action_dim, seed=1, image_size=image_size)
    while len(replay) < transitions:
        replay.extend(env.rollout(transitions - len(replay)))
    for first in range(0, transitions if encodes else 0, 500):
        replay[first : first + 500]


def rendering(hold: Hold, *, root: str, task: str, image_size: int, transitions: int) -> None:
    """Collect a task once."""
    collect_random(task, root, transitions=transitions, image_size=image_size, progress=False)
    hold({})


def nothing(hold: Hold) -> None:
    """Import what the others import."""
    hold({})


ITEMS: dict[str, Callable[..., None]] = {item.__name__: item for item in (pretraining, downstream, rendering, nothing)}


def main(item: str, settings: dict[str, Any]) -> None:
    """Run an item until standard input ends."""
    answers, sys.stdout = sys.stdout, sys.stderr  # TorchRL announces storages on standard output

    def hold(laps: dict[str, float]) -> None:
        print(json.dumps(laps), file=answers, flush=True)
        if not sys.stdin.readline():
            raise SystemExit(0)

    torch.set_num_threads(settings.pop("threads", torch.get_num_threads()))
    ITEMS[item](hold, **settings)


if __name__ == "__main__":
    main(sys.argv[1], json.loads(sys.argv[2]))
