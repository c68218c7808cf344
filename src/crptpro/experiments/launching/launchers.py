"""What the scheduler asks of a place where jobs run, and the simplest one: this process."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Protocol

from crptpro.experiments.launching.work import Work


@dataclass(frozen=True)
class Outcome:
    """How a job ended.

    Args:
        reason: why the piece is not finished; empty if it is.
        is_final: whether trying again would not help.
    """

    reason: str = ""
    is_final: bool = False


class Job(Protocol):
    """A job that was started."""

    def poll(self) -> Outcome | None:
        """How it ended; ``None`` as long as it runs or waits for its turn."""

    def stop(self) -> None:
        """Ask it to write a checkpoint and end; asked again, to end at once."""


class Launcher(Protocol):
    """A place where jobs run."""

    is_one_machine: bool
    """Whether all jobs share this machine's cores."""

    def start(self, work: Work, *, is_exclusive: bool) -> Job:
        """Start a job, or queue it where somebody else decides when it runs.

        Args:
            work: what it does.
            is_exclusive: whether nothing of anybody's should run beside it, where that can be asked for.

        Raises:
            SubmissionError: if a queue does not take it now; nothing was started.
        """

    def close(self) -> None:
        """Free what it holds; no job is running."""


class InlineLauncher:
    """Runs a job in this process, to its end, when it is started: for a debugger, and without any dependency."""

    is_one_machine = True

    def start(self, work: Work, *, is_exclusive: bool) -> Job:
        """Make the piece; what the library logs goes to the piece's log, too."""
        work.log.parent.mkdir(parents=True, exist_ok=True)
        library = logging.getLogger("crptpro")
        with open(work.log, "a") as log:
            handler = logging.StreamHandler(log)
            library.addHandler(handler)
            try:
                log.write(work.heading() + "\n")
                refusal = work.run()
                log.write(f"error: {refusal}\n" if refusal else "finished\n")
                return _Ended(Outcome(refusal, is_final=bool(refusal)))
            except Exception as error:
                # A defect keeps its traceback, and is not met by trying again in the same process.
                logging.getLogger(__name__).exception("%s", work.key)
                return _Ended(Outcome(f"{type(error).__name__}: {error}", is_final=True))
            finally:
                library.removeHandler(handler)

    def close(self) -> None:
        """Nothing is held."""


@dataclass(frozen=True)
class _Ended:
    outcome: Outcome

    def poll(self) -> Outcome:
        return self.outcome

    def stop(self) -> None:
        pass
