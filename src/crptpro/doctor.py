"""Would a run work on this machine? Versions, hardware and every domain on every backend, in plain words."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import psutil
from packaging.requirements import Requirement

from crptpro import cards
from crptpro.domains import PAPER_DOMAINS, expand_groups
from crptpro.errors import CRPTproError, RenderingError

#: Outside their declared range these are known to break; others are merely untested.
_BREAKING = ("mujoco", "dm-control", "torchrl", "tensordict")
_LEFTOVERS = ("mujoco-core", "mujoco-studio")
_GB = 1e9


@dataclass(frozen=True)
class Finding:
    """Something to know: an error stops a run, a warning may spoil one, a note does neither."""

    severity: Literal["error", "warning", "note"]
    what: str
    remedy: str = ""


@dataclass(frozen=True)
class BackendCheck:
    """How one GL backend did.

    Args:
        backend: Its name.
        is_chosen: A run would use it.
        gl: GL vendor, renderer, version and kind, from the driver; empty if it does not render.
        domains: One entry per domain, as :func:`crptpro.envs.render_check.check_domain` describes.
    """

    backend: str
    is_chosen: bool
    gl: dict[str, Any]
    domains: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True)
class DoctorReport:
    """What :func:`run_doctor` found."""

    versions: dict[str, str]
    hardware: dict[str, Any]
    free_ram_bytes: int
    free_disk_bytes: int
    disk: str
    backends: tuple[BackendCheck, ...]
    findings: tuple[Finding, ...] = field(default=())

    @property
    def ok(self) -> bool:
        """True only if a run would work."""
        return not any(finding.severity == "error" for finding in self.findings)

    def text(self) -> str:
        """Return the report as plain text, a line per fact, problems and their remedies last."""
        lines = ["versions", *_columns(self.versions.items()), "", "machine"]
        gpus = ", ".join(self.hardware["gpus"]) or "none"
        total = self.hardware["ram_bytes"]
        lines += [
            f"  CPU   {self.hardware['cpu']} ({self.hardware['cpu_instructions']}), {self.hardware['cpu_cores']} cores",
            f"  GPU   {gpus}",
            f"  RAM   {self.free_ram_bytes / _GB:.1f} GB free of {total / _GB:.1f} GB",
            f"  disk  {self.free_disk_bytes / _GB:.1f} GB free at {self.disk}",
            "",
            "rendering, milliseconds per agent step (physics and one image)",
        ]
        for check in self.backends:
            chosen = "  <- a run uses this one" if check.is_chosen else ""
            kind = f"{check.gl['gl_renderer']}, {check.gl['gl_kind']}" if check.gl else "does not render"
            lines.append(f"  {check.backend}: {kind}{chosen}")
            lines += [f"    {_domain_line(entry)}" for entry in check.domains]
        lines.append("")
        for finding in self.findings:
            lines.append(f"{finding.severity}: {finding.what}")
            if finding.remedy:
                lines.append(f"  what to do: {finding.remedy}")
        return "\n".join([*lines, "A run would work." if self.ok else "A run would not work."])


def run_doctor(
    domains: Iterable[str] | None = None,
    *,
    backends: Sequence[str] | None = None,
    root: str | Path = ".",
    timeout_s: float | None = None,
) -> DoctorReport:
    """Check versions and hardware, and render every domain with every backend, each in a process of its own.

    Args:
        domains: As for :func:`crptpro.domains.expand_groups`; by default the paper's eight domains.
        backends: By default EGL, OSMesa, the one that ``MUJOCO_GL`` names, and GLFW where there is a display.
        root: Where data would be written; its disk is looked at.
        timeout_s: Seconds per backend; by default 60 for the first frame and 20 more for each domain.

    Raises:
        UnknownNameError: for a domain that nobody knows.
    """
    names = tuple(expand_groups(domains if domains is not None else PAPER_DOMAINS))
    disk = _existing(Path(root))
    free_disk = shutil.disk_usage(disk).free
    free_ram = psutil.virtual_memory().available
    findings = [*check_versions(_installed(), _requirements()), *_check_room(free_ram, free_disk, str(disk))]
    hardware = cards.hardware()
    checks: tuple[BackendCheck, ...] = ()
    try:
        checks, rendering = _check_rendering(names, backends, timeout_s, has_gpu=bool(hardware["gpus"]))
        findings += rendering
    except CRPTproError as reason:  # MUJOCO_GL is wrong: nothing can be tried before it is put right
        findings.append(Finding("error", str(reason)))
    unusable = [gpu for gpu in hardware["gpus"] if gpu.startswith(cards.UNUSABLE)]
    for gpu in unusable:
        findings.append(
            Finding(
                "warning",
                f"torch cannot use a GPU: {gpu}.",
                "Repair its driver (nvidia-smi), or hide it with CUDA_VISIBLE_DEVICES; --device cpu always works.",
            )
        )
    if not hardware["gpus"]:
        findings.append(Finding("note", "torch sees no GPU; training runs on the CPU."))
    order = ("error", "warning", "note")
    findings.sort(key=lambda finding: order.index(finding.severity))
    return DoctorReport(cards.versions(), hardware, free_ram, free_disk, str(disk), checks, tuple(findings))


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
            severity: Literal["error", "warning"] = "error" if name in _BREAKING else "warning"
            reach = f"{name} {version} is outside {requirement.specifier}"
            why = ", which is known to break." if severity == "error" else ", which has not been tested."
            findings.append(Finding(severity, reach + why, wanted))
    leftovers = [name for name in _LEFTOVERS if name in installed]
    if leftovers:
        findings.append(
            Finding(
                "warning",
                f"{' and '.join(leftovers)} belong to MuJoCo 4 and break the import of MuJoCo 3.",
                f'pip uninstall -y {" ".join(leftovers)}; pip install --force-reinstall "mujoco>=3.17,<4"',
            )
        )
    return findings


def _check_room(free_ram: int, free_disk: int, disk: str) -> list[Finding]:
    findings = []
    if free_ram < 4 * _GB:
        findings.append(
            Finding(
                "error" if free_ram < 1.5 * _GB else "warning",
                f"{free_ram / _GB:.1f} GB of RAM are free; pre-training at batch 512 and a replay of 40,000 "
                "transitions want about 4 GB.",
                "End other programs, or use smaller batches and a smaller replay.",
            )
        )
    if free_disk < 7 * _GB:
        findings.append(
            Finding(
                "error" if free_disk < 0.5 * _GB else "warning",
                f"{free_disk / _GB:.1f} GB are free at {disk}; three domains of 100,000 transitions take 6.",
                "Free space, write to another disk, or collect fewer transitions.",
            )
        )
    return findings


def _check_rendering(
    names: tuple[str, ...], backends: Sequence[str] | None, timeout_s: float | None, *, has_gpu: bool
) -> tuple[tuple[BackendCheck, ...], list[Finding]]:
    # Imported late: the import itself complains about a wrong MUJOCO_GL.
    from crptpro.envs.gl_process import attempt_backend, canonical_backend
    from crptpro.envs.render_check import render_domains
    from crptpro.envs.rendering import default_timeout_s, explain, platform_candidates

    requested = canonical_backend(os.environ["MUJOCO_GL"]) if "MUJOCO_GL" in os.environ else None
    asked = platform_candidates() if backends is None else map(canonical_backend, backends)
    backends = tuple(dict.fromkeys([*([requested] if requested and backends is None else []), *asked]))
    if "off" in (requested, *backends):
        raise RenderingError("MUJOCO_GL switches rendering off; unset it, or set it to egl or osmesa.")
    first_frame_s = default_timeout_s() if timeout_s is None else timeout_s
    checks: list[BackendCheck] = []
    findings: list[Finding] = []
    chosen: str | None = None
    for backend in backends:
        attempt = attempt_backend(backend, timeout_s=first_frame_s)
        is_chosen = attempt.is_ok and (backend == requested if requested else chosen is None)
        if not attempt.is_ok:
            findings.append(_failed(explain(attempt, first_frame_s), is_requested=backend == requested))
            checks.append(BackendCheck(backend, False, {}))
            continue
        chosen = backend if is_chosen else chosen
        limit_s = first_frame_s + 20 * len(names) if timeout_s is None else timeout_s
        entries = render_domains(names, backend, limit_s)
        checks.append(BackendCheck(backend, is_chosen, attempt.answer, entries))
        findings += [_dead(entry, backend, is_chosen) for entry in entries if not entry["alive"]]
        if is_chosen and has_gpu and attempt.answer["gl_kind"] == "software":
            findings.append(
                Finding(
                    "warning",
                    f"There is a GPU, but {backend} renders in software, about twenty times slower.",
                    "Install the GL parts of the GPU's driver; in a container start it with "
                    "NVIDIA_DRIVER_CAPABILITIES=all.",
                )
            )
    if chosen is None and requested is None:
        findings.append(
            Finding("error", "No GL backend renders a frame.", "Install one, see the notes below.")
        )
    elif chosen is None and requested not in backends:
        findings.append(
            Finding(
                "error",
                f"A run would use {requested}, which MUJOCO_GL names, but only {', '.join(backends)} was tried.",
                f"Try {requested} as well, or set MUJOCO_GL to one that was tried.",
            )
        )
    return tuple(checks), findings


def _failed(explanation: str, *, is_requested: bool) -> Finding:
    if not is_requested:
        return Finding("note", explanation)
    return Finding("error", f"MUJOCO_GL is set, and does not render. {explanation}", "Unset MUJOCO_GL.")


def _dead(entry: dict[str, Any], backend: str, is_chosen: bool) -> Finding:
    remedy = f"Nothing, as long as MUJOCO_GL={backend} is not set."
    what = f"{entry['domain']} with {backend}: {entry['error'] or 'its pixels are constant or do not change'}"
    if is_chosen and entry.get("is_drawing", True):
        remedy = "Try another backend: MUJOCO_GL=osmesa or MUJOCO_GL=egl."
    elif is_chosen:
        remedy = "The message says what the world lacks; no other backend would help."
    return Finding("error" if is_chosen else "note", what, remedy)


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


def _existing(path: Path) -> Path:
    path = path.absolute()
    while not path.exists():
        path = path.parent
    return path


def _columns(items: Iterable[tuple[str, str]]) -> list[str]:
    return [f"  {name:<12}{value}" for name, value in items]


def _domain_line(entry: dict[str, Any]) -> str:
    if entry["agent_step_ms"] is None:
        return f"{entry['domain']:<24}   failed"
    state = "" if entry["alive"] else "   pixels are dead"
    return f"{entry['domain']:<24}{entry['agent_step_ms']:>8.1f}   reset {entry['reset_ms']:.0f}{state}"
