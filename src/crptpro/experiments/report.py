"""One page on a reproduction, or on any downstream runs: tables beside the paper's, figures, and what is missing.

:func:`build_report` reads two frames, the cells that experiments asked for and the jobs behind them. An experiment is
reported by the kinds of its jobs, so that those of a plugin have their section, too. Nothing stands in for what is
missing or not known.
"""

from __future__ import annotations

import datetime
import io
import logging
import math
import re
import shlex
from collections.abc import Iterable, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from crptpro.artifact import read_json, write_whole
from crptpro.errors import RecordError
from crptpro.experiments import jobs as records
from crptpro.experiments import published
from crptpro.experiments import statistics as stats
from crptpro.experiments.figures import draw, in_order
from crptpro.experiments.launch import duration
from crptpro.experiments.matrix import EXPERIMENTS
from crptpro.values import as_path

logger = logging.getLogger(__name__)

ENCODERS = ("encoder", "explored", "finetuned", "untrained")
"""Kinds of jobs that make an encoder."""
PLACES = ("group", "task", "colors", "encoder_seed", "varied", "value")
"""Columns of cells that tables read."""
EPISODES = ("env_steps", "episode_return")
"""Columns of ``eval.csv`` that they read."""


def build_report(root: str | Path, *, out: str | Path | None = None) -> Path:
    """Write a report on a reproduction, or on any directory with downstream runs.

    Args:
        root: directory of ``crptpro reproduce``, finished or not, or one with downstream runs in or below it.
        out: directory of the report; ``root/report`` if not given.

    Returns:
        The HTML page; ``report.md`` and ``figures/*.png`` lie beside it.

    Raises:
        RecordError: there is no such directory, or nothing in it to report on.
        OSError: the report cannot be written.
    """
    root = as_path(root, "directory")
    if not root.is_dir():
        raise RecordError(f"There is no directory {root} to report on.")
    results = records.load_results(root)
    cells, jobs = (results.cells, results.jobs) if len(results.cells) else _unplanned_runs(root)
    cells = cells.assign(**{name: "" for name in PLACES if name not in cells})
    cells = cells.where(cells.notna(), "").astype({name: str for name in cells if name != "done"})
    jobs["where"] = [_where(job) for job in jobs.to_dict("records")]
    numbers = {where: str(count) for count, where in enumerate(filter(None, jobs["where"].unique()), 1)}
    jobs["machine"] = [numbers.get(where, "") for where in jobs["where"]]
    order = {name: place for place, name in enumerate(dict.fromkeys([*EXPERIMENTS, *cells["experiment"]]))}
    cells = cells.sort_values("experiment", key=lambda names: names.map(order), kind="stable")
    page = Page(root / "report" if out is None else as_path(out, "out"))
    _contents(page, cells, jobs)
    _limits(page, cells, jobs)
    for (experiment, scale), own in cells.groupby(["experiment", "scale"], sort=False):
        labels = {label: place for place, label in enumerate(in_order(own["label"]))}
        own = own.sort_values("label", key=lambda names, labels=labels: names.map(labels), kind="stable")
        _experiment(page, experiment, scale, own, jobs)
    _provenance(page, jobs)
    scales = " and ".join(filter(None, cells["scale"].unique()))
    now = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d at %H:%M} UTC"
    return page.write(
        f"CRPTpro: reproduction at scale {scales}" if scales else "CRPTpro: downstream runs",
        "Cross-domain random pre-training with prototypes (arXiv 2302.05614): what was measured here, beside the "
        f"numbers that the paper printed. Made on {now} from {root.resolve().name}.",
    )


