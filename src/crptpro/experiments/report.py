"""One page on a reproduction, or on any downstream runs: tables beside the paper's, figures, and what is missing.

:func:`build_report` reads what ``crptpro reproduce`` left (:func:`crptpro.experiments.jobs.load_results`) and writes
``index.html``, the same as ``report.md``, and ``figures/*.png``. An experiment is reported by the kinds of its jobs, so
that those of a plugin have their section, too. Nothing stands in for what is missing.
"""

from __future__ import annotations

import datetime
import io
import logging
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from crptpro.artifact import read_json, write_whole
from crptpro.errors import CRPTproError, RecordError
from crptpro.experiments import published
from crptpro.experiments.figures import curves, dots, in_order, scatter
from crptpro.experiments.jobs import load_results
from crptpro.experiments.launch import duration
from crptpro.experiments.matrix import EXPERIMENTS
from crptpro.experiments.statistics import (
    CONFIDENCE,
    COVERAGE,
    MIN_RUNS,
    REPLICATES,
    estimate,
    iqm,
    mean,
    median,
    optimality_gap,
    probability_of_improvement,
    relative_mean,
)
from crptpro.values import as_path

logger = logging.getLogger(__name__)

ENCODERS = ("encoder", "explored", "finetuned", "untrained")
"""Kinds of jobs that make an encoder."""


def build_report(root: str | Path, *, out: str | Path | None = None) -> Path:
    """Write a report on a reproduction, or on any directory with downstream runs.

    Args:
        root: directory of ``crptpro reproduce``, finished or not, or one with downstream runs in or below it.
        out: directory of the report; ``root/report`` if not given.

    Returns:
        The HTML page.

    Raises:
        RecordError: there is no such directory, or nothing in it to report on.
        OSError: the report cannot be written.
    """
    root = as_path(root, "directory")
    if not root.is_dir():
        raise RecordError(f"There is no directory {root} to report on.")
    results = load_results(root)
    cells, jobs = (results.cells, results.jobs) if len(results.cells) else _unplanned_runs(root)
    jobs["machine"] = [_machine(job) for _, job in jobs.iterrows()]
    places = {name: place for place, name in enumerate([*EXPERIMENTS, *cells["experiment"]])}
    cells = cells.sort_values("experiment", key=lambda names: names.map(places), kind="stable")
    page = Page(root / "report" if out is None else as_path(out, "out"))
    _contents(page, cells, jobs)
    _limits(page, cells, jobs)
    for (experiment, scale), own in cells.groupby(["experiment", "scale"], sort=False):
        order = {label: place for place, label in enumerate(in_order(own["label"]))}
        own = own.sort_values("label", key=lambda labels, order=order: labels.map(order), kind="stable")
        _experiment(page, experiment, scale, own.dropna(axis=1, how="all").reset_index(drop=True), jobs)
    _provenance(page, jobs)
    scales = " and ".join(dict.fromkeys(filter(None, cells["scale"])))
    now = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d at %H:%M} UTC"
    return page.write(
        f"CRPTpro: reproduction at scale {scales}" if scales else "CRPTpro: downstream runs",
        "Cross-domain random pre-training with prototypes (arXiv 2302.05614): what was measured here, beside the "
        f"numbers that the paper printed. Made on {now} from {root.resolve().name}.",
    )


class Page:
    """A page of sections, each with texts, tables and figures in the order in which they are added.

    Args:
        folder: gets ``index.html``, ``report.md`` and ``figures/*.png``.
    """

    def __init__(self, folder: str | Path) -> None:
        """Start an empty page."""
        self.folder = Path(folder)
        self.sections: list[dict[str, Any]] = []

    def section(self, title: str, anchor: str) -> None:
        """Begin a section; one that stays empty is left out."""
        self.sections.append({"title": title, "anchor": _plain(anchor), "parts": []})

    def text(self, text: str, style: str = "") -> None:
        """Add a paragraph; its style may be ``note`` or ``warning``."""
        self._add(kind="text", text=text, style=style)

    def bullets(self, lines: Iterable[str]) -> None:
        """Add a list."""
        self._add(kind="bullets", lines=list(lines))

    def table(
        self, caption: str, rows: pd.DataFrame | Sequence[Mapping[str, Any]], fold: bool = False
    ) -> None:
        """Add a table, or nothing for no rows; empty cells become dashes. A reader opens it if it is to ``fold``."""
        frame = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows))
        if len(frame):
            shown = [
                [
                    "\N{EN DASH}" if value is None or value != value or value == "" else str(value)
                    for value in row
                ]
                for row in frame.itertuples(index=False)
            ]
            self._add(kind="table", caption=caption, columns=[*map(str, frame)], rows=shown, fold=fold)

    def figure(self, name: str, caption: str, figure: Any) -> None:
        """Write a figure and show it; the same numbers give the same file."""
        file, pixels = f"figures/{_plain(name)}.png", io.BytesIO()
        figure.savefig(pixels, format="png", dpi=110, metadata={"Software": None})
        write_whole(self.folder / file, pixels.getvalue())
        self._add(kind="figure", file=file, caption=caption)

    def write(self, title: str, summary: str) -> Path:
        """Write both files; returns the HTML page."""
        from jinja2 import Environment, PackageLoader, select_autoescape

        loader, escape = PackageLoader("crptpro.experiments"), select_autoescape(["html.j2"])
        environment = Environment(loader=loader, autoescape=escape, trim_blocks=True, lstrip_blocks=True)
        environment.filters |= {"md": _markdown, "md_table": markdown_table}
        sections = [section for section in self.sections if section["parts"]]
        about = {"title": title, "summary": summary, "sections": sections}
        for name in ("index.html", "report.md"):
            write_whole(self.folder / name, environment.get_template(f"{name}.j2").render(about))
        return self.folder / "index.html"

    def _add(self, **part: Any) -> None:
        self.sections[-1]["parts"].append(part)


