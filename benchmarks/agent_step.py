"""One decision of the downstream loop on the real simulator, taken apart: render, store, encode, act, update.

What runs is the loop itself (:meth:`crptpro.training.downstream_run.DownstreamRun.run_episode`) with dense features and
a full replay; its parts are wrapped in stopwatches.
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tqdm.auto import tqdm

from benchmarks.library_updates import require_dense, store_episodes, synthetic_episodes
from crptpro.downstream_config import DownstreamConfig
from crptpro.envs import make_env
from crptpro.loggers import RunLogger
from crptpro.pretrained import Pretrained
from crptpro.training.downstream_run import DownstreamRun
from crptpro.training.env_thread import EnvThread

#: Stages of a decision in the order of the loop, and the parts of the update. Where the image is drawn during the
#: update, the loop only waits for the rest of it.
STAGES = ("act", "update", "env step (physics, one image), or waiting for it", "store", "encode")
RESET = "reset of the episode"
PARTS = ("update, of it features", "update, of it bonus", "update, of it learner")


@dataclasses.dataclass(frozen=True)
class AgentStep:
    """What a decision costs, seconds.

    Args:
        is_ahead: the next image was drawn while the update computed.
        mean_s: everything from one decision to the next, reset of the episode and records included.
        median_s: half the median of two decisions in a row (the actor learns in every second).
        stages: mean by stage; ``"rest"`` is what no stopwatch saw.
        agent_steps: decisions that were timed.
    """

    is_ahead: bool
    mean_s: float
    median_s: float
    stages: Mapping[str, float]
    agent_steps: int

    def hours(self, agent_steps: int) -> float:
        """Return how long a run of so many decisions takes, its evaluations left out."""
        return self.mean_s * agent_steps / 3600

    def table(self) -> str:
        """Return the stages as a Markdown table."""
        lines = ["| stage | mean ms per decision | share |", "|---|---|---|"]
        for name, seconds in self.stages.items():
            lines.append(f"| {name} | {1e3 * seconds:.2f} | {seconds / self.mean_s:.0%} |")
        lines.append(f"| **whole** (median {1e3 * self.median_s:.2f}) | {1e3 * self.mean_s:.2f} | 100% |")
        return "\n".join(lines)


class Stopwatch:
    """Adds up the time spent in wrapped calls, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.starts: dict[str, list[float]] = {}

    def clear(self) -> None:
        """Forget everything."""
        self.seconds.clear()
        self.starts.clear()

    def timed(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return ``call`` with its time added to ``name``."""

        def wrapped(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
                self.starts.setdefault(name, []).append(start)

        return wrapped

    def within(self, owner: Any, **names: str) -> Any:
        """Return a stand-in for ``owner`` whose methods ``names`` are timed under the names given."""
        return _Watched(
            owner, {method: self.timed(name, getattr(owner, method)) for method, name in names.items()}
        )


class _Watched:
    def __init__(self, owner: Any, timed: Mapping[str, Callable[..., Any]]) -> None:
        self._owner, self._timed = owner, timed

    def __getattr__(self, name: str) -> Any:
        timed = self.__dict__["_timed"]
        return timed[name] if name in timed else getattr(self.__dict__["_owner"], name)


def measure_agent_step(
    task: str,
    pretrained: Pretrained,
    config: DownstreamConfig,
    run_dir: Path,
    *,
    agent_steps: int,
    warmup: int = 20,
) -> list[AgentStep]:
    """Fill the replay with synthetic observations, then time decisions of the real loop.

    First with the image drawn when the update is done, then with the image drawn meanwhile.

    Args:
        task: in the real simulator.
        pretrained: encoder, projector and prototypes.
        config: of a whole run; ``replay_capacity`` observations are stored and encoded first.
        run_dir: for the replay's files and the record.
        agent_steps: decisions to time, an even number above two.
        warmup: decisions before.

    Raises:
        CRPTproError: if the dense maps do not fit the memory.
    """
    # Evaluations are none of a decision's business.
    config = dataclasses.replace(config, features="dense", eval_workers=0, render_ahead=False)
    require_dense(pretrained, config)
    with RunLogger(run_dir / "record") as records:
        run = DownstreamRun(
            task, pretrained, run_dir, config, records, progress=False, env_factory=make_env
        )  # fmt: skip
        try:
            _fill(run)
            found = [_measure(run, agent_steps, warmup, is_ahead=False)]
            run.env.close()
            size = run.parts.encoder.image_size
            make_same = functools.partial(make_env, task, seed=config.seed, image_size=size)
            run.env = EnvThread(make_same, is_ahead=True)
            found.append(_measure(run, agent_steps, warmup, is_ahead=True))
        finally:
            run.close()
    return found


def _measure(run: DownstreamRun, agent_steps: int, warmup: int, *, is_ahead: bool) -> AgentStep:
    watch = Stopwatch()
    parts, env = run.parts, run.env
    methods = run.act, run.update
    _attach(run, watch)
    try:
        _run(run, warmup)
        watch.clear()
        start = time.perf_counter()
        _run(run, agent_steps)
        total = time.perf_counter() - start
    finally:
        run.parts, run.env = parts, env
        run.act, run.update = methods  # type: ignore[method-assign]
    stages = {name: watch.seconds.get(name, 0.0) / agent_steps for name in (*STAGES, *PARTS, RESET)}
    rest = total / agent_steps - sum(stages[name] for name in (*STAGES, RESET))
    return AgentStep(
        is_ahead=is_ahead,
        mean_s=total / agent_steps,
        median_s=_median_of_pairs(watch.starts[STAGES[0]]),
        stages={**stages, "rest (TensorDicts, records)": rest},
        agent_steps=agent_steps,
    )


def _fill(run: DownstreamRun) -> None:
    action_dim = run.env.env.action_spec.shape[-1]
    episodes = synthetic_episodes(
        run.config.resolved_replay_capacity, run.parts.encoder.image_size, action_dim=action_dim
    )
    store_episodes(run.parts.replay, episodes)
    run.parts.features.rebuild()


def _attach(run: DownstreamRun, watch: Stopwatch) -> None:
    act, update, render, store, encode = STAGES
    features, bonus, learner = PARTS
    parts = run.parts
    run.env = watch.within(run.env, end_step=render, reset=RESET)
    run.act = watch.timed(act, run.act)  # type: ignore[method-assign]
    run.update = watch.timed(update, run.update)  # type: ignore[method-assign]
    watched: dict[str, Any] = {
        "replay": watch.within(parts.replay, append=store),
        "features": watch.within(parts.features, observe=encode, sample=features),
        "bonus": None if parts.bonus is None else watch.timed(bonus, parts.bonus),
        "algorithm": dataclasses.replace(
            parts.algorithm, learner=watch.within(parts.learner, update=learner)
        ),
    }
    run.parts = dataclasses.replace(parts, **watched)


def _run(run: DownstreamRun, agent_steps: int) -> None:
    """Let the run believe that so many decisions are left of its budget, and take them."""
    config = run.config
    run.agent_steps = config.env_steps // config.resolved_action_repeat - agent_steps
    with tqdm(disable=True) as bar:
        while run.env_steps < config.env_steps:
            run.run_episode(bar)


def _median_of_pairs(starts: list[float]) -> float:
    """Half the median time over two decisions, from the starts of at least three; a reset may lie between them."""
    return statistics.median(later - earlier for earlier, later in zip(starts, starts[2:])) / 2