class Page:
    """A page of sections, each with texts, tables and figures in the order in which they are added."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.sections: list[dict[str, Any]] = []

    def section(self, title: str, anchor: str) -> None:
        """Begin a section; one that stays empty is left out."""
        self.sections.append({"title": title, "anchor": _plain(anchor), "parts": []})

    def text(self, text: str, style: str = "") -> None:
        """Add a paragraph; its style may be ``note`` or ``warning``."""
        self._add(kind="text", text=text, style=style)

    def table(self, caption: str, rows: pd.DataFrame | Sequence[dict[str, Any]], fold: bool = False) -> None:
        """Add a table, which a reader opens if it is to ``fold``. Empty cells become dashes, empty columns go."""
        frame = pd.DataFrame(rows)
        is_known = frame.notna() & (frame != "")
        shown = frame.astype(object).where(is_known, "\N{EN DASH}").astype(str).loc[:, is_known.any()]
        if len(shown):
            content = {"columns": list(map(str, shown)), "rows": shown.to_numpy().tolist()}
            self._add(kind="table", caption=caption, fold=fold, **content)

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
        environment.filters["md"] = _markdown
        sections = [section for section in self.sections if section["parts"]]
        about = {"title": title, "summary": summary, "sections": sections}
        for name in ("index.html", "report.md"):
            write_whole(self.folder / name, environment.get_template(f"{name}.j2").render(about))
        return self.folder / "index.html"

    def _add(self, **part: Any) -> None:
        self.sections[-1]["parts"].append(part)


def _markdown(text: Any) -> str:
    """Keep a name or a sentence what it is: no HTML, no link, no new line or cell."""
    shown = str(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"\s*[\r\n]\s*", " · ", re.sub(r"([\\`*\[\]|])", r"\\\1", shown))


def _plain(name: str) -> str:
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
    """Read ``<name>.csv`` of every finished job of these kinds, with what its cell says besides."""
    found = []
    for cell in cells[cells["done"] & cells["job"].map(jobs["kind"]).isin(kinds)].to_dict("records"):
        try:
            table = _read(jobs.loc[cell["job"], "path"] / f"{name}.csv", *columns)
            found.append(table.assign(**{key: value for key, value in cell.items() if key not in table}))
        except RecordError as reason:
            page.text(f"Left out: {reason}", "warning")
    return pd.concat(found, ignore_index=True) if found else pd.DataFrame()


def _json(path: Path) -> dict[str, Any]:
    """Read a file that a page can do without; empty if it is not there, or damaged."""
    try:
        return dict(read_json(path, error=RecordError))
    except (RecordError, OSError, TypeError, ValueError):
        return {}


def _needed(key: str, jobs: pd.DataFrame, *kinds: str) -> list[str]:
    """Return a job and everything that it stands on, each once; those of some kinds if any are named."""
    found: dict[str, None] = {}
    waiting = [key]
    while waiting:
        if (one := waiting.pop(0)) not in found and one in jobs.index:
            found[one] = None
            waiting += jobs.loc[one, "needs"]
    return [key for key in found if not kinds or jobs.loc[key, "kind"] in kinds]


NOT_TOLD_APART = [
    "seed", "task", "colors", "device", "precision", "compile", "cuda_graph", "eval_workers", "render_ahead",
    "features", "video_episodes", "checkpoint_interval_env_steps", "log_interval_env_steps",
    "eval_interval_env_steps", "eval_episodes",
]  # fmt: skip
"""Settings that do not make a run another method's: its seed, where it stands, how it computed, when it wrote."""


