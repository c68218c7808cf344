"""Errors that a user can act on: each message names the offending value and the remedy."""

from __future__ import annotations

import errno
from pathlib import Path


class CRPTproError(RuntimeError):
    """Base of every error this library raises on purpose; the command line prints only its message."""


class UnknownNameError(CRPTproError):
    """A domain, task, group or method that is not registered; the message lists the nearest names."""


class RenderingError(CRPTproError):
    """No GL backend renders a live frame, or the first frame did not arrive in time."""


class WorldError(CRPTproError):
    """A world showed or answered what no world may; the message names it."""


class WorldFailedError(RuntimeError):
    """A world's own code raised an exception: the message is its own, with the name of the world and the call.

    It is a defect of the world, not a setting that could be mended, and keeps its traceback on the command line.
    """


class WorkerLostError(CRPTproError):
    """A process that collects or evaluates ended without an error message; usually it was killed for lack of memory."""


class DatasetError(CRPTproError):
    """A dataset is missing, truncated, foreign or does not fit its use."""


class DiskSpaceError(CRPTproError):
    """A write was announced that the disk cannot hold."""


class CheckpointError(CRPTproError):
    """A checkpoint is unreadable or belongs to another configuration."""


class PretrainedError(CRPTproError):
    """A pretrained artifact is missing, damaged or does not fit its use."""


class RecordError(CRPTproError):
    """The record of a run is missing, damaged, or lacks what is asked of it."""


class NonFiniteError(CRPTproError):
    """A loss, a gradient, or what a world answered became NaN or infinite."""


class SubmissionError(CRPTproError):
    """A cluster's queue refused a job, which it may take another time."""


class CompileError(CRPTproError):
    """``torch.compile`` was asked for and does not work on this machine, or not for this loss."""


def error_name(reason: BaseException) -> str:
    """Return the name under which another process can raise this error again; empty if it is not one of ours."""
    return type(reason).__name__ if isinstance(reason, CRPTproError) else ""


def error_named(name: str, message: str) -> CRPTproError | None:
    """Rebuild an error that another process named by :func:`error_name`; ``None`` if it was not one of ours.

    Examples:
        >>> error_named(error_name(DatasetError("gone")), "gone")
        DatasetError('gone')
    """
    known = globals().get(name)
    return known(message) if isinstance(known, type) and issubclass(known, CRPTproError) else None


def is_disk_full(reason: BaseException) -> bool:
    """Whether a write failed because the disk, or the quota of it, is full."""
    if isinstance(reason, OSError):
        return reason.errno in (errno.ENOSPC, errno.EDQUOT)
    return isinstance(reason, DiskSpaceError)


def writing_error(path: Path, reason: OSError | DiskSpaceError) -> OSError | DiskSpaceError:
    """Return the error to raise when ``path`` could not be written: it names the path.

    The system names a file that it cannot open; of one that is open it says no more than what went wrong.

    Args:
        path: what the caller knows it as; a temporary file beside it may be what was being written.
        reason: why it could not.
    """
    if is_disk_full(reason):
        return DiskSpaceError(f"The disk is full: {path} cannot be written. Free space and start again.")
    if isinstance(reason, OSError) and reason.errno is not None and reason.filename is None:
        return OSError(reason.errno, reason.strerror, str(path))
    return reason
