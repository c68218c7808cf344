from __future__ import annotations

import errno
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch
from tqdm import tqdm

from crptpro.console import configure_logging, parse, run_main
from crptpro.errors import DatasetError
from crptpro.training import DownstreamConfig, PretrainConfig


def fails(error: BaseException) -> Callable[[], None]:
    def main() -> None:
        raise error

    return main


@dataclass
class Recipe:
    """Two stages."""

    seed: int = 0
    pretrain: PretrainConfig = field(default_factory=lambda: PretrainConfig(updates=2_000))
    downstream: DownstreamConfig = field(default_factory=DownstreamConfig)


def test_the_options_of_a_recipe_and_of_its_stages_are_read_with_their_defaults(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["recipe", "--seed", "3", "--pretrain.batch-size", "8"])
    expected = Recipe(3, PretrainConfig(updates=2_000, batch_size=8), DownstreamConfig())
    assert parse(Recipe, "") == expected


@pytest.mark.parametrize(("main", "status", "line"), [
    (fails(DatasetError("no such thing")), 1, "error: no such thing"),
    (lambda: DownstreamConfig(batch_size=0), 1, "error: `batch_size` must be at least 1, got 0."),
    (Path("/absent/file").read_text, 1, "error: [Errno 2] No such file or directory: '/absent/file'"),
    (lambda: Path("/dev/full").write_text("x"), 1, "error: [Errno 28] No space left on device"),  # no file is named
    (fails(KeyboardInterrupt()), 130, "interrupted; where there is a checkpoint, the same command continues from it."),
])  # fmt: skip
def test_an_expected_error_is_one_line_and_an_exit_status(
    main: Callable[[], object], status: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        run_main(main)
    assert stopped.value.code == status
    assert stopped.value.__suppress_context__  # nothing is printed below it
    assert capsys.readouterr() == ("", f"{line}\n")


@pytest.mark.parametrize("main", [
    fails(ValueError("raised by a caller")),
    fails(OSError(errno.EIO, os.strerror(errno.EIO))),
    fails(BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))),  # a pipe of its own
    lambda: torch.zeros(2).reshape(3),
])  # fmt: skip
def test_a_defect_keeps_its_traceback(main: Callable[[], object]) -> None:
    with pytest.raises((ValueError, RuntimeError, OSError)):
        run_main(main)


def test_events_are_plain_lines_and_warnings_are_marked(capsys: pytest.CaptureFixture[str]) -> None:
    configure_logging()
    configure_logging()  # twice does not print twice
    library = logging.getLogger("crptpro.anything")
    library.debug("unseen")
    library.info("40 env steps")
    library.warning("little memory")
    assert capsys.readouterr() == ("", "40 env steps\nwarning: little memory\n")


def test_a_line_does_not_break_a_running_bar(capsys: pytest.CaptureFixture[str]) -> None:
    configure_logging()
    with tqdm(total=3, disable=False, ncols=40, ascii=True, mininterval=0) as bar:
        bar.update()
        logging.getLogger("crptpro").info("in between")
    lines = capsys.readouterr().err.replace("\r", "\n").splitlines()
    assert "in between" in lines


@pytest.mark.parametrize("program", [
    "from crptpro.cli import main; import sys; sys.argv = ['crptpro', 'pretrain', '--help']; main()",
    "from crptpro.console import run_main; run_main(lambda: [print('x' * 100, flush=True) for _ in range(10**5)])",
])  # fmt: skip
def test_a_closed_pipe_ends_a_program_quietly(program: str) -> None:
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 128 + 13
