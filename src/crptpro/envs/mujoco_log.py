"""MuJoCo's own warnings, sent to this library's logger instead of standard error and a file."""

from __future__ import annotations

import logging

logger = logging.getLogger(__name__)


def route_mujoco_warnings() -> None:
    """Log MuJoCo's warnings; call it after importing dm_control, which sends them to absl.

    Without a handler MuJoCo prints them and appends to ``MUJOCO_LOG.TXT`` in the working directory.
    Deprecations concern the authors of a model, not its users, and are logged at debug level.
    """
    import mujoco

    mujoco.set_mju_user_warning(_log)


def _log(message: str | bytes) -> None:
    text = message.decode(errors="replace") if isinstance(message, bytes) else str(message)
    logger.log(logging.DEBUG if "deprecated" in text else logging.WARNING, "MuJoCo: %s", text)
