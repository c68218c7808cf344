"""Runs the stages of the benchmarks in the test's own process, where nothing needs to be imported again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from benchmarks.resident import Resident
from benchmarks.stages import STAGES


def run_here(name: str, arguments: Mapping[str, Any]) -> Resident:
    """Run a stage as :func:`benchmarks.stages.run_watched` does, but for the process and its memory."""
    answer = STAGES[name](**json.loads(json.dumps(dict(arguments))))
    return Resident(300_000_000, 100_000_000, 1.0, json.loads(json.dumps(answer)))