def _unplanned_runs(root: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Find downstream runs that no experiment planned, and describe them as cells and jobs.

    Runs of one method on one task are seeds of each other only if they agree in everything else: where they do not, the
    label names what differs, as in ``"crptpro, env_steps 20000"``.
    """
    cells, jobs = [], dict[str, dict[str, Any]]()
    for path in sorted(path.parent for path in root.rglob("eval.csv")):
        try:
            content, key = read_json(path / "config.json", error=RecordError), str(path.relative_to(root))
            told = content["config"]
            facts = {"task": told["task"], **told.get("config", told)}
            episodes = _read(path / "eval.csv", *EPISODES)
            cell = {"experiment": "runs", "scale": "", "label": episodes["method"].iloc[0], "job": key}
            cell |= {"done": bool(episodes["env_steps"].max() >= facts["env_steps"]), "task": facts["task"]}
        except (RecordError, KeyError, TypeError, AttributeError) as reason:
            logger.warning("Left out: %s is no downstream run that can be read (%s).", path, reason)
            continue
        cells.append(cell | {"colors": facts.get("colors", "")})
        made = {name: content.get(name) for name in records.MADE} | {"device": facts.get("device")}
        made |= {"machine": records.machine(content.get("hardware") or {}), "path": path}
        made |= {"kind": "run", "facts": facts, "needs": [], "command": None, "done": cell["done"]}
        jobs[key] = made
    table = pd.DataFrame(cells)
    if not len(table) or not table["done"].any():
        raise RecordError(
            f"{root} holds nothing to report on: no experiment of `crptpro reproduce` (experiments/*.json) and no "
            "finished downstream run."
        )
    told = pd.DataFrame([job["facts"] for job in jobs.values()]).astype(str)
    for _, own in table.groupby("label"):
        counts = told.loc[own.index].groupby([own["task"], own["colors"]]).nunique().max()
        for name in counts.index[counts > 1].difference(NOT_TOLD_APART):
            table.loc[own.index, "label"] += f", {name} " + told[name]
    return table, pd.DataFrame.from_dict(jobs, orient="index")


# --- words ----------------------------------------------------------------------------------------------------------


def _where(job: dict[str, Any]) -> str:
    has_threads = job["device"] == "cpu" and not pd.isna(job["threads"])
    device = _count(int(job["threads"]), "thread") if has_threads else job["device"]
    return f"{job['machine']}, {device}" if job["done"] and job["machine"] else ""


def _machines(jobs: pd.DataFrame, keys: Iterable[str]) -> str:
    return ", ".join(sorted(set(jobs.loc[list(keys), "machine"]) - {""}))


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def _number(value: float, spec: str) -> str:
    return "" if math.isnan(value) else f"{value:{spec}}"


def _or(values: Iterable[float]) -> str:
    return " or ".join(f"{value:,.0f}" for value in sorted(set(values)))


def _beside(text: str, paper: Any) -> str:
    return f"{text}\npaper {paper}" if paper not in (None, "") else text


def _spread(values: pd.Series, digits: int, n: bool = True) -> str:
    """Print mean ± standard deviation (n); one number has no deviation."""
    deviation = f" ± {values.std():.{digits}f}" if len(values) > 1 else ""
    return f"{values.mean():.{digits}f}{deviation}" + (f" (n = {len(values)})" if n else "")


# --- the head and the end of the page -------------------------------------------------------------------------------


def _missing(cells: pd.DataFrame) -> str:
    counts = cells.loc[~cells["done"], "label"].value_counts(sort=False)
    return ", ".join(f"{label} {count}" for label, count in counts.items())


def _contents(page: Page, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    page.section("What is here", "contents")
    numbers = cells.groupby(["experiment", "scale"], sort=False)["done"].agg(["size", "sum"])
    page.table(
        "Experiments: numbers that were asked for, and those that are there.",
        numbers.set_axis(["asked for", "finished"], axis=1).reset_index(),
    )
    counts = jobs.groupby("kind")["done"].agg(["sum", "size"])
    told = ", ".join(f"{done} of {count} {kind}" for kind, done, count in counts.itertuples())
    seconds = jobs.loc[jobs["done"], "seconds"].dropna()
    work = f"; {seconds.sum() / 3600:.1f} h of work in all" if len(seconds) else ""
    page.text(f"Jobs finished: {told}{work}. Machines, revisions and versions are at the end.")


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


def _limits(page: Page, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Show the budgets of every scale beside the paper's, as its jobs have them, and what they cannot show."""
    page.section("What this scale cannot show", "limits")
    table = pd.DataFrame(index=[*BUDGETS, "downstream runs per encoder"])
    for scale, own in cells[cells["scale"] != "paper"].groupby("scale", sort=False):
        here = jobs.loc[list({key: 0 for job in own["job"].unique() for key in _needed(job, jobs)})]
        facts = pd.json_normalize(here["facts"].tolist()).set_index(here.index)
        methods = here["facts"].map(lambda told: str(told.get("method", "")))
        values = []
        for fact, kinds, method, _ in BUDGETS.values():
            is_meant = here["kind"].isin(kinds) & methods.str.match(method)
            found = facts.loc[is_meant, fact].dropna() if fact in facts else pd.Series()
            words = [v if isinstance(v, str) else f"{v:,}".removesuffix(".0") for v in sorted(found.unique())]
            values.append(" or ".join(words + ["the paper's"] * bool(len(found) < is_meant.sum())))
        runs = own[own["job"].map(jobs["kind"]) == "run"].drop_duplicates("job")
        table[scale or "here"] = [*values, _or(runs.groupby(["label", *PLACES]).size())]
    table = table[(table != "").any(axis=1)]
    if len(table):
        paper = {budget: told for budget, (*_, told) in BUDGETS.items()}
        table["the paper's"] = [paper.get(name, "not printed, at least 6 evaluations") for name in table.index]
        page.table("Budgets beside the paper's.", table.reset_index(names="budget"))
        page.text(
            "What this cannot show: which method is ahead after all of the budget, for methods that learn late look "
            "worse here than they are; what an encoder learns after the plateau near ln M, which lasts for over a "
            "thousand updates at batch 512; the method itself, where a smaller batch, replay or dataset changes it. "
            f"With fewer than {stats.MIN_RUNS} runs on a task there are no intervals, and two or three rank nothing.",
            "warning",
        )


def _provenance(page: Page, jobs: pd.DataFrame) -> None:
    page.section("Machines and versions", "provenance")
    done = jobs[jobs["done"]]
    made = done[["machine", "where", "git_revision"]].value_counts(sort=False)
    page.table("Machines, as tables number them, and source revisions", made.reset_index(name="jobs"))
    facts = pd.DataFrame(done["facts"].tolist(), done.index)
    facts = facts.reindex(columns=["method", "domain", "updates", "env_steps"])
    spent = done[["kind", "machine", "seconds"]].join(facts).dropna(subset="seconds")
    spent["of"] = spent["method"].fillna(spent["domain"])
    groups = spent.groupby(["kind", "of", "machine"], sort=False)
    costs = groups[["updates", "env_steps"]].mean().map("{:,.0f}".format, na_action="ignore")
    costs["wall clock"] = groups["seconds"].mean().map(duration)
    costs.insert(0, "jobs", groups.size())
    page.table(
        "What jobs took, means. Times compare only within one machine, and jobs that shared one slowed each other.",
        costs.reset_index(),
    )
    sets = done["versions"].dropna().map(lambda told: tuple(sorted(told.items()))).value_counts()
    versions = pd.DataFrame({f"version ({_count(n, 'job')})": dict(told) for told, n in sets.items()})
    page.table("Versions", versions.rename_axis("package").reset_index())
    page.section("Jobs", "jobs")
    has_begun = jobs["path"].map(lambda path: (path / records.LOG).exists())
    table = pd.DataFrame({
        "job": jobs.index, "state": np.select([jobs["done"], has_begun], ["finished", "begun"], "not begun"),
        "wall clock": jobs["seconds"].map(duration, na_action="ignore"), "attempts": jobs["attempts"],
        "machine": jobs["machine"], "revision": jobs["git_revision"],
        "command": [shlex.join(["crptpro", *told]) if isinstance(told, list) else "" for told in jobs["command"]],
    })  # fmt: skip
    for kind, own in table.groupby(jobs["kind"].to_numpy()):
        page.table(f"{kind}: {_count(len(own), 'job')}", own, fold=True)


# --- one experiment -------------------------------------------------------------------------------------------------


def _experiment(page: Page, experiment: str, scale: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    name = _plain(f"{experiment}-{scale}")
    known = EXPERIMENTS.get(experiment)  # a plugin's own may not be loaded here
    page.section(f"{known.title if known else experiment}{f' ({scale})' if scale else ''}", name)
    if known:
        page.text(known.summary)
    missing = cells[~cells["done"]]
    if len(missing) == len(cells):
        page.text(f"Nothing is finished yet: {_count(len(cells), 'number')} asked for.", "warning")
        return
    page.text(f"{len(cells) - len(missing)} of {len(cells)} numbers are there.")
    if len(missing):
        page.text(f"Missing: {_missing(cells)}. Nothing stands in for what is missing.", "warning")
        places = missing.drop(columns=["experiment", "scale", "done"])
        page.table(f"The {len(missing)} that are missing", places, fold=True)
    _measurements(page, name, cells, jobs)
    _efficiency(page, name, cells, jobs)
    _scores(page, name, cells, jobs)


# --- downstream scores ----------------------------------------------------------------------------------------------


def _scores(page: Page, name: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    runs, points = _runs(page, cells, jobs)
    if runs.empty:
        return
    page.text(
        f"Runs of {_or(runs['budget'])} env steps here. n is the number of runs that a number stands on; “paper” is "
        f"what it printed, after {published.ENV_STEPS:,} env steps (DrQ: {published.DRQ_ENV_STEPS:,}): scores of a "
        "smaller budget do not compare with it.",
        "note",
    )
    for varied, part in runs.groupby("varied", sort=False):
        of = f", mean ± standard deviation over runs (n).{f' {varied} varied.' if varied else ''}"
        _score_table(page, part, f"Episode return at the final evaluation{of}")
        if varied:
            _sensitivity(page, f"{name}-{varied}", part, str(varied))
    _aggregates(page, runs)
    _learning_curves(page, name, points)


def _runs(page: Page, cells: pd.DataFrame, jobs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return a row per run with its place and scores, and one per evaluation with env steps and mean return."""
    rows = _records(page, cells.sort_values("group", kind="stable"), jobs, ["run"], "eval", *EPISODES)
    runs, points = [], []
    for _, own in rows.groupby(["group", "label", "job"], sort=False) if len(rows) else ():
        place = own[[*PLACES, "label"]].iloc[0].to_dict()
        job, task, colors = own["job"].iloc[0], place["task"], place["colors"] or "normal"
        where = f"{place['group']} {task}".strip() + (f", {colors}" if colors != "normal" else "")
        place |= {"task": where, "task_name": task, "colors": colors, "run": job}
        # Runs on encoders that were fine-tuned from one base share it: it is their one draw of a pre-training.
        encoders = _needed(job, jobs, *ENCODERS)
        card = jobs.loc[job, "path"] / "agent" / "card.json"
        place["encoder"] = encoders[-1] if encoders else _json(card).get("pretrained") or job
        curve = own.groupby("env_steps")["episode_return"].mean()
        place |= {"score": curve.iloc[-1], "budget": curve.index[-1]}
        runs.append({**place, "expert": published.EXPERT_SCORES.get(task, math.nan)})
        about = {key: place[key] for key in ("label", "task", "run", "encoder")}
        points.append(curve.reset_index(name="score").assign(**about))
    return pd.DataFrame(runs), pd.concat(points, ignore_index=True) if points else pd.DataFrame()


def _score_table(page: Page, runs: pd.DataFrame, caption: str) -> None:
    """Show a row per task as the paper does, or per method where few tasks have many methods."""
    cells = {}
    groups = runs.groupby(["label", "task", "group", "task_name", "colors"])["score"]
    for (label, task, *place), own in groups:
        text = _spread(own, 0 if abs(own.mean()) >= 10 else 1)
        cells[label, task] = _beside(text, published.published_score(label, *place))
    labels, tasks = in_order(runs["label"]), list(runs["task"].unique())
    table = pd.Series(cells).unstack().loc[labels, tasks]
    if len(tasks) <= 3 < len(labels):
        page.table(caption, table.reset_index(names="method"))
    else:
        page.table(caption, table.T.reset_index(names="task"))


NORMALIZED = {
    "mean / DrQ": stats.mean, "IQM / DrQ": stats.iqm, "median / DrQ": stats.median,
    "optimality gap": stats.optimality_gap,
}  # fmt: skip


def _aggregates(page: Page, runs: pd.DataFrame) -> None:
    labels = in_order(runs["label"])
    has_run = runs.groupby(["task", "label"], sort=False).size().unstack().notna()[labels]
    shared = has_run.index[has_run.all(axis=1)]
    for task, row in has_run[~has_run.all(axis=1)].iterrows():
        lacking = ", ".join(row.index[~row])
        page.text(f"Left out of what compares methods: {task} (no run of {lacking}).", "note")
    if shared.empty:
        page.text("There is no task on which every method has a run: nothing to aggregate.", "note")
        return
    kept = runs[runs["task"].isin(shared)]
    normal = kept.assign(score=kept["score"] / kept["expert"]).dropna(subset="expert")
    drq = kept[kept["label"] == "drq"]
    places = kept[["group", "task_name", "colors"]].drop_duplicates().to_numpy().tolist()
    rows = list[dict[str, Any]]()
    for label in labels:
        own, own_normal = (frame[frame["label"] == label] for frame in (kept, normal))
        found, encoders = (stats.estimate(stats.mean, own), own.loc[own["encoder"] != own["run"], "encoder"].nunique())
        line: dict[str, Any] = {"method": label, "tasks": len(shared), "runs": found.runs, "encoders": encoders or ""}
        line["mean score"] = _beside(f"{found:.0f}", _paper_mean(label, places))
        for title, statistic in NORMALIZED.items() if len(normal) else ():
            line[title] = f"{stats.estimate(statistic, own_normal):.3f}"
        if len(normal):
            line["mean / DrQ"] = _beside(line["mean / DrQ"], _paper_mean(label, places, normalized=True))
        if (drq["score"] > 0).all() and len(drq):
            line["mean / DrQ here"] = "1" if label == "drq" else f"{stats.estimate(stats.relative_mean, own, drq):.3f}"
        rows.append(line)
    page.table(
        f"Over the {_count(len(shared), 'task')} that all methods share. A task counts once per group and colours, a "
        "run of several once. Normalised scores are divided by the paper's DrQ; “paper” is what it printed for all of "
        "its tasks, or what its cells for these give.",
        rows,
    )
    fewest = kept.groupby(["label", "task"]).size().groupby("label").min()
    if fewest.max() >= stats.MIN_RUNS:
        held = "; ".join(f"{count}: {share:.0%}" for count, share in stats.COVERAGE.items())
        page.text(
            f"Brackets are {stats.CONFIDENCE:.0%} intervals ({stats.REPLICATES:,} stratified bootstrap replicates that "
            "redraw encoders and then their runs). On one encoder they speak of that encoder, not of its method. Where "
            f"runs follow a normal law, those of a single task's mean hold the truth, by number of runs, {held}.",
            "warning",
        )
    if fewest.min() < stats.MIN_RUNS:
        page.text(
            f"Intervals stand where a method has {stats.MIN_RUNS} runs or more on every task; here some have as few as "
            f"{fewest.min()}. The standard deviations above say how far runs lie apart.",
            "warning",
        )
    if missing := sorted(kept.loc[kept["expert"].isna(), "task_name"].unique()):
        page.text(f"The paper has no DrQ score for {', '.join(missing)}: in the mean score only.", "note")
    ours = normal[normal["label"] == "crptpro"]
    rows = []
    for label in in_order(normal["label"]) if len(ours) else ():
        if label != "crptpro":
            found = stats.estimate(stats.probability_of_improvement, ours, normal[normal["label"] == label])
            told = {"other method": label, "runs of both": found.runs}
            rows.append({**told, "P(crptpro > other)": f"{found:.2f}"})
    page.table(
        "Probability that a run of crptpro scores higher than one of the other method on the same task; 0.5 is no "
        "difference. Of two runs against two it can only be 0, 0.25, 0.5, 0.75 or 1.",
        rows,
    )


def _paper_mean(label: str, places: Sequence[Sequence[str]], normalized: bool = False) -> str:
    """Return what the paper printed for all of its seen tasks; for a part of them, what its cells give."""
    digits, means = (3, published.SEEN_NORMALIZED_MEAN) if normalized else (0, published.SEEN_MEAN)
    if {(*place[:2],) for place in places} == {row[:2] for row in published.SEEN} and label in means:
        return f"{means[label]:.{digits}f}"
    asked = [place for place in places if not normalized or place[1] in published.EXPERT_SCORES]
    scores = [published.published_score(label, *place) for place in asked]
    experts = [published.EXPERT_SCORES[place[1]] if normalized else 1.0 for place in asked]
    values = [score.mean / expert for score, expert in zip(scores, experts) if score]
    return f"{np.mean(values):.{digits}f}" if values and len(values) == len(asked) else ""


def _estimated(found: Any, **about: Any) -> pd.DataFrame:
    """Return an estimate and its interval, if there is one, as points of a figure."""
    ends = {end: math.nan if at is None else at for end, at in (("low", found.low), ("high", found.high))}
    return pd.DataFrame({"y": found.value, **ends}).assign(**about)


def _learning_curves(page: Page, name: str, points: pd.DataFrame) -> None:
    drawn = []
    for (task, label), own in points.groupby(["task", "label"], sort=False):
        runs = own.pivot_table("score", ["task", "encoder", "run"], "env_steps").dropna(axis=1)
        if runs.empty:  # no evaluation that all runs have
            continue
        found = stats.estimate(stats.mean, runs.reset_index(), columns=list(runs))
        about = {"panel": task, "label": label, "n": str(len(runs))}
        drawn.append(_estimated(found, x=runs.columns, **about, line="mean", thin=False))
        if found.low is None and len(runs) > 1:  # too few for an interval: the runs themselves
            own = own.rename(columns={"env_steps": "x", "score": "y", "run": "line"})
            drawn.append(own.assign(**about, low=math.nan, high=math.nan, thin=True))
    page.figure(
        f"{name}-curves",
        f"Episode return along training: mean over runs, with {stats.CONFIDENCE:.0%} bootstrap intervals from "
        f"{stats.MIN_RUNS} runs up, below that with a thin line per run.",
        draw(pd.concat(drawn, ignore_index=True), "env steps", "episode return"),
    )


def _sensitivity(page: Page, name: str, runs: pd.DataFrame, varied: str) -> None:
    runs = runs.assign(score=runs["score"] / runs["expert"]).dropna(subset="score")
    runs["method"] = runs["label"].str.split(f", {varied} ").str[0]
    runs["size"] = pd.to_numeric(runs["value"], errors="coerce")
    points = []
    for (_, value, method), own in runs.groupby(["size", "value", "method"], dropna=False):
        found = stats.estimate(stats.mean, own)
        points.append(_estimated(found, label=method, x=value, n=str(found.runs)))
    what = {"alpha": "weight of the dispersion loss (alpha)", "b": "random transitions per domain (b)"}
    if points:
        figure = draw(pd.concat(points), what.get(varied, varied), "mean score / the paper's DrQ")
        page.figure(name, f"Mean score against {varied}; n is runs per value.", figure)


# --- cost of pre-training -------------------------------------------------------------------------------------------


def _efficiency(page: Page, name: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    rows = _records(page, cells, jobs, ["timing"], "timing")
    if rows.empty:
        return
    rows["collecting"] = rows["collection_seconds"].astype(float) / 3600
    rows["hours"] = rows["paper_projected_hours"] + (
        rows["collecting"] * rows["job"].map(lambda job: _papers_data(job, jobs))
    ).fillna(0)
    table = []
    groups = rows.groupby(["device", "threads", "method", "domains"], sort=False)
    for (device, threads, method, count), own in groups:
        average, hours, updates = own.mean(numeric_only=True), math.nan, math.nan
        if method in published.EFFICIENCY and count in (1, 2, 3):
            hours, updates = (told[count - 1] for told in published.EFFICIENCY[method])
        paper_updates = _number(average["paper_updates"], ",.0f")
        paper_hours = _number(average["paper_projected_hours"], ".3g")
        table.append({
            "method": method, "domains": count, "on": device if device != "cpu" else _count(int(threads), "thread"),
            "s per encoder update": f"{average['seconds_per_update']:.3g} (n = {len(own)})",
            "s per decision": _number(average["seconds_per_decision"], ".3g"),
            "encoder updates at this scale": f"{average['budget_updates']:,.0f}",
            "hours at this scale": f"{average['projected_hours']:.3g}",
            "hours of collecting": _number(average["collecting"], ".3g"),
            "encoder updates, paper's budget": _beside(paper_updates, _number(updates, ",.0f")),
            "hours, paper's budget": _beside(paper_hours, _number(hours, "g")),
            "the same and collecting": _number(average["hours"], ".3g"),
            "machine": _machines(jobs, own["job"]),
        })  # fmt: skip
    page.table(
        "Pre-training by number of domains: some updates timed here (n timings), projected to whole budgets; the "
        "paper's hours are those of an NVIDIA Tesla P100. Times compare only within one machine. Hours include the "
        "environments of methods that explore. Random data is collected once for all methods that learn from it: its "
        "hours are those of this scale, and for the paper's budget in proportion to its transitions.",
        table,
    )


def _papers_data(job: str, jobs: pd.DataFrame) -> float:
    sizes = [jobs.loc[key, "facts"]["transitions"] for key in _needed(job, jobs, "dataset")]
    return 100_000 / float(np.mean(sizes)) if sizes else math.nan


# --- measurements of encoders and data ------------------------------------------------------------------------------


def _measurements(page: Page, name: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Report what one small table per job holds. A job that stands in two groups, as an (S) method's, counts once."""
    groups = cells.groupby("job")["group"].agg(lambda own: ", ".join(sorted(set(own))))
    once = cells.drop_duplicates("job").assign(group=lambda own: own["job"].map(groups))
    for kind, measure in (("prototypes", _prototypes), ("coverage", _coverage), ("embeddings", _embeddings)):
        if len(rows := _records(page, once, jobs, [kind], kind)):
            measure(page, name, rows, jobs)
    rows = _records(page, cells, jobs, ["encoder", "explored", "finetuned"], "pretrain", "updates")
    for group, own in rows.groupby("group") if len(rows) else ():
        _diagnostics(page, f"{name}-{group}", f"Group {group}: diagnostics" if group else "Diagnostics", own)
    if len(rows := _records(page, cells, jobs, ["probe"], "probe")):
        _probes(page, name, rows)


SPREAD = {"kne_3": "KNE, k = 3", "kne_half": "KNE, k = M/2", "ane": "ANE", "intr": "L_intr"}
"""Column of ``prototypes.csv`` to what it is."""


def _last(rows: pd.DataFrame, keys: Sequence[str], numbers: Sequence[str], window: int = 1) -> pd.DataFrame:
    """Return, by keys, how many jobs there are, and the mean over them of each number's last values."""
    by_job = rows.groupby([*keys, "job"], sort=False)[[*numbers]]
    ends = by_job.agg(lambda own: own.dropna().tail(window).mean()).groupby(list(keys), sort=False)
    return ends.mean().assign(n=ends.size()).reset_index()


def _prototypes(page: Page, name: str, rows: pd.DataFrame, jobs: pd.DataFrame) -> None:
    variants = {True: " with L_intr", False: " without L_intr"}
    rows["label"] = rows["method"] + rows["has_dispersion"].map(variants)
    table = []
    for end in _last(rows, ["label", "method", "has_dispersion"], [*SPREAD, "updates"]).to_dict("records"):
        paper = published.PROTOTYPE_METRICS.get((end["method"], end["has_dispersion"]))
        line = {"variant": end["label"], "encoders": end["n"], "updates": f"{end['updates']:,.0f}"}
        for column, title in SPREAD.items():
            told = _number(getattr(paper, column, math.nan), ".3f")
            line[title] = _beside(f"{end[column] * 1e4:.3f}", told)
        table.append(line)
    page.table(
        "Spread of the prototypes at the end of pre-training, in units of 1e-4, mean over encoders; lower is wider. "
        "The paper's KNE has an unpublished k: it stands beside k = 3, and is not the same quantity.",
        table,
    )
    points = rows.rename(columns={"updates": "x", "job": "line", **SPREAD})
    points = points.melt(["label", "line", "x"], list(SPREAD.values()), "panel", "y")
    caption = "Spread of the prototypes along training, a line per encoder."
    page.figure(f"{name}-spread", caption, draw(points, "encoder updates", columns=2))


def _coverage(page: Page, name: str, rows: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """How much of a domain the data covers along pre-training: random policy against explorers."""
    explorers = rows["method"].astype(str) + " explorer"
    rows["label"] = explorers.mask(rows["source"] == "random", "random policy")
    # Several explorers stand beside the same random data: what is equal is one curve.
    rows = rows.drop_duplicates(["domain", "label", "env_steps", "coverage", "samples"])
    numbers = ["env_steps", "samples", "coverage"]
    ends = _last(rows, ["domain", "label"], numbers)
    ends["all windows"] = _last(rows, ["domain", "label"], numbers, window=10)["coverage"]
    for column in (*numbers, "all windows"):
        form = "{:.4f}" if column in ("coverage", "all windows") else "{:,.0f}"
        ends[column] = ends[column].map(form.format)
    page.table(
        "Coverage at the end: particle estimate over observations sampled from the last window of the training, which "
        "is cut into up to ten of equal length, and from as many decisions of the random policy; mean over n runs; "
        "higher is wider. Env steps are the explorer's in all domains.",
        ends.rename(columns={"label": "data"}),
    )
    points = rows.rename(columns={"domain": "panel", "job": "line", "env_steps": "x", "coverage": "y"})
    caption = "Coverage along pre-training, a line per run; other numbers of samples do not compare."
    steps = "env steps of the explorer, all domains"
    page.figure(f"{name}-curves", caption, draw(points, steps, "particle estimate"))


def _embeddings(page: Page, name: str, rows: pd.DataFrame, jobs: pd.DataFrame) -> None:
    for place, (job, own) in enumerate(rows.groupby("job", sort=False), 1):
        shares = _json(jobs.loc[job, "path"] / "explained.json").get("explained_variance_ratio", ())
        axes = {f"pc{i}": f"component {i} ({share:.0%})" for i, share in enumerate(shares, 1)}
        points = pd.DataFrame({"label": own["source"]})
        pairs = [points.assign(x=own[x], y=own[y], panel=f"{axes[y]} over {axes[x]}") for x, y in combinations(axes, 2)]
        about = "{}, group {}, encoder seed {}".format(*own[["label", "group", "encoder_seed"]].iloc[0])
        caption = f"{about}: principal components of {len(own)} embeddings, with their share of the variance."
        page.figure(f"{name}-{place}", caption, draw(pd.concat(pairs), kind="cloud"))


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


def left_plateau(record: pd.DataFrame) -> float:
    """Return after how many encoder updates a comparative loss has left its plateau for good.

    Args:
        record: rows of ``pretrain.csv``, in order.

    Returns:
        Updates at the first row from which the loss stays below :data:`PLATEAU` of ln M; infinity if the record ends on
        the plateau, and NaN if there is no such loss.
    """
    if not {"comp", "ln_num_prototypes"} <= set(record):
        return math.nan
    known = record.dropna(subset=["comp", "ln_num_prototypes"])
    is_on = (known["comp"] >= PLATEAU * known["ln_num_prototypes"]).to_numpy()
    first = int(np.flatnonzero(is_on)[-1]) + 1 if is_on.any() else 0
    if first == len(known):
        return math.inf if len(known) else math.nan
    return float(known["updates"].iloc[first])


def _diagnostics(page: Page, name: str, what: str, rows: pd.DataFrame) -> None:
    shown = {column: title for column, title in DIAGNOSTICS.items() if column in rows}
    points = rows.rename(columns={"job": "line", "updates": "x", **shown})
    points["n"] = points.groupby("label")["line"].transform("nunique").astype(str)
    drawn = list(shown.values())[:3]
    points = points.melt(["label", "line", "x", "n"], drawn, "panel", "y").dropna(subset="y")
    if len(points):
        has_loss = points["panel"].iloc[0] == DIAGNOSTICS["comp"]
        logs = rows["ln_num_prototypes"].dropna().unique() if has_loss else ()
        marks = {f"ln M = {value:.3f}": value for value in logs}
        caption = f"{what} along pre-training, a line per encoder (n in the legend)."
        page.figure(name, caption, draw(points, "encoder updates", marks=marks))
    ends = _last(rows, ["label"], list(shown), WINDOW).rename(columns={"n": "encoders", **shown})
    ends[list(shown.values())] = ends[list(shown.values())].map(lambda value: _number(value, ".4g"))
    by_label = {label: [own for _, own in each.groupby("job")] for label, each in rows.groupby("label")}
    updates = {label: _or(own["updates"].max() for own in each) for label, each in by_label.items()}
    left = {label: _plateau(map(left_plateau, each)) for label, each in by_label.items()}
    for place, (title, told) in enumerate({"updates": updates, "left the plateau at": left}.items(), 1):
        ends.insert(place, title, ends["label"].map(told))
    page.table(
        f"{what} at the end of pre-training. Mean of the last {WINDOW} rows of a record, then over encoders. The "
        f"plateau is left where the comparative loss stays below {PLATEAU:.0%} of ln M from then on: at ln M, or with "
        "a cosine near 1, nothing has been learned yet.",
        ends,
    )


def _plateau(updates: Iterable[float]) -> str:
    known = sorted({at for at in updates if not math.isnan(at)})
    return " or ".join("not left" if math.isinf(at) else f"{at:,.0f}" for at in known)


MEASURES = {
    "r2_position": ("R2 of positions", 3),
    "r2_velocity": ("R2 of velocities", 3),
    "effective_rank": ("Effective rank (at most the number of observations)", 1),
    "mean_cosine": ("Mean pairwise cosine", 4),
}
"""Measure of a probe's table to what it is and its digits."""


def _probes(page: Page, name: str, rows: pd.DataFrame) -> None:
    """Show a table per measure and embedding, with a column per domain and colours."""
    page.text(
        f"R2 is that of held-out episodes: {_or(rows['samples'])} observations per probe, "
        f"{_or(rows['held_out_episodes'])} episodes of them held out. A mean over coordinates counts a negative one as "
        "0. Episodes are held out from the regression: an encoder that learned from a domain's random data may have "
        "seen these very observations, without their states; one that explored or is untrained has not, and of unseen "
        "domains none has.",
        "note",
    )
    means = rows[rows["coordinate"].isna()].dropna(subset="value")
    means = means.sort_values(["domain", "colors"], kind="stable")
    colors = (", " + means["colors"].str.replace("_", " ")).mask(means["colors"] == "normal", "")
    groups = ", " + means["group"] if means["group"].nunique() > 1 else ""
    means = means.assign(at=means["domain"] + colors, encoder=means["label"] + groups)
    means["seen"] = means["seen"].map({"yes": "seen", "no": "unseen"})
    for embedding, measure in product(means["embedding"].unique(), MEASURES):
        own = means[(means["embedding"] == embedding) & (means["measure"] == measure)]
        (title, digits), places = MEASURES[measure], own.groupby(["encoder", "group", "at"], sort=False)
        counts = places["job"].nunique()
        cells = {
            place: f"{_spread(here['value'], digits, n=counts.nunique() > 1)}\n{' or '.join(here['seen'].unique())}"
            for place, here in places
        }
        what = "features of the frozen encoder" if embedding == "features" else f"embedding {embedding}"
        page.table(
            f"{title}, {what}: mean over encoders (n = {_or(counts)}), and whether their pre-training saw the domain.",
            pd.Series(cells).unstack(sort=False).reset_index(names=["encoder", "group"]),
        )