def markdown_table(rows: Sequence[Sequence[Any]], columns: Sequence[str]) -> str:
    """Lay rows out as a Markdown table.

    Examples:
        >>> print(markdown_table([["walker_run", 512]], ["task", "return"]))
        | task | return |
        | --- | --- |
        | walker_run | 512 |
    """
    lines = [[*map(_markdown, columns)], ["---"] * len(columns), *([*map(_markdown, row)] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _markdown(text: Any) -> str:
    """Keep a name or a sentence what it is: no HTML, no link, no new line or cell."""
    shown = str(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"\s*[\r\n]\s*", " · ", re.sub(r"([\\`*\[\]|])", r"\\\1", shown))


def _plain(name: str) -> str:
    """For anchors and files, whatever a user calls an experiment."""
    return re.sub(r"[^a-zA-Z0-9]+", "-", name).strip("-")


# --- reading --------------------------------------------------------------------------------------------------------


def _read(path: Path, *columns: str) -> pd.DataFrame:
    """Read a CSV record that has rows, and finite numbers in the columns named."""
    try:
        table = pd.read_csv(path)
    except FileNotFoundError:
        raise RecordError(f"{path.parent.name} has no {path.name}.") from None
    except (OSError, ValueError) as reason:  # pandas' own errors are ValueErrors
        raise RecordError(f"{path} cannot be read: {reason}.") from None
    for column in columns:
        if column not in table or not len(table):
            raise RecordError(f"{path} has no {f'column `{column}`' if len(table) else 'rows'}.")
        if not np.isfinite(pd.to_numeric(table[column], errors="coerce")).all():
            raise RecordError(f"{path} is damaged: a `{column}` in it is no finite number.")
    return table


def _records(
    page: Page, cells: pd.DataFrame, jobs: pd.DataFrame, kinds: Sequence[str], name: str, *columns: str
) -> pd.DataFrame:
    """Read ``<name>.csv`` of every finished job of these kinds; the places of its cells stand beside as ``at_...``."""
    found = []
    own = cells[cells["done"].astype(bool) & cells["job"].map(jobs["kind"]).isin(kinds)]
    for cell in own.to_dict("records"):
        try:
            table = _read(jobs.loc[cell["job"], "path"] / f"{name}.csv", *columns)
            found.append(table.assign(**{f"at_{place}": value for place, value in cell.items()}))
        except RecordError as reason:
            if jobs.loc[cell["job"], "kind"] != "untrained":  # which leaves no record
                page.text(f"Left out: {reason}", "warning")
    return pd.concat(found, ignore_index=True) if found else pd.DataFrame()


def _words(values: pd.Series | None, default: str = "") -> Any:
    """Return places as words: what was a JSON integer before a column had gaps is one again."""
    if values is None:
        return default
    whole = values.map(lambda v: int(v) if isinstance(v, float) and v.is_integer() else v)
    return whole.astype(object).where(values.notna(), default).astype(str)


def _needed(key: str, jobs: pd.DataFrame, *kinds: str) -> list[str]:
    """Return a job and everything that it stands on, each once; those of some kinds if any are named."""
    found: dict[str, None] = {}
    waiting = [key]
    while waiting:
        if (one := waiting.pop(0)) not in found and one in jobs.index:
            found[one] = None
            waiting += jobs.loc[one, "needs"] or []
    return [key for key in found if not kinds or jobs.loc[key, "kind"] in kinds]


def _unplanned_runs(root: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Find downstream runs that no experiment planned, and describe them as cells and jobs.

    Runs of one method on one task are seeds of each other only if they agree in everything else: where they do not, the
    label names what differs, as in ``"crptpro, env_steps 20000"``.
    """
    runs = []
    for path in sorted(path.parent for path in root.rglob("eval.csv")):
        try:
            content = read_json(path / "config.json", error=RecordError)
            told = content["config"]
            facts = pd.json_normalize({"task": told["task"], **told.get("config", told)}).iloc[0].to_dict()
            episodes = _read(path / "eval.csv", "env_steps", "episode_return")
            is_done = episodes["env_steps"].max() >= facts["env_steps"]
            run = {
                "job": str(path.relative_to(root)),
                "label": str(episodes["method"].iloc[0]),
                "done": is_done,
            }
            run |= {"experiment": "runs", "scale": "", "task": facts["task"], "colors": facts.get("colors")}
            runs.append({**run, "path": path, "facts": facts, **{n: content.get(n) for n in PROVENANCE}})
        except (RecordError, KeyError, TypeError, AttributeError) as reason:
            logger.warning("Left out: %s is no downstream run that can be read (%s).", path, reason)
    if not any(run["done"] for run in runs):
        raise RecordError(
            f"{root} holds nothing to report on: no experiment of `crptpro reproduce` (experiments/*.json) and no "
            "finished downstream run."
        )
    cells = pd.DataFrame(runs)
    told = pd.DataFrame(cells["facts"].tolist()).drop(columns=NOT_TOLD_APART, errors="ignore").astype(str)
    for label, own in cells.groupby("label"):
        counts = told.loc[own.index].groupby([own["task"], _words(own["colors"])]).nunique().max()
        names = counts.index[counts > 1]
        cells.loc[own.index, "label"] = [
            ", ".join([str(label), *(f"{name} {told.loc[run, name]}" for name in names)]) for run in own.index
        ]
    of_job = ["path", "facts", *PROVENANCE]
    jobs = cells.set_index("job")[[*of_job, "done"]].assign(kind="run", machine="", device=None, threads=None)
    return cells.drop(columns=of_job), jobs.assign(seconds=np.nan, attempts=1, needs=[[] for _ in runs])


PROVENANCE = ("git_revision", "versions")
NOT_TOLD_APART = [
    "seed", "task", "colors", "device", "precision", "channels_last", "compile", "cuda_graph", "eval_workers",
    "render_ahead", "features", "video_episodes", "checkpoint_interval_env_steps", "log_interval_env_steps",
    "eval_interval_env_steps", "eval_episodes",
]  # fmt: skip
"""Settings that do not make a run another method's: its seed, where it stands, how it computed, when it wrote."""


# --- the head and the end of the page -------------------------------------------------------------------------------


def _contents(page: Page, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    page.section("What is here", "contents")
    rows = []
    for (experiment, scale), own in cells.groupby(["experiment", "scale"], sort=False):
        missing = own.loc[~own["done"].astype(bool), "label"].value_counts(sort=False)
        lacking = ", ".join(f"{label}: {count}" for label, count in missing.items()) or "nothing"
        counts = {"asked for": len(own), "finished": own["done"].sum(), "missing": lacking}
        rows.append({"experiment": experiment, "scale": scale, **counts})
    page.table("Experiments: numbers that were asked for, and those that are there.", rows)
    kinds = jobs.astype({"done": bool}).groupby("kind")["done"].agg(["sum", "count"])
    told = ", ".join(f"{done} of {count} {kind}" for kind, done, count in kinds.itertuples())
    done = jobs[jobs["done"].astype(bool)]
    hours = done["seconds"].astype(float).sum() / 3600
    page.text(f"Jobs finished: {told}; {hours:.1f} h of work in all.")
    machines, revisions = (list(dict.fromkeys(done[name].dropna())) for name in ("machine", "git_revision"))
    if revisions:
        where = "; ".join(dict.fromkeys(machine.rsplit(", ", 1)[0] for machine in machines))
        page.text(f"Made on {where}, from source revision {', '.join(revisions)}; versions are at the end.")


BUDGETS = {
    "random transitions per domain": ("transitions", ["dataset"], "", "100,000"),
    "encoder updates on datasets": ("updates", ["encoder"], "", "50,000"),
    "pre-training batch": ("batch_size", ["encoder", "explored"], "", "512, or the method's own"),
    "prototypes": ("loss.num_prototypes", ["encoder", "explored"], "crptpro|proto-rl", "512"),
    "env steps of exploration (C)": ("explore.env_steps", ["explored"], "proto-rl-c", "200,000"),
    "decisions per encoder update (C)": ("explore.encoder_update_interval", ["explored"], "proto-rl-c", "2"),
    "downstream env steps": ("env_steps", ["run"], "(?!drq)", "500,000"),
    "DrQ's env steps": ("env_steps", ["run"], "drq", "1,000,000"),
    "downstream batch": ("batch_size", ["run"], "", "512"),
    "downstream learning rate": ("learning_rate", ["run"], "", "0.0001"),
    "downstream replay": ("replay_capacity", ["run"], "", "40,000 (Proto-RL 100,000)"),
    "render quality": ("quality", ["dataset"], "", "exact"),
}
"""Budget to the fact of jobs that holds it, their kinds, which methods, and the paper's."""
SHORTCOMINGS = (
    "Which method is ahead after a small part of the budget does not say which is ahead after all of it: methods that "
    "learn late look worse here than they are.",
    "The prototype loss first stays near ln M, for over a thousand updates at batch 512; an encoder of few updates may "
    "not have left that plateau.",
    f"Few runs: with fewer than {MIN_RUNS} on a task this page gives no intervals, and two or three rank nothing. The "
    "paper has at least six evaluations per number; three runs on one encoder, the default here, are fewer.",
    "A smaller batch, replay or dataset changes the method and not only its budget.",
)


def _limits(page: Page, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Show the budgets of every scale beside the paper's, as its jobs have them, and what they cannot show."""
    page.section("What this scale cannot show", "limits")
    below = cells[cells["scale"] != "paper"]
    if below.empty:
        return
    table = pd.DataFrame({"budget": [*BUDGETS, "downstream seeds per encoder"]})
    for scale, own in below.groupby("scale", sort=False):
        here = jobs.loc[list({key: 0 for job in own["job"].unique() for key in _needed(job, jobs)})]
        told = here["facts"].map(lambda facts: facts or {})
        facts = pd.json_normalize(told.tolist()).set_index(here.index)
        methods = told.map(lambda facts: facts.get("method", "")).astype(str)
        values = []
        for fact, kinds, method, _ in BUDGETS.values():
            is_meant = here["kind"].isin(kinds) & methods.str.match(method)
            found = facts.loc[is_meant, fact].dropna() if fact in facts else pd.Series()
            words = [v if isinstance(v, str) else f"{v:,}".removesuffix(".0") for v in sorted(found.unique())]
            values.append(" or ".join(words + ["the paper's"] * bool(len(found) < is_meant.sum())))
        runs = own[own["job"].map(jobs["kind"]) == "run"].drop_duplicates("job")
        encoders = [(task, *_needed(job, jobs)[1:2]) for job, task in zip(runs["job"], runs.get("task", ()))]
        table[str(scale) or "here"] = [*values, _or(pd.Series(encoders).value_counts())]
    table["the paper's"] = [
        *(paper for *_, paper in BUDGETS.values()),
        "not printed (at least 6 evaluations)",
    ]
    page.table("Budgets beside the paper's; a dash stands where nothing was asked for.", table)
    page.text("What this cannot show:", "warning")
    page.bullets(SHORTCOMINGS)


def _provenance(page: Page, jobs: pd.DataFrame) -> None:
    page.section("Versions and hardware", "provenance")
    done = jobs[jobs["done"].astype(bool)].copy()
    done["hardware"] = done["machine"].astype(str).str.rsplit(", ", n=1).str[0]
    done["source revision"] = done["git_revision"]
    for column in ("hardware", "source revision"):
        counts = done[column].fillna("not recorded").value_counts()
        page.table(column.capitalize(), counts.rename_axis(column).reset_index(name="jobs"))
    sets = done["versions"].map(lambda told: tuple(sorted((told or {}).items()))).value_counts()
    versions = pd.DataFrame({f"version ({_count(n, 'job')})": dict(told) for told, n in sets.items()})
    page.table("Versions", versions.rename_axis("package").reset_index())
    page.section("Jobs", "jobs")
    for kind, own in jobs.groupby("kind"):
        page.table(
            f"{kind}: {_count(len(own), 'job')}", [_card(key, job) for key, job in own.iterrows()], fold=True
        )


def _card(key: Any, job: pd.Series) -> dict[str, Any]:
    """Say what determines a job, what it took, and which weights it left."""
    weights = [
        _json(job["path"] / name / "card.json").get("weights_sha256", "") for name in ("encoder", "agent")
    ]
    command = map(str, _json(job["path"] / "job.json").get("command", ()))
    attempts = f" in {job['attempts']:.0f} attempts" if job["attempts"] and job["attempts"] > 1 else ""
    return {
        "job": key, "state": _state(job), "wall clock": _time([job["seconds"]]) + attempts, "made on": job["machine"],
        "revision": job["git_revision"], "command": shlex.join(["crptpro", *command]), "weights": "".join(weights)[:12],
    }  # fmt: skip


def _state(job: pd.Series) -> str:
    if job["done"]:
        return "finished"
    return "begun, not finished" if (job["path"] / "log.txt").exists() else "not begun"


def _machine(job: pd.Series) -> str | None:
    """Return machine and device, or threads; nothing of what is not finished."""
    if not job["done"]:
        return None
    device = job["device"] or "cpu"
    if device == "cpu" and not pd.isna(job["threads"]):
        device = _count(int(job["threads"]), "thread")
    return f"{job['machine'] or 'machine not recorded'}, {device}"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def _time(seconds: Sequence[float | None]) -> str:
    """Return a mean duration in words; nothing where one is not known."""
    known = [math.nan if value is None else float(value) for value in seconds]
    average = sum(known) / len(known) if known else math.nan
    return "" if math.isnan(average) else duration(average)


def _known(value: float, spec: str) -> str:
    return "" if math.isnan(value) else f"{value:{spec}}"


def _or(values: Iterable[float]) -> str:
    return " or ".join(f"{value:,.0f}" for value in sorted(set(values)) if not math.isnan(value))


def _beside(text: str, paper: Any) -> str:
    """Put the paper's number below one's own."""
    return "\n".join(filter(None, [text, f"paper {paper}" if paper not in (None, "") else ""]))


def _spread(values: Iterable[float], digits: int, n: bool = True) -> str:
    """Print mean ± standard deviation (n); one number has no deviation."""
    own = np.asarray(list(values), float)
    deviation = f" ± {own.std(ddof=1):.{digits}f}" if len(own) > 1 else ""
    return f"{own.mean():.{digits}f}{deviation}" + (f" (n = {len(own)})" if n else "")


class Machines:
    """Numbers of machines, in the order in which a table names them."""

    def __init__(self) -> None:
        """Start without any."""
        self.numbers: dict[str, int] = {}

    def of(self, names: Iterable[str | None]) -> str:
        """Return the numbers of what was made together; a machine that has none yet gets the next."""
        found = [
            self.numbers.setdefault(name, len(self.numbers) + 1) for name in sorted({n for n in names if n})
        ]
        return ", ".join(map(str, sorted(found)))

    def __str__(self) -> str:
        """Say which is which."""
        names = "; ".join(f"{number}: {name}" for name, number in self.numbers.items())
        return f"Made on {names}. Times compare only within one machine, and jobs that shared one slowed each other."


# --- one experiment -------------------------------------------------------------------------------------------------


def _experiment(page: Page, experiment: str, scale: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Report an experiment by the kinds of its jobs."""
    name = _plain(f"{experiment}-{scale}")
    known = EXPERIMENTS.get(experiment)  # a plugin's own may not be loaded here
    page.section(f"{known.title if known else experiment}{f' ({scale})' if scale else ''}", name)
    if known:
        page.text(known.summary)
    missing = cells[~cells["done"].astype(bool)]
    if len(missing) == len(cells):
        page.text(f"Nothing is finished yet: {_count(len(cells), 'number')} asked for.", "warning")
        return
    if len(missing):
        counts = ", ".join(f"{label} {n}" for label, n in missing["label"].value_counts(sort=False).items())
        there = f"{len(cells) - len(missing)} of {len(cells)} numbers are there; missing: {counts}."
        page.text(f"{there} Nothing stands in for what is missing.", "warning")
        places = missing.drop(columns=["experiment", "scale", "done"]).rename(columns={"label": "system"})
        states = [_state(jobs.loc[job]) if job in jobs.index else "not begun" for job in missing["job"]]
        page.table(f"The {len(missing)} that are missing", places.assign(state=states), fold=True)
    else:
        page.text(f"Complete: {len(cells)} of {len(cells)} numbers are there.")
    cells = cells.assign(group=_words(cells.get("group")), encoder_seed=_words(cells.get("encoder_seed")))
    for measure in (_measurements, _efficiency, _scores):
        measure(page, name, cells, jobs)


# --- downstream scores ----------------------------------------------------------------------------------------------

LAST = 10
"""Evaluations at the end that a steadier score averages over."""


def _scores(page: Page, name: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    episodes = _records(page, cells, jobs, ["run"], "eval", "env_steps", "episode_return", "updates")
    if episodes.empty:
        return
    runs, points = _runs(episodes, jobs)
    told = (
        f"Runs of {_or(runs['budget'])} env steps here. n is the number of runs that a number stands on; “paper” is "
        f"what it printed, after {published.ENV_STEPS:,} env steps (DrQ: {published.DRQ_ENV_STEPS:,}). It has numbers "
        "for CRPTpro, ATC, APT(C), Proto-RL(C), BeCL and, on seen domains, DrQ."
    )
    below = " Scores of a smaller budget do not compare with the paper's."
    page.text(told + below * bool(runs["budget"].min() < published.ENV_STEPS), "note")
    for varied, part in runs.groupby("varied", sort=False):
        of = f", mean ± standard deviation over runs (n).{f' {varied} varied.' if varied else ''}"
        _score_table(page, part, "score", f"Episode return at the final evaluation{of}")
        long = part[part["evaluations"] >= LAST]
        _score_table(page, long, "last_score", f"Episode return over the last {LAST} evaluations{of}")
        if varied:
            _sensitivity(page, f"{name}-{varied}", part, str(varied))
    _aggregates(page, runs)
    _learning_curves(page, name, runs, points)
    _spending(page, runs, jobs)


def _runs(episodes: pd.DataFrame, jobs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return a row per run with its place and scores, and one per evaluation with env steps and mean return."""
    runs, points = [], []
    for _, own in episodes.groupby(["at_label", "at_job", "at_group"], sort=False):
        cell = own.iloc[0]
        path, job = jobs.loc[cell["at_job"], "path"], cell["at_job"]
        colors = cell["at_colors"] if isinstance(cell.get("at_colors"), str) else "normal"
        varied, value = (
            str(cell[at]) if at in cell and cell[at] == cell[at] else "" for at in ("at_varied", "at_value")
        )
        task = f"{cell['at_group']} {cell['at_task']}{'' if colors == 'normal' else f', {colors}'}".strip()
        curve = own.groupby("env_steps")["episode_return"].mean()
        encoders = _needed(job, jobs, *ENCODERS)
        # Runs on encoders that were fine-tuned from one base share it: it is their one draw of a pre-training.
        encoder = encoders[-1] if encoders else _json(path / "agent" / "card.json").get("pretrained") or job
        runs.append({
            "label": cell["at_label"], "task": task, "run": job, "encoder": encoder, "group": cell["at_group"],
            "task_name": cell["at_task"], "colors": colors, "varied": varied, "value": value,
            "score": curve.iloc[-1], "last_score": curve.iloc[-LAST:].mean(), "evaluations": len(curve),
            "budget": own["env_steps"].max(), "updates": own["updates"].max(),
            "expert": published.EXPERT_SCORES.get(cell["at_task"], math.nan),
        })  # fmt: skip
        about = {name: runs[-1][name] for name in ("label", "task", "run", "encoder")}
        points.append(curve.reset_index(name="score").assign(**about))
    runs = pd.DataFrame(runs).sort_values("group", kind="stable").reset_index(drop=True)
    return runs, pd.concat(points, ignore_index=True)


def _json(path: Path) -> dict[str, Any]:
    """Read a file that a page can do without; empty if it is not there, or damaged."""
    try:
        return dict(read_json(path, error=RecordError))
    except (RecordError, OSError, TypeError, ValueError):
        return {}


def _score_table(page: Page, runs: pd.DataFrame, score: str, caption: str) -> None:
    """Show a row per task as the paper does, or per method where few tasks have many methods."""
    if runs.empty:
        return
    cells = {}
    for (task, *place), here in runs.groupby(["task", "group", "task_name", "colors"], sort=False):
        for label in runs["label"].unique():
            values = here.loc[here["label"] == label, score]
            text = _spread(values, 0 if abs(values.mean()) >= 10 else 1) if len(values) else ""
            cells[label, task] = _beside(text, published.published_score(label, *place))
    labels, tasks = in_order(runs["label"]), list(runs["task"].unique())
    if len(tasks) <= 3 < len(labels):
        page.table(caption, [{"method": label} | {t: cells[label, t] for t in tasks} for label in labels])
    else:
        page.table(caption, [{"task": t} | {label: cells[label, t] for label in labels} for t in tasks])


def _aggregates(page: Page, runs: pd.DataFrame) -> None:
    """Aggregate over the tasks on which every method has runs."""
    labels = in_order(runs["label"])
    has_run = runs.groupby(["task", "label"], sort=False).size().unstack().reindex(columns=labels).notna()
    shared = has_run.index[has_run.all(axis=1)]
    if lacking := "; ".join(
        f"{task} (no run of {', '.join(row.index[~row])})"
        for task, row in has_run.iterrows()
        if not row.all()
    ):
        page.text(f"Left out of everything that compares methods: {lacking}.", "note")
    if shared.empty:
        page.text("There is no task on which every method has a run: nothing to aggregate.", "note")
        return
    kept = runs[runs["task"].isin(shared)]
    normal = kept.assign(score=kept["score"] / kept["expert"]).dropna(subset="expert")
    drq = kept[kept["label"] == "drq"]
    places = kept[["group", "task_name", "colors"]].drop_duplicates().values.tolist()
    rows = []
    for label in labels:
        own, own_normal = (frame[frame["label"] == label] for frame in (kept, normal))
        found = estimate(mean, own)
        encoders = own.loc[own["encoder"] != own["run"], "encoder"].nunique()
        row: dict[str, Any] = {
            "method": label,
            "tasks": len(shared),
            "runs": found.runs,
            "encoders": encoders,
        }
        row["mean score"] = _beside(f"{found:.0f}", _paper_mean(label, places))
        if len(normal):
            row["mean / DrQ"] = _beside(
                f"{estimate(mean, own_normal):.3f}", _paper_mean(label, places, normalized=True)
            )
            row["IQM / DrQ"] = f"{estimate(iqm, own_normal):.3f}"
            row["median / DrQ"] = f"{estimate(median, own_normal):.3f}"
            row["optimality gap"] = f"{estimate(optimality_gap, own_normal):.3f}"
        if (drq["score"] > 0).all() and len(drq):
            row["mean / DrQ here"] = "1" if label == "drq" else f"{estimate(relative_mean, own, drq):.3f}"
        rows.append(row)
    page.table(
        f"Over the {_count(len(shared), 'task')} that all methods share. A task counts once per group and colours, a "
        "run of several once. Normalised scores are divided by the paper's DrQ; “paper” is what it printed for all of "
        "its tasks, or what its cells for these give.",
        rows,
    )
    fewest = kept.groupby(["label", "task"]).size().groupby("label").min()
    held = "; ".join(f"{count}: {share:.0%}" for count, share in COVERAGE.items())
    if fewest.max() >= MIN_RUNS:
        page.text(
            f"Brackets are {CONFIDENCE:.0%} intervals ({REPLICATES:,} stratified bootstrap replicates, which redraw "
            "encoders and then their runs). On one encoder they speak of that encoder, not of the method that made it. "
            f"Where runs follow a normal law, those of a single task's mean hold the truth, by number of runs, {held}.",
            "warning",
        )
    if fewest.min() < MIN_RUNS:
        page.text(
            f"Intervals stand where a method has {MIN_RUNS} runs or more on every task; here some have as few as "
            f"{fewest.min()}. The standard deviations above say how far runs lie apart.",
            "warning",
        )
    if missing := sorted(kept.loc[kept["expert"].isna(), "task_name"].unique()):
        page.text(f"The paper has no DrQ score for {', '.join(missing)}: in the mean score only.", "note")
    if len(normal):
        _improvement(page, normal)


def _paper_mean(label: str, places: Sequence[Sequence[str]], normalized: bool = False) -> str:
    """Return what the paper printed for all of its seen tasks; for a part of them, what its cells give."""
    means = published.SEEN_NORMALIZED_MEAN if normalized else published.SEEN_MEAN
    digits = 3 if normalized else 0
    if {(*place[:2],) for place in places} == {row[:2] for row in published.SEEN} and label in means:
        return f"{means[label]:.{digits}f}"
    found = [
        (published.published_score(label, *place), published.EXPERT_SCORES.get(place[1])) for place in places
    ]
    if normalized:
        found = [(score, expert) for score, expert in found if expert]
    values = [score.mean / ((expert or 1) if normalized else 1) for score, expert in found if score]
    return f"{np.mean(values):.{digits}f}" if values and len(values) == len(found) else ""


def _improvement(page: Page, runs: pd.DataFrame) -> None:
    ours = runs[runs["label"] == "crptpro"]
    found = {
        label: estimate(probability_of_improvement, ours, runs[runs["label"] == label])
        for label in in_order(runs["label"])
        if len(ours) and label != "crptpro"
    }
    caption = (
        "Probability that a run of crptpro scores higher than one of the other method on the same task; 0.5 is no "
        "difference. Of two runs against two it can only be 0, 0.25, 0.5, 0.75 or 1."
    )
    title = "P(crptpro > other)"
    page.table(
        caption, [{"other method": m, "runs of both": e.runs, title: f"{e:.2f}"} for m, e in found.items()]
    )


def _ends(found: Any) -> dict[str, Any]:
    """Return an interval as columns of points; NaN where there is none."""
    ends = {end: getattr(found, end) for end in ("low", "high")}
    return {end: math.nan if at is None else at if len(at) > 1 else at[0] for end, at in ends.items()}


def _learning_curves(page: Page, name: str, runs: pd.DataFrame, points: pd.DataFrame) -> None:
    """Draw mean episode return along training, a panel per task, against env steps and against time."""
    means, thin = [], []
    for (task, label), own in points.groupby(["task", "label"], sort=False):
        numbers = own.pivot_table(
            index=["task", "encoder", "run"], columns="env_steps", values="score"
        ).dropna(axis=1)
        if numbers.empty:  # no evaluation that all runs have
            continue
        found = estimate(mean, numbers.reset_index(), columns=list(numbers))
        about = {"panel": task, "label": label}
        columns = {"x": numbers.columns, "y": found.value, "n": len(numbers)}
        means.append(pd.DataFrame({**about, **columns, **_ends(found)}))
        if found.low is None and len(numbers) > 1:  # too few for an interval: the runs themselves
            own = own.rename(columns={"env_steps": "x", "score": "y", "run": "line"})
            thin.append(own[["x", "y", "line"]].assign(**about, thin=True))
    drawn = pd.concat(means, ignore_index=True).assign(line="mean", thin=False)
    page.figure(
        f"{name}-curves",
        f"Episode return along training: mean over runs, with {CONFIDENCE:.0%} bootstrap intervals from {MIN_RUNS} "
        "runs up, below that with a thin line per run.",
        curves(pd.concat([drawn, *thin], ignore_index=True), "env steps", "episode return"),
    )


def _sensitivity(page: Page, name: str, runs: pd.DataFrame, varied: str) -> None:
    """Draw the normalised mean score against what was varied."""
    runs = runs.assign(
        score=runs["score"] / runs["expert"], size=pd.to_numeric(runs["value"], errors="coerce")
    )
    runs = runs.dropna(subset="score").sort_values(["size", "value"])
    runs["method"] = runs["label"].str.split(f", {varied} ").str[0]
    values, points = list(runs["value"].unique()), []
    for (method, value), own in runs.groupby(["method", "value"], sort=False):
        found = estimate(mean, own)
        points.append(
            {"label": method, "x": values.index(value), "y": found.value[0], "n": found.runs, **_ends(found)}
        )
    what = {"alpha": "weight of the dispersion loss (alpha)", "b": "random transitions per domain (b)"}.get(
        varied, varied
    )
    caption = (
        f"Mean score divided by the paper's DrQ against {what}; n is runs per value. Values with different tasks "
        "finished do not compare."
    )
    if points:
        page.figure(
            name, caption, curves(pd.DataFrame(points), what, "mean score / the paper's DrQ", ticks=values)
        )


def _spending(page: Page, runs: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Report what scores took: encoder updates, env steps and wall clock of every method."""
    machines, rows = Machines(), []
    if jobs.loc[list(runs["run"]), "seconds"].isna().all():
        return  # runs that nobody planned have no clock of their own
    seconds = jobs["seconds"].astype(float)
    updates = (
        jobs["facts"]
        .map(lambda told: (told or {}).get("updates", math.nan))
        .mask(jobs["kind"] == "untrained", 0)
    )
    env_steps = pd.Series([_env_steps(job) for _, job in jobs.iterrows()], index=jobs.index)
    for label in in_order(runs["label"]):
        own = runs[runs["label"] == label].drop_duplicates("run")
        chains = [list(chain) for chain in {(*_needed(run, jobs, *ENCODERS),) for run in own["run"]} if chain]
        data = [_needed(chain[0], jobs, "dataset") for chain in chains]
        before = [env_steps[[*chain, *sets]].sum(skipna=False) for chain, sets in zip(chains, data)]
        used = {key for keys in [list(own["run"]), *chains, *data] for key in keys}
        rows.append({
            "method": label,
            "encoders": len(chains),
            "encoder updates": _known(np.mean([updates[chain].sum(skipna=False) for chain in chains]), ",.0f")
            if chains else f"{own['updates'].mean():,.0f}\nwith the task",
            "env steps before": _known(np.mean(before), ",.0f") if chains else "0",
            "collecting": _time([seconds[sets].sum(skipna=False) for sets in data]) if any(data) else "",
            "pre-training": _time([seconds[chain].sum(skipna=False) for chain in chains]),
            "runs": f"{len(own)} of {_or(own['budget'])} env steps",
            "one run": _time(seconds[own["run"]].tolist()),
            "made on": machines.of(jobs.loc[list(used), "machine"]),
        })  # fmt: skip
    page.table(
        "What scores took: means over the encoders and over the runs of a method, wall clock of all attempts. "
        "Pre-training includes its exploring; an encoder that was fine-tuned counts with what it started from, and "
        "data that methods share with each of them.",
        rows,
    )
    page.text(str(machines), "note")


def _env_steps(job: pd.Series) -> float:
    """Return the env steps of a dataset or of an exploration; of other jobs none."""
    from crptpro.envs import resolve_action_repeat

    facts = job["facts"] or {}
    if job["kind"] == "explored":
        return float((facts.get("explore") or {}).get("env_steps") or facts.get("env_steps", math.nan))
    try:
        repeat = facts.get("action_repeat") or resolve_action_repeat(facts["domain"], None)
        return float(facts["transitions"] * repeat) if job["kind"] == "dataset" else 0.0
    except (CRPTproError, KeyError):  # a user's own domain that is not loaded here
        return math.nan if job["kind"] == "dataset" else 0.0


# --- cost of pre-training -------------------------------------------------------------------------------------------


def _efficiency(page: Page, name: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Hours and encoder updates of pre-training by number of domains, beside the paper's on a P100."""
    rows = _records(page, cells, jobs, ["timing"], "timing")
    if rows.empty:
        return
    rows["collecting"] = rows["collection_seconds"].astype(float) / 3600
    rows["hours"] = rows["paper_projected_hours"] + (rows["collecting"] * _to_papers_data(rows, jobs)).where(
        rows["collecting"].notna(), 0
    )
    places = rows.groupby(["device", "threads"])
    for (device, threads), own in places:
        where = f"{device}, {_count(int(threads), 'thread')}"
        _timed_on(page, f"{name}-{where}" if len(places) > 1 else name, where, own, jobs)


def _to_papers_data(rows: pd.DataFrame, jobs: pd.DataFrame) -> pd.Series:
    """Return how many times the transitions of a timing's data the paper's are."""
    needed = rows["at_job"].map(lambda job: [jobs.loc[key, "facts"] for key in _needed(job, jobs, "dataset")])
    return needed.map(
        lambda facts: 100_000 / np.mean([told["transitions"] for told in facts]) if facts else math.nan
    )


def _timed_on(page: Page, name: str, where: str, rows: pd.DataFrame, jobs: pd.DataFrame) -> None:
    machines, table, points = Machines(), [], []
    most = int(rows["domains"].max())
    for (method, count), own in rows.groupby(["method", "domains"], sort=False):
        average = own.mean(numeric_only=True)
        made_on = machines.of(jobs.loc[own["at_job"], "machine"])
        hours = updates = math.nan
        if method in published.EFFICIENCY and count in (1, 2, 3):
            hours, updates = (told[count - 1] for told in published.EFFICIENCY[method])
        table.append({
            "method": method, "domains": count,
            "s per encoder update": f"{average['seconds_per_update']:.3g} (n = {len(own)})",
            "s per decision": _known(average["seconds_per_decision"], ".3g"),
            "encoder updates at this scale": f"{average['budget_updates']:,.0f}",
            "hours at this scale": f"{average['projected_hours']:.3g}",
            "hours of collecting": _known(average["collecting"], ".3g"),
            "encoder updates, paper's budget": _beside(
                _known(average["paper_updates"], ",.0f"), _known(updates, ",.0f")
            ),
            "hours, paper's budget": _beside(_known(average["paper_projected_hours"], ".3g"), _known(hours, "g")),
            "the same and collecting": _known(average["hours"], ".3g"),
            "made on": made_on,
        })  # fmt: skip
        here = {"pre-training here": average["paper_projected_hours"], "and collecting": average["hours"]}
        for label, x in {**here, "the paper's": hours}.items() if count == most else ():
            points.append({"label": label, "x": x, "row": f"{method} [{made_on}]"})
    page.table(
        f"Pre-training by number of domains on {where}: some updates timed here (n timings), projected to whole "
        "budgets; the paper's hours are those of an NVIDIA Tesla P100.",
        table,
    )
    page.figure(
        f"{name}-hours",
        "Hours of the paper's budget, without and with collecting the random data, projected. In brackets the machine, "
        "as numbered below: hours compare only within one.",
        dots(pd.DataFrame(points).assign(panel=f"hours, paper's budget, {_count(most, 'domain')}"), log=True),
    )
    page.text(
        f"{machines} Hours are those of pre-training proper, in which environments that explore have their part. "
        "Random data is collected once for all methods that learn from it; its hours are those that it took at this "
        "scale, and for the paper's budget as many times more as the paper has transitions. Updates with the paper's "
        "batches and decisions were timed for themselves.",
        "note",
    )


# --- measurements of encoders and data ------------------------------------------------------------------------------

SPREAD = {"kne_3": "KNE, k = 3", "kne_half": "KNE, k = M/2", "ane": "ANE", "intr": "L_intr"}
"""Column of ``prototypes.csv`` to what it is."""


def _measurements(page: Page, name: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Report what one small table per job holds. A job that stands in two groups, as an (S) method's, counts once."""
    once = cells.drop_duplicates("job").copy()
    groups = cells.groupby("job")["group"].agg(lambda own: ", ".join(sorted(set(own))))
    once["group"] = once["job"].map(groups)
    for kind, measure in (("prototypes", _prototypes), ("coverage", _coverage), ("embeddings", _embeddings)):
        if len(rows := _records(page, once, jobs, [kind], kind)):
            measure(page, name, rows, jobs)
    _diagnostics(page, name, _records(page, cells, jobs, ENCODERS, "pretrain", "updates"))
    _probes(page, name, _records(page, cells, jobs, ["probe"], "probe"))


def _prototypes(page: Page, name: str, rows: pd.DataFrame, jobs: pd.DataFrame) -> None:
    rows["label"] = rows["method"] + np.where(
        rows["has_dispersion"].astype(bool), " with L_intr", " without L_intr"
    )
    rows["n"] = rows.groupby("label")["at_job"].transform("nunique")
    table = []
    for label, own in rows.groupby("label", sort=False):
        ends = own.groupby("at_job").tail(1)
        paper = published.PROTOTYPE_METRICS.get(
            (ends["method"].iloc[0], bool(ends["has_dispersion"].iloc[0]))
        )
        line = {"variant": label, "group": ", ".join(ends["at_group"].unique()), "encoders": len(ends)}
        line["updates"] = _or(ends["updates"])
        for column, title in SPREAD.items():
            told = _known(getattr(paper, column, math.nan), ".3f")
            line[title] = _beside(f"{ends[column].mean() * 1e4:.3f}", told)
        table.append(line)
    page.table(
        "Spread of the prototypes at the end of pre-training, in units of 1e-4, mean over encoders; lower is wider. "
        "The paper's KNE has an unpublished k: it stands beside k = 3, and is not the same quantity.",
        table,
    )
    points = rows.rename(columns={"updates": "x", "at_job": "line", **SPREAD}).melt(
        ["label", "line", "x", "n"], list(SPREAD.values()), "panel", "y"
    )
    page.figure(
        f"{name}-spread",
        "Spread of the prototypes along training, a line per encoder.",
        curves(points, "encoder updates", columns=2),
    )


def _coverage(page: Page, name: str, rows: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """How much of a domain the data covers along pre-training: random policy against explorers."""
    is_random = rows["source"] == "random"
    rows["label"] = (rows["method"].astype(str) + " explorer").mask(is_random, "random policy")
    # Several explorers stand beside the same random data: what is equal is one curve.
    rows = rows.drop_duplicates(["domain", "label", "env_steps", "coverage", "samples"])
    rows["n"] = rows.groupby(["domain", "label"])["at_job"].transform("nunique")
    table = []
    for (domain, label), own in rows.groupby(["domain", "label"], sort=False):
        ends = own.groupby("at_job").tail(1)
        windows = own.groupby("at_job")["coverage"].mean().mean()
        steps = {"explorer's env steps, all domains": _or(ends["env_steps"]), "samples": _or(ends["samples"])}
        numbers = {"coverage": f"{ends['coverage'].mean():.4f}", "mean of all windows": f"{windows:.4f}"}
        table.append({"domain": domain, "data": label, "runs": len(ends), **steps, **numbers})
    page.table(
        "Coverage at the end: particle estimate over observations sampled from the last window of the training, which "
        "is cut into up to ten of equal length, and from as many decisions of the random policy; mean over runs; "
        "higher is wider.",
        table,
    )
    points = rows.rename(columns={"domain": "panel", "at_job": "line", "env_steps": "x", "coverage": "y"})
    caption = (
        "Coverage along pre-training, a line per run; estimates of other numbers of samples do not compare."
    )
    page.figure(
        f"{name}-curves",
        caption,
        curves(points, "env steps of the explorer, all domains", "particle estimate"),
    )


def _embeddings(page: Page, name: str, rows: pd.DataFrame, jobs: pd.DataFrame) -> None:
    for place, (job, own) in enumerate(rows.groupby("at_job", sort=False), 1):
        shares = _json(jobs.loc[job, "path"] / "explained.json").get("explained_variance_ratio", ())
        axes = [
            f"component {i + 1}" + (f" ({shares[i]:.0%} of variance)" if shares else "") for i in range(3)
        ]
        points = own.rename(columns={"source": "label"})[["label", "pc1", "pc2", "pc3"]]
        label, group, seed = own[["at_label", "at_group", "at_encoder_seed"]].iloc[0]
        about = f"{label}, group {group}, encoder seed {seed}"
        caption = f"{about}: first three principal components of {len(own)} embeddings."
        page.figure(f"{name}-{place}", caption, scatter(points, axes))


# --- diagnostics of pre-training ------------------------------------------------------------------------------------

DIAGNOSTICS = {
    "comp": "comparative loss [nats]",
    "embedding_cosine": "mean pairwise cosine",
    "assignment_entropy_frac": "assignment entropy / ln M",
    "prototypes_in_use": "prototypes in use",
    "prototype_ane": "ANE of prototypes",
}
"""Column of ``pretrain.csv`` to what it is; the first three are drawn."""
WINDOW = 5
"""Rows at the end of a record that a final value averages over."""
PLATEAU = 0.99
"""Share of ln M: a comparative loss that stays below has left the plateau, where all prototypes look alike."""
FINALS = (
    f"Mean of the last {WINDOW} rows of a record, then over encoders; the wobble is their standard deviation. The "
    f"plateau is left where the comparative loss stays below {PLATEAU:.0%} of ln M from then on: at ln M, or with a "
    "cosine near 1, nothing has been learned yet."
)


def left_plateau(record: pd.DataFrame) -> float:
    """Return after how many updates a comparative loss has left its plateau for good.

    Args:
        record: rows of ``pretrain.csv``, in order.

    Returns:
        Encoder updates at the first row from which the loss stays below :data:`PLATEAU` of ln M; infinity if the record
        ends on the plateau, and NaN if there is no such loss.
    """
    if not {"comp", "ln_num_prototypes"} <= set(record):
        return math.nan
    known = record.dropna(subset=["comp", "ln_num_prototypes"])
    is_on = (known["comp"] >= PLATEAU * known["ln_num_prototypes"]).to_numpy()
    first = int(np.flatnonzero(is_on)[-1]) + 1 if is_on.any() else 0
    if first == len(known):
        return math.inf if len(known) else math.nan
    return float(known["updates"].iloc[first])


def diagnostic_curves(records: pd.DataFrame) -> Any:
    """Draw comparative loss, embedding cosine and assignment entropy along pre-training, a line per encoder.

    Args:
        records: rows of ``pretrain.csv``, with columns ``at_label`` and ``at_job``.
    """
    drawn = [
        title for title in list(DIAGNOSTICS.values())[:3] if title in records.rename(columns=DIAGNOSTICS)
    ]
    points = records.rename(columns={"at_label": "label", "at_job": "line", "updates": "x", **DIAGNOSTICS})
    points["n"] = points.groupby("label")["line"].transform("nunique")
    points = points.melt(["label", "line", "x", "n"], drawn, "panel", "y").dropna(subset="y")
    logs = records["ln_num_prototypes"].dropna().unique() if "ln_num_prototypes" in records else []
    marks = {DIAGNOSTICS["comp"]: {f"ln M = {value:.3f}": value for value in logs}}
    return curves(points, "encoder updates", marks=marks)


def _diagnostics(page: Page, name: str, records: pd.DataFrame) -> None:
    """Show where encoders ended and how they came there, group by group."""
    for group, own in records.groupby("at_group") if len(records) else ():
        what = f"Group {group}: diagnostics" if group else "Diagnostics"
        caption = f"{what} along pre-training, a line per encoder (n in the legend)."
        page.figure(f"{name}-{group}", caption, diagnostic_curves(own))
        finals = [
            {"encoder": label, **_finals(encoders)} for label, encoders in own.groupby("at_label", sort=False)
        ]
        page.table(f"{what} at the end of pre-training. {FINALS}", finals)


def _finals(records: pd.DataFrame) -> dict[str, Any]:
    """Say where encoders of one label ended, and when they left the plateau."""
    own = records.groupby("at_job", sort=False)
    row = {
        "encoders": own.ngroups,
        "updates": _or(own["updates"].max()),
        "left the plateau at": _plateau(records),
    }
    for column, title in DIAGNOSTICS.items():
        ends = [e.dropna().tail(WINDOW) for _, e in own[column]] if column in records else []
        ends = [end for end in ends if len(end)]
        wobble = f"\nwobble {np.mean([np.std(end) for end in ends]):.2g}" if ends else ""
        row[title] = f"{np.mean([end.mean() for end in ends]):.4g}{wobble}" if ends else ""
    return row


def _plateau(records: pd.DataFrame) -> str:
    """Say when encoders left their plateau, mean and range, and how many did."""
    left = [left_plateau(own) for _, own in records.groupby("at_job")] if len(records) else []
    left = [at for at in left if not math.isnan(at)]
    known = [at for at in left if math.isfinite(at)]
    if not known:
        return "not left" if left else ""
    among = f"{len(known)} of {len(left)} encoders" if len(known) < len(left) else ""
    spread = f"{min(known):,.0f} to {max(known):,.0f}" if min(known) < max(known) else ""
    return "\n".join(filter(None, [f"{np.mean(known):,.0f}", among, spread]))


# --- state probes ---------------------------------------------------------------------------------------------------

MEASURES = {
    "r2_position": ("R2 of positions", 3),
    "r2_velocity": ("R2 of velocities", 3),
    "effective_rank": ("Effective rank (at most the number of observations)", 1),
    "mean_cosine": ("Mean pairwise cosine", 4),
}
"""Measure of a probe's table to what it is and its digits."""


def _probes(page: Page, name: str, rows: pd.DataFrame) -> None:
    """Report state probes: a figure, and a table per measure and embedding, a column per domain and colours."""
    if rows.empty:
        return
    means = _means(page, rows)
    several = means["at_group"].nunique() > 1
    means["encoder"] = means["at_label"] + (", " + means["at_group"] if several else "")
    columns = list(means.sort_values(["domain", "is_redrawn", "colors"])["where"].unique())
    drawn = means[(means["embedding"] == "features") & means["measure"].isin(["r2_position", "r2_velocity"])]
    points = drawn.groupby(["measure", "where", "encoder"], sort=False)["value"].mean().reset_index(name="x")
    points["panel"] = points["measure"].map({measure: title for measure, (title, _) in MEASURES.items()})
    points = points.sort_values("where", key=lambda own: own.map(columns.index), kind="stable")
    page.figure(
        f"{name}-features",
        "What a linear model reads from the features of the frozen encoder: R2 on held-out episodes, mean over "
        "coordinates and encoders.",
        dots(points.rename(columns={"where": "row", "encoder": "label"})),
    )
    for embedding, part in means.groupby("embedding", sort=False):
        what = "features of the frozen encoder" if embedding == "features" else f"embedding {embedding}"
        for measure, (title, digits) in MEASURES.items():
            found = part[part["measure"] == measure]
            counts = found.groupby(["encoder", "where"])["at_job"].nunique()
            table = []
            for encoder, own in found.groupby("encoder", sort=False):
                line = {"encoder": encoder, "group": own["at_group"].iloc[0], **dict.fromkeys(columns, "")}
                for where, here in own.groupby("where"):
                    seen = " or ".join(
                        sorted({"seen" if told == "yes" else "unseen" for told in here["seen"]})
                    )
                    line[where] = f"{_spread(here['value'], digits, n=counts.nunique() > 1)}\n{seen}"
                table.append(line)
            n = _or(counts)
            page.table(
                f"{title}, {what}: mean over encoders (n = {n}), and whether their pre-training saw the domain.",
                table,
            )


def _means(page: Page, rows: pd.DataFrame) -> pd.DataFrame:
    """Say what R2 was measured on, and keep the means over coordinates, with a column that says where they stand."""
    page.text(
        f"R2 is that of held-out episodes: {_or(rows['samples'])} observations per probe, "
        f"{_or(rows['held_out_episodes'])} episodes of them held out. A mean over coordinates counts a negative one as "
        "0. Episodes are held out from the regression: an encoder that learned from a domain's random data may have "
        "seen these very observations, without their states; one that explored or is untrained has not, and of unseen "
        "domains none has.",
        "note",
    )
    means = rows[rows["coordinate"].isna()].dropna(subset="value").copy()
    means["is_redrawn"] = means["colors"] != "normal"
    means["where"] = means["domain"] + (", " + means["colors"].str.replace("_", " ")).where(
        means["is_redrawn"], ""
    )
    return means
