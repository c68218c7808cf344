"""An environment in a thread of its own: it simulates and renders while the caller's thread computes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import TypeVar

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from crptpro.active_config import ActiveConfig
from crptpro.cards import cpu_cores
from crptpro.domains import Domain
from crptpro.downstream_config import DownstreamConfig
from crptpro.envs import needs_gl
from crptpro.envs.rendering import select_backend
from crptpro.errors import UnknownNameError
from crptpro.modules.lone_threads import lone_threads

T = TypeVar("T")


class EnvThread:
    """Makes, steps and closes one environment in one thread, where its render context lives.

    MuJoCo lets other threads run while it simulates and draws. What the environment returns does not depend on when
    it is asked, so running ahead changes no number.

    Args:
        make_env: builds the environment.
        is_ahead: False does everything in the caller's thread, when it is asked for.
    """

    def __init__(self, make_env: Callable[[], EnvBase], *, is_ahead: bool) -> None:
        self._thread = lone_threads(1, "environment") if is_ahead else None
        self._pending: Future[TensorDictBase] | Callable[[], TensorDictBase] | None = None
        self._is_closed = False
        try:
            self.env: EnvBase = self._do(make_env)
        except BaseException:
            self._end_thread()
            raise

    def reset(self, seed: int) -> TensorDictBase:
        """Seed the environment and start the episode that belongs to the seed."""

        def reset() -> TensorDictBase:
            self.env.set_seed(seed)
            return self.env.reset()

        return self._do(reset)

    def begin_step(self, tensordict: TensorDictBase) -> None:
        """Begin the step that ``tensordict["action"]`` asks for; nobody may change the tensordict until its end."""
        if self._pending is not None:
            raise RuntimeError("begin_step() twice; end_step() comes between.")
        if self._thread is None:
            self._pending = lambda: self.env.step(tensordict)
        else:
            self._pending = self._thread.submit(self.env.step, tensordict)

    def end_step(self) -> TensorDictBase:
        """Wait for the step and return the tensordict with its ``"next"``; raises what the environment raised."""
        pending, self._pending = self._pending, None
        if pending is None:
            raise RuntimeError("end_step() without begin_step().")
        return pending.result() if isinstance(pending, Future) else pending()

    def close(self) -> None:
        """Let a step that has begun end, then free the render context. Harmless when called again."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            if isinstance(self._pending, Future):
                self._pending.exception()
        finally:
            self._pending = None
            try:
                self._do(self.env.close)
            finally:
                self._end_thread()

    def _do(self, work: Callable[[], T]) -> T:
        return work() if self._thread is None else self._thread.submit(work).result()

    def _end_thread(self) -> None:
        if self._thread is not None:
            self._thread.shutdown()


def runs_ahead(task: str | Domain, config: DownstreamConfig | ActiveConfig) -> bool:
    """Tell whether the next observation is drawn while the update computes: as asked, or where it pays and can.

    A GPU computes by itself once it has been told to, and one core cannot do two things at a time. GLFW wants the main
    thread.
    """
    if config.render_ahead is not None:
        return config.render_ahead
    if config.device != "cpu" or cpu_cores() == 1:
        return False
    with suppress(UnknownNameError):  # only a caller's own factory knows the task
        return not (needs_gl(task) and select_backend() == "glfw")
    return True
