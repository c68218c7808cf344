"""Errors that a user can act on: each message names the offending value and the remedy."""

from __future__ import annotations

import errno
import os
from pathlib import Path


class CRPTproError(RuntimeError):
    """Base of every error this library raises on purpose; the command line prints only its message."""


class UnknownNameError(CRPTproError):
    """An unknown domain, task, group or method; the message lists the nearest names."""


class RenderingError(CRPTproError):
    """No GL backend renders, or the first frame did not arrive in time."""


class EnvOutputError(CRPTproError):
    """An environment returned an unusable image; the message names it."""


class EnvCrashedError(RuntimeError):
    """The code of an environment raised an exception: a defect, so the command line shows its traceback."""


class WorkerLostError(CRPTproError):
    """A worker process ended without an error message; usually it was killed for lack of memory."""


class DatasetError(CRPTproError):
    """A dataset is missing, truncated, not written by crptpro or does not fit its use."""


class DiskSpaceError(CRPTproError):
    """The disk is full, or too small for the next file."""


class CheckpointError(CRPTproError):
    """A checkpoint is unreadable or belongs to another configuration."""


class PretrainedError(CRPTproError):
    """A pretrained artifact is missing, damaged or does not fit its use."""


class RecordError(CRPTproError):
    """The record of a run is missing, damaged, or lacks a requested entry."""


class NonFiniteError(CRPTproError):
    """A loss, a weight, or a value from an environment became NaN or infinite."""


class SubmissionError(CRPTproError):
    """A cluster's queue refused a job; submitting it later may work."""


class CompileError(CRPTproError):
    """``torch.compile`` was requested and does not work on this machine or for this loss."""


def is_disk_full(reason: BaseException) -> bool:
    """Return whether a write failed because the disk, or its quota, is full."""
    numbers = (errno.ENOSPC, errno.EDQUOT)
    if isinstance(reason, OSError):
        return reason.errno in numbers
    # A file that torch cannot write is a RuntimeError with the system's words.
    return isinstance(reason, DiskSpaceError) or any(f"{os.strerror(n)} ({n})" in str(reason) for n in numbers)


def writing_error(path: Path, reason: OSError | DiskSpaceError) -> OSError | DiskSpaceError:
    """Return the error to raise after a failed write, with the path, which the system omits for open files."""
    if is_disk_full(reason):
        return DiskSpaceError(f"The disk is full: {path} cannot be written. Free space and start again.")
    if isinstance(reason, OSError) and reason.errno is not None and reason.filename is None:
        return OSError(reason.errno, reason.strerror, str(path))
    return reason
