"""Would a run work on this machine? Versions, hardware, rendering and every domain's frames.

``python -m crptpro.doctor walker``, with ``MUJOCO_GL`` naming the backend, renders one domain and prints a JSON line.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, Literal

import torch
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from crptpro import provenance
from crptpro.domains import PAPER_DOMAINS, expand_groups
from crptpro.errors import CRPTproError, EnvCrashedError, RenderingError
from crptpro.free_memory import free_bytes
from crptpro.plugins import FLAG, load_plugins, loaded_plugins

_BREAKING = ("mujoco", "dm-control", "torchrl", "tensordict")
"""Packages that are known to break outside their declared range; others are merely untested."""
_GB = 1e9
_TIMED_AGENT_STEPS = 8
_OTHER_BACKEND = "Try another backend: MUJOCO_GL=osmesa or MUJOCO_GL=egl."
_DOMAIN_S = 60.0
"""Seconds for a domain besides its first frame: imports, building, stepping."""

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """An error stops a run, a warning may spoil one, a note does neither."""

    severity: Severity
    what: str
    remedy: str = ""


@dataclass(frozen=True)
class DoctorReport:
    """What :func:`run_doctor` found; most severe first."""

    facts: tuple[str, ...]
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        return not any(finding.severity == "error" for finding in self.findings)

    def text(self) -> str:
        lines = [*self.facts, ""]
        for finding in self.findings:
            lines.append(f"{finding.severity}: {finding.what}")
            if finding.remedy:
                lines.append(f"  what to do: {finding.remedy}")
        return "\n".join([*lines, "This machine can run crptpro." if self.ok else "This machine cannot run crptpro."])


def run_doctor(domains: Iterable[str] | None = None) -> DoctorReport:
    """Check versions, memory and disk, and render every domain with the backend that a run would use.

    ``domains`` are as for :func:`crptpro.domains.expand_groups`, by default the paper's eight.
    """
    names = expand_groups(PAPER_DOMAINS if domains is None else domains)
    machine = provenance.hardware()
    gpus = machine["gpus"]
    free_disk, free_ram = shutil.disk_usage(Path.cwd()).free, free_bytes(torch.device("cpu"))
    facts = [
        "versions",
        *(f"  {name:<12}{version}" for name, version in provenance.versions().items()),
        "",
        "machine",
        f"  CPU   {machine['cpu']} ({machine['cpu_instructions']}), {machine['cpu_cores']} cores",
        f"  GPU   {', '.join(gpus) or 'none'}",
        f"  RAM   {free_ram / _GB:.1f} GB free of {machine['ram_bytes'] / _GB:.1f} GB",
        f"  disk  {free_disk / _GB:.1f} GB free at {Path.cwd()}",
        "",
    ]
    installed = {canonicalize_name(each.name): each.version for each in importlib.metadata.distributions()}
    declared = importlib.metadata.requires("crptpro") if "crptpro" in installed else None
    requirements = [text for text in declared or () if "extra ==" not in text]
    rendering_facts, problems = _check_rendering(names, has_gpu=bool(gpus))
    findings = [*check_versions(installed, requirements), *_check_machine(free_ram, free_disk, gpus), *problems]
    findings.sort(key=lambda finding: ("error", "warning", "note").index(finding.severity))
    return DoctorReport((*facts, *rendering_facts), tuple(findings))


def check_versions(installed: Mapping[Any, str], requirements: Iterable[str]) -> list[Finding]:
    """Compare installed versions, by package name, with requirements such as ``"mujoco>=3.17,<4"``.

    Examples:
        >>> check_versions({"mujoco": "4.0.0"}, ["mujoco>=3.17,<4"])[0].severity
        'error'
        >>> check_versions({"torch": "2.13.0+cpu"}, ["torch>=2.11,<2.14"])
        []
    """
    findings = []
    for requirement in map(Requirement, requirements):
        name = canonicalize_name(requirement.name)
        version = installed.get(name)
        remedy = f'pip install "{requirement}"'
        if version is None:
            findings.append(Finding("error", f"{name} is not installed.", remedy))
        elif not requirement.specifier.contains(version, prereleases=True):
            breaks = name in _BREAKING
            effect = "known to break" if breaks else "untested"
            what = f"{name} {version} is outside {requirement.specifier}, which is {effect}."
            findings.append(Finding("error" if breaks else "warning", what, remedy))
    return findings


def _check_machine(free_ram: int, free_disk: int, gpus: Sequence[str]) -> list[Finding]:
    findings = []
    if free_ram < 4 * _GB:
        what = f"{free_ram / _GB:.1f} GB of RAM are free; batches of 512 and a replay of 40,000 transitions need 4 GB."
        remedy = "End other programs, or use smaller batches and a smaller replay."
        findings.append(Finding("error" if free_ram < 1.5 * _GB else "warning", what, remedy))
    if free_disk < 7 * _GB:
        what = f"{free_disk / _GB:.1f} GB of disk are free here; three domains of 100,000 transitions take 6 GB."
        remedy = "Free space, write to another disk, or collect fewer transitions."
        findings.append(Finding("error" if free_disk < 0.5 * _GB else "warning", what, remedy))
    remedy = "Repair its driver (nvidia-smi), or hide it with CUDA_VISIBLE_DEVICES; --device cpu always works."
    unusable = [gpu for gpu in gpus if gpu.startswith(provenance.UNUSABLE)]
    findings += [Finding("warning", f"torch cannot use a GPU: {gpu}.", remedy) for gpu in unusable]
    if not gpus:
        findings.append(Finding("note", "torch sees no GPU; training runs on the CPU."))
    return findings


def _check_rendering(names: Sequence[str], *, has_gpu: bool) -> tuple[list[str], list[Finding]]:
    try:
        from crptpro.envs import needs_gl, rendering

        backend = rendering.select_backend() if any(map(needs_gl, names)) else None
    except RenderingError as reason:
        remedy = "Unset MUJOCO_GL, or repair that backend." if "MUJOCO_GL" in os.environ else ""
        return ["rendering: no backend renders"], [Finding("error", str(reason), remedy)]
    gl = rendering.backend_card() if backend else {}
    place = f"with {backend} ({gl['gl_renderer']}, {gl['gl_kind']})" if backend else "without GL"
    facts, findings = [f"rendering {place}, milliseconds per agent step (physics and one image)"], []
    if has_gpu and gl.get("gl_kind") == "software":
        what = f"There is a GPU, but {backend} renders in software, about twenty times slower."
        remedy = "Install the GL parts of the GPU's driver; in a container set NVIDIA_DRIVER_CAPABILITIES=all."
        findings.append(Finding("warning", what, remedy))
    for entry in render_domains(names, backend, rendering.first_frame_timeout_s() + _DOMAIN_S):
        name, error = entry["domain"], entry["error"]
        times = "   failed" if error else f"{entry['agent_step_ms']:>8.1f}   reset {entry['reset_ms']:.0f}"
        facts.append(f"  {name:<24}{times}")
        if error:
            what = f"{name} with {backend}: {error}" if needs_gl(name) else f"{name}: {error}"
            findings.append(Finding("error", what, entry["remedy"] if needs_gl(name) else ""))
    return facts, findings


def render_domains(names: Sequence[str], backend: str | None, timeout_s: float) -> list[dict[str, Any]]:
    """Run :func:`check_domain` on each name, one by one in processes with a time limit."""
    from crptpro.envs.rendering import run_isolated

    plugins = [part for name in loaded_plugins() for part in (FLAG, name)]
    entries: list[dict[str, Any]] = []
    for name in names:
        command = (sys.executable, "-m", "crptpro.doctor", *plugins, name)
        ((status, stdout, stderr),) = run_isolated([command], backend, timeout_s=timeout_s)
        answers = [line for line in stdout.splitlines() if line.startswith("{") and line.endswith("}")]
        if status is None:
            entries.append(_failed(name, f"no answer within {timeout_s:g} s"))
        elif not answers:
            how = f"signal {-status}" if status < 0 else f"exit status {status}"
            entries.append(_failed(name, (stderr.strip().splitlines() or [how])[-1]))
        else:
            entries.append(json.loads(answers[-1]))
    return entries


def check_domain(name: str) -> dict[str, Any]:
    """Step a domain at random and check its pixels.

    Returns ``domain`` and ``error``: why it failed, or what is wrong with its images, otherwise empty. With an error,
    ``remedy``. Without one, wall-clock milliseconds: ``reset_ms`` of the first reset, which makes the render context,
    and ``agent_step_ms``, the median of physics and one image.
    """
    import gymnasium

    from crptpro.envs import make_env

    try:
        with closing(make_env(name, seed=0, frame_stack=1)) as env:
            times = [time.perf_counter()]
            first = last = env.reset()
            times.append(time.perf_counter())
            for _ in range(_TIMED_AGENT_STEPS):
                last = env.step(env.rand_action(last))["next"]
                times.append(time.perf_counter())
    except Exception as reason:
        lacks_package = (ModuleNotFoundError, gymnasium.error.DependencyNotInstalled)
        has_remedy = isinstance(reason, CRPTproError) and not isinstance(reason, RenderingError)
        remedy = "" if has_remedy or isinstance(reason.__cause__ or reason, lacks_package) else _OTHER_BACKEND
        has_name = isinstance(reason, (CRPTproError, EnvCrashedError))
        return _failed(name, str(reason) if has_name else f"{type(reason).__name__}: {reason}", remedy)
    if first["pixels"].unique().numel() == 1 or first["pixels"].equal(last["pixels"]):
        return _failed(name, "its pixels are constant or do not change")
    reset_ms, *step_ms = (1e3 * (end - start) for start, end in pairwise(times))
    return {"domain": name, "error": "", "reset_ms": reset_ms, "agent_step_ms": median(step_ms)}


def _failed(name: str, error: str, remedy: str = _OTHER_BACKEND) -> dict[str, Any]:
    return {"domain": name, "error": error, "remedy": remedy}


if __name__ == "__main__":
    (domain_name,) = load_plugins(sys.argv[1:])
    sys.stdout.write(json.dumps(check_domain(domain_name)) + "\n")
