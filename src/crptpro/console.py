"""For the command line and the recipes: readable log lines, one line per error, and options of several stages."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import sys
import traceback
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, TextIO, TypeVar

import tyro
from tqdm import tqdm
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec

from crptpro.errors import CRPTproError, is_disk_full
from crptpro.values import as_int

_Config = TypeVar("_Config")
_COUNTS = ConstructorRegistry()


@_COUNTS.primitive_rule
def _count(info: Any) -> PrimitiveConstructorSpec[int] | None:
    """Parse whole numbers as the Python functions accept them, ``1e5`` too."""
    if info.type is not int:
        return None

    def read(words: list[str]) -> int:
        try:
            return int(words[0])
        except ValueError:
            with contextlib.suppress(ValueError):
                return as_int(float(words[0]), "value")
        raise ValueError(f"{words[0]!r} is not a whole number")

    return PrimitiveConstructorSpec(1, "INT", read, lambda value: isinstance(value, int), lambda value: [str(value)])


class _BarFriendlyHandler(logging.Handler):
    """Writes above a progress bar instead of through it."""

    def emit(self, record: logging.LogRecord) -> None:
        prefix = "" if record.levelno <= logging.INFO else f"{record.levelname.lower()}: "
        try:
            tqdm.write(prefix + self.format(record), file=sys.stderr)
        except OSError as reason:
            if reason.errno != errno.EIO:  # the terminal was closed while the program goes on
                raise


def configure_logging() -> None:
    """Show the library's log lines on standard error; other packages' from warnings upwards."""
    root = logging.getLogger("crptpro")
    root.handlers[:] = [_BarFriendlyHandler()]
    root.setLevel(logging.INFO)
    root.propagate = False
    logging.getLogger("absl").setLevel(logging.ERROR)


def parse(config: type[_Config], description: str | None) -> _Config:
    """Parse the settings of a recipe, a dataclass, from the command line.

    Its fields that are dataclasses are stages. A setting that the recipe itself has, such as ``seed``, is not an option
    of the stages: the recipe sets it for all of them.
    """
    shared, registry, is_within = {field.name for field in fields(config)}, ConstructorRegistry(), False  # type: ignore[arg-type]

    @registry.struct_rule
    def stage(info: Any) -> Any:
        nonlocal is_within
        if is_within or info.type is config or not is_dataclass(info.type):
            return None
        is_within = True  # the next call tries every rule, including this one
        usual: Any = ConstructorRegistry.get_struct_spec(info)
        is_within = False
        return replace(usual, fields=tuple(field for field in usual.fields if field.name not in shared))

    with registry:
        return tyro.cli(config, description=description)


def run_main(main: Callable[[], object]) -> None:
    """Run a program: expected errors become one line and exit status 1, Ctrl-C exits with 130.

    Expected are this library's own errors, a setting it refuses, and a file that cannot be read or written. A defect
    keeps its traceback. A closed pipe (``| head``) ends the program silently, with the status of SIGPIPE.
    """
    configure_logging()
    try:
        try:
            with _COUNTS:
                main()
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # a broken pipe cannot be caught at the interpreter's exit
    except BrokenPipeError:
        closed = [stream for stream in (sys.stdout, sys.stderr) if _is_closed_pipe(stream)]
        if not closed:
            raise
        for stream in closed:  # discards what is still buffered
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        raise SystemExit(128 + 13) from None
    except (CRPTproError, ValueError, OSError) as error:
        if not _is_expected(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        print("interrupted; where there is a checkpoint, the same command continues from it.", file=sys.stderr)
        raise SystemExit(130) from None


def _is_closed_pipe(stream: TextIO) -> bool:
    try:
        poll = select.poll()
        poll.register(stream.fileno(), 0)
    except (AttributeError, OSError):  # not POSIX, or no file
        return False
    return bool(poll.poll(0))


def _is_expected(error: BaseException) -> bool:
    """Whether an error is one that a user can act on, not a defect."""
    if isinstance(error, CRPTproError):
        return True
    if isinstance(error, OSError):
        return error.filename is not None or is_disk_full(error)
    # A ValueError that this library's own code raised names a setting; one from a dependency is a defect.
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return bool(frames) and frames[-1].f_globals.get("__name__", "").split(".")[0] == "crptpro"
