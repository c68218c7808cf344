"""Jobs that exist only in a test: they last some polls and end as they were told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fake_pieces import FakePiece, plan_of

from crptpro.cards import write_json
from crptpro.experiments.building import JobSettings
from crptpro.experiments.launching import Failure, Outcome, Work, run_pieces
from crptpro.experiments.store import DONE, Store

LOST = Outcome("the job was lost (killed)")
REFUSED = Outcome("it will never do", is_final=True)


@dataclass
class FakeJob:
    work: Work
    polls: int
    outcome: Outcome
    on_end: Callable[[FakeJob], None]
    stops: int = 0

    def poll(self) -> Outcome | None:
        self.polls -= 1
        if self.polls > 0:
            return None
        self.on_end(self)
        return self.outcome

    def stop(self) -> None:
        self.stops += 1
        self.polls = min(self.polls, 1)


@dataclass
class FakeLauncher:
    """Its jobs last some polls and end as told, by the name in their keys: well, if nothing is said."""

    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)
    polls: int = 2
    is_one_machine: bool = True
    events: list[str] = field(default_factory=list)
    running: int = 0
    most: int = 0
    jobs: list[FakeJob] = field(default_factory=list)

    def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
        name = work.key.split("-")[-2]
        ends = self.outcomes.get(name, [])
        self.running += 1
        self.most = max(self.most, self.running)
        self.events.append(f"{name} starts")
        self.jobs.append(FakeJob(work, self.polls, ends.pop(0) if ends else Outcome(), self._ended))
        return self.jobs[-1]

    def _ended(self, job: FakeJob) -> None:
        self.running -= 1
        self.events.append(f"{job.work.key.split('-')[-2]} ends")
        if not job.outcome.reason and not job.stops:
            write_json(job.work.log.parent / DONE, {"seconds": 1.0})
            store = Store(Path(job.work.root))
            for path in store.outputs(store.described(job.work.key)):
                path.parent.mkdir(parents=True)
                path.touch()

    def close(self) -> None:
        pass


def run(
    store: Store, launcher: FakeLauncher, *pieces: FakePiece, jobs: int = 2, **options: Any
) -> list[Failure]:
    plan = plan_of(store, *pieces)
    return run_pieces(plan, store, JobSettings(), launcher, jobs=jobs, poll_s=0.0, **options)
