"""The commands and the programs that the pages show are those that the library takes."""

from __future__ import annotations

import dataclasses
import re
import shlex
import sys
from pathlib import Path
from unittest.mock import patch

import pytest
from command import Call

from crptpro import cli
from crptpro.training import DownstreamConfig, PretrainConfig

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINES = [line for page in PAGES for line in re.findall(r"(?m)^crptpro (.+)$", page.read_text())]
COMMANDS = sorted({shlex.join(shlex.split(line, comments=True)) for line in LINES})
(MY_ENCODER,) = re.findall(r"```python\n(# my_encoder.py.*?)```", (ROOT / "docs/own_parts.md").read_text(), re.DOTALL)
PROGRAMS = [
    (page.name, block)
    for page in PAGES
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    if "__main__" in block
]


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_is_read_without_complaint(line: str, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("recipes").symlink_to(ROOT / "recipes")
    Path("maze.py").touch()  # the reader's own
    Path("my_encoder.py").write_text(MY_ENCODER)
    ran = []
    for command in vars(cli).values():
        if dataclasses.is_dataclass(command) and hasattr(command, "run"):
            monkeypatch.setattr(command, "run", lambda self: ran.append(self))
    with patch.dict(sys.modules):
        status, _, err = call(*shlex.split(line))
    assert status == 0, err
    assert len(ran) == 1


@pytest.mark.parametrize(("page", "program"), PROGRAMS)
def test_a_program_calls_the_library_with_arguments_that_it_has(page: str, program: str) -> None:
    with (
        patch("crptpro.data.collect_group", autospec=True),
        patch("crptpro.pretrained.save_pretrained", autospec=True),
        patch("crptpro.training.pretrain", autospec=True) as pretrain,
        patch("crptpro.training.train_downstream", autospec=True) as train_downstream,
    ):
        exec(compile(program, page, "exec"), {"__name__": "__main__"})
    for called, config in ((pretrain, PretrainConfig), (train_downstream, DownstreamConfig)):
        settings = called.call_args.kwargs.keys() - {"run_dir"}
        assert settings <= {field.name for field in dataclasses.fields(config)}
