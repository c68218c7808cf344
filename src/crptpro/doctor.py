"""Would a run work on this machine? Versions, hardware, rendering and every domain's frames, in plain words.

``python -m crptpro.doctor walker cheetah``, with ``MUJOCO_GL`` naming the backend, is what draws the domains: in a
process of its own, which answers one JSON line per domain.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import psutil
from packaging.requirements import Requirement

from crptpro import provenance
from crptpro.domains import PAPER_DOMAINS, expand_groups
from crptpro.errors import CRPTproError, RenderingError, WorldFailedError
from crptpro.plugins import FLAG, load_plugin, loaded_plugins

#: Outside their declared range these are known to break; others are merely untested.
_BREAKING = ("mujoco", "dm-control", "torchrl", "tensordict")
_LEFTOVERS = ("mujoco-core", "mujoco-studio")
_GB = 1e9
WARM_UP_AGENT_STEPS = 2
TIMED_AGENT_STEPS = 6


@dataclass(frozen=True)
class Finding:
    """Something to know: an error stops a run, a warning may spoil one, a note does neither."""

    severity: Literal["error", "warning", "note"]
    what: str
    remedy: str = ""


@dataclass(frozen=True)
class DoctorReport:
    """What :func:`run_doctor` found: lines of facts, then problems, the gravest first."""

    facts: tuple[str, ...]
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """True only if a run would work."""
        return not any(finding.severity == "error" for finding in self.findings)

    def text(self) -> str:
        """Return the report as plain text, a line per fact, problems and their remedies last."""
        lines = [*self.facts, ""]
        for finding in self.findings:
            lines.append(f"{finding.severity}: {finding.what}")
            lines += [f"  what to do: {finding.remedy}"] if finding.remedy else []
        return "\n".join([*lines, "A run would work." if self.ok else "A run would not work."])


def run_doctor(
    domains: Iterable[str] | None = None, *, root: str | Path = ".", timeout_s: float | None = None
) -> DoctorReport:
    """Check versions, memory and disk, and render every domain with the backend that a run would use.

    Args:
        domains: As for :func:`crptpro.domains.expand_groups`; by default the paper's eight domains.
        root: Where data would be written; its disk is looked at.
        timeout_s: Seconds for the first frame; by default 60, or ``CRPTPRO_GL_TIMEOUT_S``. A domain has 20 more.

    Raises:
        UnknownNameError: for a domain that nobody knows.
    """
    names = tuple(expand_groups(domains if domains is not None else PAPER_DOMAINS))
    disk = Path(root).absolute()
    while not disk.exists():
        disk = disk.parent
    free_disk, free_ram = shutil.disk_usage(disk).free, psutil.virtual_memory().available
    machine = provenance.hardware()
    facts = [
        "versions",
        *(f"  {name:<12}{version}" for name, version in provenance.versions().items()),
        "",
        "machine",
        f"  CPU   {machine['cpu']} ({machine['cpu_instructions']}), {machine['cpu_cores']} cores",
        f"  GPU   {', '.join(machine['gpus']) or 'none'}",
        f"  RAM   {free_ram / _GB:.1f} GB free of {machine['ram_bytes'] / _GB:.1f} GB",
        f"  disk  {free_disk / _GB:.1f} GB free at {disk}",
        "",
    ]
    findings = [
        *check_versions(_installed(), _requirements()),
        *_check_room(free_ram, free_disk, str(disk)),
        *_check_gpus(machine["gpus"]),
    ]
    drawn, problems = _check_rendering(names, timeout_s, has_gpu=bool(machine["gpus"]))
    order = ("error", "warning", "note")
    findings = sorted([*findings, *problems], key=lambda finding: order.index(finding.severity))
    return DoctorReport((*facts, *drawn), tuple(findings))


def check_versions(installed: Mapping[str, str], requirements: Iterable[str]) -> list[Finding]:
    """Compare installed versions, by package name, with requirements such as ``"mujoco>=3.17,<4"``.

    Examples:
        >>> check_versions({"mujoco": "4.0.0"}, ["mujoco>=3.17,<4"])[0].severity
        'error'
        >>> check_versions({"torch": "2.13.0+cpu"}, ["torch>=2.11,<2.14"])
        []
    """
    findings = []
    for requirement in map(Requirement, requirements):
        name, wanted = requirement.name.lower(), f'pip install "{requirement.name}{requirement.specifier}"'
        version = installed.get(name)
        if version is None:
            findings.append(Finding("error", f"{name} is not installed.", wanted))
        elif not requirement.specifier.contains(version, prereleases=True):
            reach = f"{name} {version} is outside {requirement.specifier}"
            if name in _BREAKING:
                findings.append(Finding("error", f"{reach}, which is known to break.", wanted))
            else:
                findings.append(Finding("warning", f"{reach}, which has not been tested.", wanted))
    leftovers = [name for name in _LEFTOVERS if name in installed]
    if leftovers:
        what = f"{' and '.join(leftovers)} belong to MuJoCo 4 and break the import of MuJoCo 3."
        remedy = f'pip uninstall -y {" ".join(leftovers)}; pip install --force-reinstall "mujoco>=3.17,<4"'
        findings.append(Finding("warning", what, remedy))
    return findings


def check_domain(name: str) -> dict[str, Any]:
    """Step a domain at random and look at its pixels.

    Returns:
        ``domain``; ``reset_ms`` (the first reset, which makes the render context) and ``agent_step_ms``
        (physics and one image), wall-clock milliseconds, ``None`` if it failed; ``error``: why, or what is wrong with
        its images, otherwise empty; ``is_drawing``: another backend may do better.
    """
    import gymnasium

    from crptpro.envs import make_env

    try:
        env = make_env(name, seed=0, frame_stack=1)
        try:
            start = time.perf_counter()
            first = last = env.reset()
            reset_s = time.perf_counter() - start
            for agent_step in range(WARM_UP_AGENT_STEPS + TIMED_AGENT_STEPS):
                if agent_step == WARM_UP_AGENT_STEPS:
                    start = time.perf_counter()
                last = env.step(env.rand_action(last))["next"]
            agent_step_s = (time.perf_counter() - start) / TIMED_AGENT_STEPS
        finally:
            env.close()
    except Exception as reason:  # whatever one domain does, those that follow are checked too
        cause = reason.__cause__ or reason
        lacks = isinstance(cause, (ModuleNotFoundError, gymnasium.error.DependencyNotInstalled))
        is_ours = isinstance(reason, CRPTproError)
        is_named = is_ours or isinstance(reason, WorldFailedError)
        error = str(reason) if is_named else f"{type(reason).__name__}: {reason}"
        is_drawing = not lacks and (isinstance(reason, RenderingError) or not is_ours)
        return _failed(name, error, is_drawing=is_drawing)
    is_alive = first["pixels"].unique().numel() > 1 and not first["pixels"].equal(last["pixels"])
    error = "" if is_alive else "its pixels are constant or do not change"
    times = {"reset_ms": round(reset_s * 1e3, 1), "agent_step_ms": round(agent_step_s * 1e3, 2)}
    return _failed(name, error) | times


def render_domains(names: tuple[str, ...], backend: str, timeout_s: float) -> list[dict[str, Any]]:
    """Check domains in a process of its own, and in another one those that follow a domain that ended it.

    Args:
        names: Domains.
        backend: GL backend.
        timeout_s: For all of them together.

    Returns:
        What :func:`check_domain` returns, for each name.
    """
    from crptpro.envs.rendering import run_isolated

    entries: list[dict[str, Any]] = []
    deadline = time.monotonic() + timeout_s
    plugins = [part for name in loaded_plugins() for part in (FLAG, name)]
    while len(entries) < len(names):
        command = (sys.executable, "-m", "crptpro.doctor", *plugins, *names[len(entries) :])
        left_s = max(0.0, deadline - time.monotonic())
        ((returncode, stdout, stderr),) = run_isolated([command], backend, timeout_s=left_s)
        lines = stdout.splitlines()
        entries += [json.loads(line) for line in lines if line.startswith("{") and line.endswith("}")]
        unanswered = names[len(entries) :]
        if returncode is None:
            return [*entries, *(_failed(name, f"no answer within {timeout_s:g} s") for name in unanswered)]
        if unanswered:
            how = f"signal {-returncode}" if returncode < 0 else f"exit status {returncode}"
            entries.append(_failed(unanswered[0], (stderr.strip().splitlines() or [how])[-1]))
    return entries


def _failed(name: str, error: str, *, is_drawing: bool = True) -> dict[str, Any]:
    return {
        "domain": name, "reset_ms": None, "agent_step_ms": None, "error": error, "is_drawing": is_drawing,
    }  # fmt: skip


def _check_room(free_ram: int, free_disk: int, disk: str) -> list[Finding]:
    findings = []
    if free_ram < 4 * _GB:
        what = (
            f"{free_ram / _GB:.1f} GB of RAM are free; pre-training at batch 512 and a replay of 40,000 "
            "transitions want about 4 GB."
        )
        remedy = "End other programs, or use smaller batches and a smaller replay."
        findings.append(Finding("error" if free_ram < 1.5 * _GB else "warning", what, remedy))
    if free_disk < 7 * _GB:
        what = f"{free_disk / _GB:.1f} GB are free at {disk}; three domains of 100,000 transitions take 6."
        remedy = "Free space, write to another disk, or collect fewer transitions."
        findings.append(Finding("error" if free_disk < 0.5 * _GB else "warning", what, remedy))
    return findings


def _check_gpus(gpus: list[str]) -> list[Finding]:
    if not gpus:
        return [Finding("note", "torch sees no GPU; training runs on the CPU.")]
    remedy = (
        "Repair its driver (nvidia-smi), or hide it with CUDA_VISIBLE_DEVICES; --device cpu always works."
    )
    unusable = [gpu for gpu in gpus if gpu.startswith(provenance.UNUSABLE)]
    return [Finding("warning", f"torch cannot use a GPU: {gpu}.", remedy) for gpu in unusable]


def _check_rendering(
    names: tuple[str, ...], timeout_s: float | None, *, has_gpu: bool
) -> tuple[list[str], list[Finding]]:
    try:
        from crptpro.envs import (
            rendering,  # imported late: the import itself complains about a wrong MUJOCO_GL
        )

        first_frame_s = rendering.default_timeout_s() if timeout_s is None else timeout_s
        backend = rendering.select_backend(timeout_s=first_frame_s)
    except RenderingError as reason:
        remedy = "Unset MUJOCO_GL, or mend that backend." if "MUJOCO_GL" in os.environ else ""
        return ["rendering: nothing renders"], [Finding("error", str(reason), remedy)]
    findings: list[Finding] = []
    gl = rendering.backend_card()
    facts = [
        f"rendering with {backend} ({gl['gl_renderer']}, {gl['gl_kind']}), milliseconds per agent step "
        "(physics and one image)"
    ]
    if has_gpu and gl["gl_kind"] == "software":
        findings.append(
            Finding(
                "warning",
                f"There is a GPU, but {backend} renders in software, about twenty times slower.",
                "Install the GL parts of the GPU's driver; in a container start it with "
                "NVIDIA_DRIVER_CAPABILITIES=all.",
            )
        )
    for entry in render_domains(names, backend, first_frame_s + 20 * len(names)):
        if entry["agent_step_ms"] is None:
            facts.append(f"  {entry['domain']:<24}   failed")
        else:
            facts.append(
                f"  {entry['domain']:<24}{entry['agent_step_ms']:>8.1f}   reset {entry['reset_ms']:.0f}"
            )
        if entry["error"]:
            remedy = "Try another backend: MUJOCO_GL=osmesa or MUJOCO_GL=egl."
            if not entry["is_drawing"]:
                remedy = "The message says what the world lacks; no other backend would help."
            findings.append(Finding("error", f"{entry['domain']} with {backend}: {entry['error']}", remedy))
    return facts, findings


def _installed() -> dict[str, str]:
    names = {Requirement(text).name.lower() for text in _requirements()} | set(_LEFTOVERS)
    found = {}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _requirements() -> list[str]:
    """Return what the package declares, extras excepted; nothing if it is not installed."""
    try:
        declared = importlib.metadata.requires("crptpro") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return [text for text in declared if "extra ==" not in text]


if __name__ == "__main__":
    arguments = sys.argv[1:]
    while arguments[:1] == [FLAG]:
        load_plugin(arguments[1])
        arguments = arguments[2:]
    for domain_name in arguments:
        sys.stdout.write(json.dumps(check_domain(domain_name)) + "\n")
        sys.stdout.flush()
