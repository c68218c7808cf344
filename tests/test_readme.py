"""What the README quotes is what the repository has."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_loop_of_the_readme_is_the_recipe_that_a_test_runs() -> None:
    recipe = (ROOT / "recipes" / "plain_torchrl.py").read_text()
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    quoted = next(block for block in blocks if "SoftUpdate" in block)
    assert textwrap.indent(quoted, "    ") in recipe


def test_the_readme_fits_on_few_screens() -> None:
    assert len(README.splitlines()) <= 150
