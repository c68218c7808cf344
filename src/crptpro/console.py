"""What the command line and the recipes share: readable log lines, and one clear line per error."""

from __future__ import annotations

import io
import logging
import os
import select
import sys
from collections.abc import Callable
from typing import TextIO

from tqdm import tqdm

from crptpro.errors import CRPTproError, is_disk_full


class _BarFriendlyHandler(logging.Handler):
    """Writes above a progress bar instead of through it."""

    def emit(self, record: logging.LogRecord) -> None:
        prefix = "" if record.levelno <= logging.INFO else f"{record.levelname.lower()}: "
        tqdm.write(prefix + self.format(record), file=sys.stderr)


def configure_logging(level: int = logging.INFO) -> None:
    """Show the library's log lines on standard error; other packages' from warnings upwards."""
    handler = _BarFriendlyHandler()
    root = logging.getLogger("crptpro")
    root.handlers[:] = [handler]
    root.setLevel(level)
    root.propagate = False
    # absl and TorchRL announce things no user can act on at INFO.
    logging.getLogger("absl").setLevel(logging.ERROR)


def run_main(main: Callable[[], object]) -> None:
    """Run a program: expected errors become one line and exit status 1, Ctrl-C exits with 130.

    Expected are this library's own errors, a setting it refuses, and a file that cannot be read or written. Anything
    else is a defect and keeps its traceback. What a terminal cannot show is printed as escapes, and a reader that has
    seen enough (``| head``) ends the program quietly, with the status of SIGPIPE.
    """
    for stream in (sys.stdout, sys.stderr):  # a terminal without UTF-8 gets "?" for what it cannot show
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    configure_logging()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            main()
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # not at exit, where nobody could catch what comes of it
    except BrokenPipeError:
        unread = [stream for stream in (sys.stdout, sys.stderr) if _is_unread(stream)]
        if not unread:
            raise
        for stream in unread:  # what is still in its buffer goes nowhere
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        raise SystemExit(128 + 13) from None
    except (CRPTproError, ValueError, OSError) as error:
        if not is_expected(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        print("interrupted; the same command continues from the last checkpoint.", file=sys.stderr)
        raise SystemExit(130) from None


def _is_unread(stream: TextIO) -> bool:
    """Whether a stream is a pipe that nobody reads any more."""
    try:
        poll = select.poll()
        poll.register(stream.fileno(), 0)
    except (AttributeError, OSError):  # not POSIX, or no file
        return False
    return bool(poll.poll(0))


def is_expected(error: BaseException) -> bool:
    """Whether an error is one that a user can act on, not a defect."""
    if isinstance(error, CRPTproError):
        return True
    if isinstance(error, OSError):
        # The message names the file; of one that it has open, the system tells only that the disk is full.
        return error.filename is not None or is_disk_full(error)
    # A ValueError that this library's own code raised names a setting; one from below is a defect.
    origin = error.__traceback__
    while origin is not None and origin.tb_next is not None:
        origin = origin.tb_next
    module = "" if origin is None else origin.tb_frame.f_globals.get("__name__", "")
    return module.split(".")[0] == "crptpro"
