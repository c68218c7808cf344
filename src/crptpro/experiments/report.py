"""One page on a reproduction, or on any downstream runs: tables beside the paper's, figures, and what is missing.

:func:`build_report` reads two frames: the cells of experiments, and the jobs behind them. The kinds of an experiment's
jobs decide what its section contains. Missing or unknown values stay empty.
"""

from __future__ import annotations

import datetime
import html
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

from crptpro.artifact import CARD_FILE, identity_of, read_json, write_whole
from crptpro.errors import RecordError
from crptpro.experiments import jobs as records
from crptpro.experiments import published
from crptpro.experiments import statistics as stats
from crptpro.experiments.figures import draw, in_order
from crptpro.experiments.launch import duration
from crptpro.experiments.matrix import EXPERIMENTS, NO_BONUS, PAPER
from crptpro.pretrained import SHIPPED, shipped_encoders
from crptpro.values import as_path

logger = logging.getLogger(__name__)

PLACES = ("group", "task", "colors", "encoder_seed", "varied", "value")  # columns of cells that tables read
EPISODES = ("env_steps", "episode_return")  # columns of ``eval.csv`` that tables read


def build_report(root: str | Path, *, out: str | Path | None = None) -> Path:
    """Write a report on a reproduction, or on any directory with downstream runs.

    ``root`` is a directory of ``crptpro reproduce``, finished or not, or one with downstream runs in or below it. One
    that is missing, or has nothing to report on, raises a ``RecordError``. Returns the HTML page in ``out``, or else in
    ``root/report``; ``report.md`` and ``figures/*.png`` lie beside it.
    """
    root = as_path(root, "directory")
    if not root.is_dir():
        raise RecordError(f"There is no directory {root} to report on.")
    results = records.load_results(root)
    cells, jobs = (results.cells, results.jobs) if len(results.cells) else _unplanned_runs(root)
    cells = cells.assign(**{name: "" for name in PLACES if name not in cells})
    cells = cells.where(cells.notna(), "").astype({name: str for name in cells if name != "done"})
    order = [*EXPERIMENTS, *cells["experiment"]]
    cells = cells.sort_values("experiment", key=lambda names: names.map(order.index), kind="stable")
    jobs["where"] = [_where(job) for job in jobs.to_dict("records")]
    jobs["machine"] = [str(code + 1) if code >= 0 else "" for code in pd.factorize(jobs["where"].replace("", None))[0]]
    page = Page(root / "report" if out is None else as_path(out, "out"))
    _contents(page, cells, jobs)
    _limits(page, cells, jobs)
    for (experiment, scale), own in cells.groupby(["experiment", "scale"], sort=False):
        labels = in_order(own["label"])
        own = own.sort_values("label", key=lambda names, labels=labels: names.map(labels.index), kind="stable")
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
    """A page of sections, each with texts, tables and figures in the order of their calls."""

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
        """Add a table, closed at first if ``fold``. Empty cells become dashes; empty columns are left out."""
        frame = pd.DataFrame(rows)
        is_known = frame.notna() & (frame != "")
        shown = frame.astype(object).where(is_known, "\N{EN DASH}").astype(str).loc[:, is_known.any()]
        if len(shown):
            columns, lines = list(map(str, shown)), shown.to_numpy().tolist()
            self._add(kind="table", caption=caption, fold=fold, columns=columns, rows=lines)

    def figure(self, name: str, caption: str, figure: Any) -> None:
        """Write a figure and show it; the same numbers give the same file."""
        file = f"figures/{_plain(name)}.png"
        pixels = io.BytesIO()
        figure.savefig(pixels, format="png", dpi=110, metadata={"Software": None})
        write_whole(self.folder / file, pixels.getvalue())
        self._add(kind="figure", file=file, caption=caption)

    def write(self, title: str, summary: str) -> Path:
        """Write both files; returns the HTML page."""
        from jinja2 import Environment, PackageLoader, select_autoescape

        loader = PackageLoader("crptpro.experiments")
        escape = select_autoescape(["html.j2"])
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
    """Escape a text, so that it cannot form HTML, a link, a line or a table cell."""
    escaped = re.sub(r"([\\`*\[\]|])", r"\\\1", html.escape(str(text), quote=False))
    return re.sub(r"\s*[\r\n]\s*", " · ", escaped)


def _plain(name: str) -> str:
    return re.sub(r"[^a-zA-Z0-9]+", "-", name).strip("-")


# --- reading --------------------------------------------------------------------------------------------------------


def _read(path: Path, *columns: str) -> pd.DataFrame:
    """Read a CSV record; it must have rows, and finite numbers in these columns."""
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
            raise RecordError(f"{path} is damaged: a `{column}` in it is not a finite number.")
    return table


def _records(
    page: Page, cells: pd.DataFrame, jobs: pd.DataFrame, kinds: Sequence[str], name: str, *columns: str
) -> pd.DataFrame:
    """Read ``<name>.csv`` of every finished job of these kinds, and add the columns of its cell."""
    found = []
    for cell in cells[cells["done"] & cells["job"].map(jobs["kind"]).isin(kinds)].to_dict("records"):
        try:
            table = _read(jobs.loc[cell["job"], "path"] / f"{name}.csv", *columns)
            found.append(table.assign(**{key: value for key, value in cell.items() if key not in table}))
        except RecordError as reason:
            page.text(f"Left out: {reason}", "warning")
    return pd.concat(found, ignore_index=True) if found else pd.DataFrame()


def _needed(keys: Iterable[str], jobs: pd.DataFrame, *kinds: str) -> list[str]:
    """Return jobs and everything that they need, each once; of some kinds only, if any are named."""
    found = [key for key in dict.fromkeys(keys) if key in jobs.index]
    for key in found:  # grows while it is iterated
        found += [needed for needed in jobs.loc[key, "needs"] if needed in jobs.index and needed not in found]
    return [key for key in found if not kinds or jobs.loc[key, "kind"] in kinds]


NOT_IN_LABELS = [
    "seed", "task", "pretrained", "colors", "device", "precision", "compile", "cuda_graph", "eval_workers", "features",
    "eval_episodes", "checkpoint_interval_env_steps", "log_interval_env_steps", "eval_interval_env_steps",
]  # fmt: skip
"""Settings that do not distinguish methods: seed, task and encoder, how a run computes, and when it writes."""


def _unplanned_runs(root: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Find downstream runs that no experiment planned, and describe them as cells and jobs.

    Runs of one method on one task are seeds of each other only if all other settings agree. Otherwise the label names
    the settings that differ, as in ``"crptpro (env_steps 20000)"``.
    """
    cells = []
    shipped = {identity_of(read_json(SHIPPED / name / CARD_FILE)): name for name in shipped_encoders()}
    jobs: dict[str, dict[str, Any]] = {}
    for path in sorted(path.parent for path in root.rglob("eval.csv")):
        try:
            content = read_json(path / "config.json", error=RecordError)
            episodes = _read(path / "eval.csv", *EPISODES)
            label = episodes["method"].iloc[0]
            facts = content["config"] | {"method": label}
            domains = facts.pop("pretrained_on", "").replace(", ", "+")  # encoders of the same ones count as one method
            facts["encoder"] = shipped.get(facts.get("pretrained"), domains)
            if label == "crptpro" and facts.get("intrinsic_reward_coef") == 0:
                label = NO_BONUS
            is_done = bool(episodes["env_steps"].max() >= facts["env_steps"])
        except (RecordError, KeyError, TypeError, AttributeError) as reason:
            logger.warning("Left out: %s is not a readable downstream run (%s).", path, reason)
            continue
        key = str(path.relative_to(root))
        place = {"task": facts["task"], "colors": facts.get("colors", "")}
        cells.append({"experiment": "runs", "scale": "", "label": label, "job": key, "done": is_done, **place})
        made = {name: content.get(name) for name in records.MADE} | {"device": facts.get("device")}
        made["machine"] = records.machine(content.get("hardware"))
        jobs[key] = {"kind": "run", "command": None, "facts": facts, "needs": [], "path": path, "done": is_done, **made}
    table = pd.DataFrame(cells)
    if not len(table) or not table["done"].any():
        raise RecordError(
            f"{root} holds nothing to report on: no experiment of `crptpro reproduce` (experiments/*.json) and no "
            "finished downstream run."
        )
    settings = pd.DataFrame([job["facts"] for job in jobs.values()]).astype(str)
    for _, own in table.groupby(["label", "task", "colors"]):
        here = settings.loc[own.index]
        if names := [name for name in sorted(here) if name not in NOT_IN_LABELS and here[name].nunique() > 1]:
            differing = [", ".join(f"{name} {row[name]}" for name in names) for row in here.to_dict("records")]
            table.loc[own.index, "label"] += [f" ({each})" for each in differing]
    return table, pd.DataFrame.from_dict(jobs, orient="index")


# --- words ----------------------------------------------------------------------------------------------------------


def _where(job: dict[str, Any]) -> str:
    """Describe the machine and the device of a finished job; empty if the machine is not known."""
    has_threads = job["device"] == "cpu" and not pd.isna(job["threads"])
    device = _count(int(job["threads"]), "thread") if has_threads else job["device"]
    return f"{job['machine']}, {device}" if job["done"] and job["machine"] else ""


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def _number(value: float, spec: str) -> str:
    return "" if math.isnan(value) else f"{value:{spec}}"


def _or(values: pd.Series) -> str:
    return " or ".join(f"{value:,.0f}" for value in sorted(values.dropna().unique()))


def _beside(text: str, paper: Any) -> str:
    return f"{text}\npaper {paper}" if paper not in (None, "") else text


def _spread(values: pd.Series, digits: int, n: bool = True) -> str:
    """Return mean ± standard deviation (n); a single number has no deviation."""
    deviation = f" ± {values.std():.{digits}f}" if len(values) > 1 else ""
    return f"{values.mean():.{digits}f}{deviation}" + (f" (n = {len(values)})" if n else "")


# --- the head and the end of the page -------------------------------------------------------------------------------


def _contents(page: Page, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    page.section("Overview", "contents")
    numbers = cells.groupby(["experiment", "scale"], sort=False)["done"].agg(requested="size", finished="sum")
    page.table("Experiments: requested and finished results.", numbers.reset_index())
    counts = jobs.groupby("kind")["done"].agg(["sum", "size"])
    finished = ", ".join(f"{done} of {count} {kind}" for kind, done, count in counts.itertuples())
    seconds = jobs.loc[jobs["done"], "seconds"].dropna()
    work = f"; {seconds.sum() / 3600:.1f} h of work in all" if len(seconds) else ""
    page.text(f"Jobs finished: {finished}{work}. Machines, revisions and versions are at the end.")


BUDGETS = (
    ("random transitions per domain", "100,000", "transitions", "dataset", ""),
    ("encoder updates on datasets", "50,000", "updates", "encoder", ""),
    ("pre-training batch", "512, or the method's own", "batch_size", "encoder|explored", ""),
    ("prototypes", "512", "loss.num_prototypes", "encoder|explored", "crptpro|proto-rl"),
    ("env steps of exploration (C)", "200,000", "explore.env_steps", "explored", "proto-rl-c"),
    ("agent steps per encoder update (C)", "2", "explore.encoder_update_interval", "explored", "proto-rl-c"),
    ("downstream env steps", "500,000", "env_steps", "run", "(?!drq)"),
    ("DrQ's env steps", "1,000,000", "env_steps", "run", "drq"),
    ("downstream batch", "512", "batch_size", "run", ""),
    ("downstream learning rate", "0.0001", "learning_rate", "run", "(?!drq)"),
    ("DrQ's learning rate", "0.001", "learning_rate", "run", "drq"),
    ("downstream replay", "40,000", "replay_capacity", "run", "(?!drq|proto-rl)"),
    ("replay of DrQ and Proto-RL", "100,000", "replay_capacity", "run", "drq|proto-rl"),
    ("render quality", "exact", "quality", "dataset", ""),
)
"""Name, the paper's value, and the source of ours: a fact, and patterns of the jobs' kinds and methods."""


def _limits(page: Page, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Show the budgets of every scale beside the paper's, and what such budgets cannot show."""
    page.section("Limits of this scale", "limits")
    names = [*(name for name, *_ in BUDGETS), "downstream runs per encoder"]
    table = pd.DataFrame(index=pd.Index(names, name="budget"))
    for scale, own in cells[cells["scale"] != "paper"].groupby("scale", sort=False):
        here = jobs.loc[_needed(own["job"], jobs)]
        runs = own[own["job"].map(jobs["kind"]) == "run"].drop_duplicates("job")
        encoders = jobs.loc[runs["job"], "facts"].str.get("pretrained").fillna("").to_numpy()
        of_runs = _or(runs.groupby(["label", *PLACES, encoders]).size())
        table[scale or "here"] = [*(_budget(here, *where) for _, _, *where in BUDGETS), of_runs]
    differs = any(not _is_papers(value, printed) for name, printed, *_ in BUDGETS for value in table.loc[name])
    is_known = (table != "").any(axis=1)
    if is_known.any():
        table["the paper's"] = [*(printed for _, printed, *_ in BUDGETS), "not printed, at least 6 evaluations"]
        page.table(
            "Budgets beside the paper's. It prints neither DrQ's learning rate, batch and replay nor a render quality: "
            "those are this library's.",
            table[is_known].reset_index(),
        )
    if differs:
        page.text(
            "This scale does not show which method is ahead after the full budget: methods that learn late look worse "
            "here. It does not show what an encoder learns after the plateau near ln M, which lasts for over a "
            "thousand updates at batch 512, nor the method itself where a smaller batch, replay or dataset changes it. "
            f"Fewer than {stats.MIN_RUNS} runs on a task give no interval, and two or three do not support a ranking.",
            "warning",
        )


def _is_papers(budget: str, printed: str) -> bool:
    return budget in ("", "the paper's") or re.match(rf"{re.escape(budget)}(?!,?\d)", printed) is not None


def _budget(jobs: pd.DataFrame, fact: str, kinds: str, methods: str) -> str:
    """Return the values of a fact in jobs of these kinds and methods; a job without it has the paper's."""
    facts = jobs.loc[jobs["kind"].str.fullmatch(kinds), "facts"]
    facts = pd.json_normalize(facts.tolist()).reindex(columns=["method", fact])
    values = facts.loc[facts["method"].astype(object).fillna("").str.match(methods), fact]
    words = [v if isinstance(v, str) else f"{v:,}".removesuffix(".0") for v in sorted(values.dropna().unique())]
    return " or ".join(words + ["the paper's"] * bool(values.isna().any()))


def _provenance(page: Page, jobs: pd.DataFrame) -> None:
    page.section("Machines and versions", "provenance")
    done = jobs[jobs["done"]]
    made = done[["machine", "where", "git_revision"]].value_counts(sort=False)
    page.table("Machines, as tables number them, and source revisions", made.reset_index(name="jobs"))
    facts = pd.DataFrame(done["facts"].tolist(), done.index, ["method", "domain", "updates", "env_steps"])
    spent = done[["kind", "machine", "seconds"]].join(facts).dropna(subset="seconds")
    spent["of"] = spent["method"].fillna(spent["domain"])
    groups = spent.groupby(["kind", "of", "machine"], sort=False)
    costs = groups[["updates", "env_steps"]].mean().map("{:,.0f}".format, na_action="ignore")
    costs["wall clock"] = groups["seconds"].mean().map(duration)
    costs.insert(0, "jobs", groups.size())
    page.table(
        "Mean cost of jobs. Compare times within one machine only; jobs that shared a machine slowed each other down.",
        costs.reset_index(),
    )
    sets = done["versions"].dropna().map(lambda versions: tuple(sorted(versions.items()))).value_counts()
    headings = ["version"] if len(sets) == 1 else [f"version, set {number}" for number in range(1, len(sets) + 1)]
    versions = pd.DataFrame({
        f"{heading} ({_count(count, 'job')})": dict(each) for heading, (each, count) in zip(headings, sets.items())
    })  # fmt: skip
    page.table("Versions", versions.rename_axis("package").reset_index())
    page.section("Jobs", "jobs")
    marks = (records.LOG, "eval.csv")
    has_begun = np.array([any((path / name).exists() for name in marks) for path in jobs["path"]], bool)
    table = pd.DataFrame({
        "job": jobs.index, "state": np.select([jobs["done"], has_begun], ["finished", "begun"], "not begun"),
        "wall clock": jobs["seconds"].map(duration, na_action="ignore"), "attempts": jobs["attempts"],
        "machine": jobs["machine"], "revision": jobs["git_revision"],
        "command": jobs["command"].map(lambda words: shlex.join(["crptpro", *words]), na_action="ignore"),
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
        page.text(f"Nothing is finished yet: {_count(len(cells), 'result')} requested.", "warning")
        return
    page.text(f"Finished: {len(cells) - len(missing)} of {_count(len(cells), 'result')}.")
    if len(missing):
        counts = missing["label"].value_counts(sort=False)
        names = "; ".join(f"{label}: {count}" for label, count in counts.items())
        page.text(f"Missing: {names}. Missing results are left out, not replaced.", "warning")
        places = missing.drop(columns=["experiment", "scale", "done"])
        page.table(_count(len(missing), "missing result"), places, fold=True)
    _measurements(page, experiment, name, cells, jobs)
    _efficiency(page, name, cells, jobs)
    _scores(page, name, cells, jobs)


# --- downstream scores ----------------------------------------------------------------------------------------------


def _scores(page: Page, name: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    evaluations = _evaluations(page, cells, jobs)
    if evaluations.empty:
        return
    last = evaluations.groupby(["group", "label", "run"], sort=False)["env_steps"].idxmax()
    runs = evaluations.loc[last].assign(expert=lambda own: own["task_name"].map(published.EXPERT_SCORES))
    page.text(
        f"Runs of {_or(runs['env_steps'])} env steps. n is the number of runs behind a score. “paper” is the printed "
        f"score after {published.ENV_STEPS:,} env steps (DrQ: {published.DRQ_ENV_STEPS:,}), which is not comparable "
        "with that of a smaller budget.",
        "note",
    )
    if jobs["command"].isna().all():  # no experiment says how its encoders were trained
        trained = runs[~runs["label"].str.startswith(("random-encoder", "drq"))]
        encoders = trained.groupby("label", sort=False)["encoder"].nunique()
        if several := [f"{label}: {count}" for label, count in encoders.items() if count > 1]:
            page.text(
                f"Runs on several encoders count as one method ({'; '.join(several)}). Beyond the domains of their "
                "training, whether these encoders were trained alike is not recorded here.",
                "warning",
            )
    late = _late(evaluations)
    for varied, part in runs.groupby("varied", sort=False):
        of = f", mean ± standard deviation over runs (n).{f' {varied} varied.' if varied else ''}"
        _score_table(page, part, f"Episode return at the final evaluation{of}")
        if len(late):
            own = late[late["varied"] == varied]
            _score_table(page, own, f"Episode return, mean of the last {LATE} evaluations of each run{of}")
        if varied:
            _sensitivity(page, f"{name}-{varied}", part, str(varied))
    _aggregates(page, runs)
    _learning_curves(page, name, evaluations)


def _evaluations(page: Page, cells: pd.DataFrame, jobs: pd.DataFrame) -> pd.DataFrame:
    """Return a row per evaluation of a run: its mean return as ``score``, and the place and the encoder of the run.

    ``task`` is the row of the tables, with group and colours; ``task_name`` the task alone.
    """
    rows = _records(page, cells.sort_values("group", kind="stable"), jobs, ["run"], "eval", *EPISODES)
    if rows.empty:
        return rows
    rows = rows.rename(columns={"task": "task_name", "job": "run"})
    rows["colors"] = rows["colors"].replace("", "normal")
    colors = (", " + rows["colors"]).mask(rows["colors"] == "normal", "")
    rows["task"] = (rows["group"] + " " + rows["task_name"]).str.strip() + colors
    rows["encoder"] = rows["run"].map({run: _encoder(run, jobs) for run in rows["run"].unique()})
    columns = ["task", "task_name", "colors", "varied", "value", "encoder", "env_steps"]
    scores = rows.groupby(["group", "label", "run", *columns], sort=False)["episode_return"].mean()
    return scores.reset_index(name="score")


LATE = 10  # evaluations at the end of a run, whose mean is less noisy than one of them


def _late(evaluations: pd.DataFrame) -> pd.DataFrame:
    """Return each run's mean of its last evaluations; empty if they are more than a quarter of any run."""
    run = ["group", "label", "run"]
    if evaluations.groupby(run).size().min() < 4 * LATE:
        return evaluations[:0]
    last = evaluations.sort_values("env_steps", kind="stable").groupby(run).tail(LATE)
    about = last.columns.difference(["env_steps", "score"], sort=False).tolist()
    return last.groupby(about, sort=False)["score"].mean().reset_index()


def _encoder(run: str, jobs: pd.DataFrame) -> str:
    """Return the job or the artifact that a run's encoder comes from; the run itself if it has none.

    Encoders that were fine-tuned from one base share it: it is their one draw of a pre-training.
    """
    if encoders := _needed([run], jobs, "encoder", "explored", "finetuned", "untrained"):
        return encoders[-1]
    return jobs.loc[run, "facts"].get("pretrained") or run


def _score_table(page: Page, runs: pd.DataFrame, caption: str) -> None:
    """Show a row per task as the paper does, or per method where few tasks have many methods."""
    cells = {}
    groups = runs.groupby(["label", "task", "group", "task_name", "colors"])["score"]
    for (label, task, *place), own in groups:
        text = _spread(own, 0 if abs(own.mean()) >= 10 else 1)
        cells[label, task] = _beside(text, published.published_score(label, *place))
    labels, tasks = in_order(runs["label"]), runs["task"].unique()
    table = pd.Series(cells).unstack().loc[labels, tasks].rename_axis("method")
    has_rows_of_methods = len(tasks) <= 3 < len(labels)
    page.table(caption, (table if has_rows_of_methods else table.T.rename_axis("task")).reset_index())


NORMALIZED = {
    "mean / DrQ": stats.mean, "IQM / DrQ": stats.iqm, "median / DrQ": stats.median,
    "optimality gap": stats.optimality_gap,
}  # fmt: skip


def _aggregates(page: Page, runs: pd.DataFrame) -> None:
    """Compare methods on the tasks that all of them have."""
    labels = in_order(runs["label"])
    has_run = runs.groupby(["task", "label"], sort=False).size().unstack().notna()[labels]
    for task, row in has_run[~has_run.all(axis=1)].iterrows():
        page.text(f"Left out of the comparison of methods: {task} (no run of {'; '.join(row.index[~row])}).", "note")
    shared = has_run.index[has_run.all(axis=1)]
    if shared.empty:
        page.text("There is no task on which every method has a run: nothing to aggregate.", "note")
        return
    kept = runs[runs["task"].isin(shared)]
    normal = kept.assign(score=kept["score"] / kept["expert"]).dropna(subset="expert")
    drq = kept[kept["label"] == "drq"]
    places = kept[["group", "task_name", "colors"]].drop_duplicates().to_numpy().tolist()
    rows = []
    for label in labels:
        own, own_normal = (frame[frame["label"] == label] for frame in (kept, normal))
        found = stats.estimate(stats.mean, own)
        encoders = own.loc[own["encoder"] != own["run"], "encoder"].nunique()
        line: dict[str, Any] = {"method": label, "tasks": len(shared), "runs": found.runs, "encoders": encoders or ""}
        line["mean score"] = _beside(f"{found:.0f}", _paper_mean(label, places))
        if len(normal):
            line |= {title: f"{stats.estimate(each, own_normal):.3f}" for title, each in NORMALIZED.items()}
            line["mean / DrQ"] = _beside(line["mean / DrQ"], _paper_mean(label, places, normalized=True))
        if len(drq) and (drq["score"] > 0).all():
            line["mean / DrQ here"] = "1" if label == "drq" else f"{stats.estimate(stats.relative_mean, own, drq):.3f}"
        rows.append(line)
    page.table(
        f"Over the {_count(len(shared), 'task')} that all methods share. A task counts once per group and colours; a "
        "run of several tasks counts once. Normalised scores are divided by the paper's DrQ. “paper” is its printed "
        "mean over all of its tasks, or the mean of its cells for these tasks.",
        rows,
    )
    fewest = kept.groupby(["label", "task"]).size().groupby("label").min()
    if fewest.max() >= stats.MIN_RUNS:
        held = "; ".join(f"{count}: {share:.0%}" for count, share in stats.COVERAGE.items())
        page.text(
            f"Brackets are {stats.CONFIDENCE:.0%} intervals ({stats.REPLICATES:,} stratified bootstrap replicates that "
            "resample encoders, then runs within them). With one encoder they describe it, not its method. For "
            "independent, normally distributed runs of one task they cover the true mean this often, by number of "
            f"runs: {held}. Runs that share an encoder are not independent: with two or three encoders it is less.",
            "warning",
        )
    if fewest.min() < stats.MIN_RUNS:
        page.text(
            f"A method has intervals from {stats.MIN_RUNS} runs on every task; here some have as few as "
            f"{fewest.min()}. The standard deviations above show the spread of runs.",
            "warning",
        )
    if missing := sorted(kept.loc[kept["expert"].isna(), "task_name"].unique()):
        page.text(f"The paper has no DrQ score for {', '.join(missing)}: in the mean score only.", "note")
    _improvement(page, kept)


def _improvement(page: Page, runs: pd.DataFrame) -> None:
    """Compare runs of crptpro with those of each other method; one run against one says nothing."""
    by_label = {label: runs[runs["label"] == label] for label in in_order(runs["label"])}
    ours = by_label.pop("crptpro", None)
    rows = []
    for label, own in by_label.items() if ours is not None else ():
        if len(ours) + len(own) == 2:
            continue
        better = stats.estimate(stats.probability_of_improvement, ours, own)
        rows.append({"other method": label, "runs of both": better.runs, "P(crptpro > other)": f"{better:.2f}"})
    page.table(
        "Probability that a run of crptpro scores higher than one of the other method on the same task; 0.5 is no "
        "difference. On one task, two runs against two give 0, 0.25, 0.5, 0.75 or 1.",
        rows,
    )


def _paper_mean(label: str, places: Sequence[Sequence[str]], normalized: bool = False) -> str:
    """Return what the paper printed for all of its seen tasks; for a part of them, the mean of its cells."""
    digits, means = (3, published.SEEN_NORMALIZED_MEAN) if normalized else (0, published.SEEN_MEAN)
    if {(group, task) for group, task, _ in places} == {row[:2] for row in published.SEEN} and label in means:
        return f"{means[label]:.{digits}f}"
    values = []
    for group, task, colors in places:
        if expert := published.EXPERT_SCORES.get(task) if normalized else 1.0:
            score = published.published_score(label, group, task, colors)
            values.append(score.mean / expert if score else math.nan)
    return _number(float(np.mean(values)) if values else math.nan, f".{digits}f")


def _estimated(found: stats.Estimate, **columns: Any) -> pd.DataFrame:
    """Return an estimate and its interval as points of a figure."""
    points = pd.DataFrame({"y": found.value, "low": found.low, "high": found.high})
    return points.assign(**columns).astype({"low": float, "high": float})


def _learning_curves(page: Page, name: str, evaluations: pd.DataFrame) -> None:
    drawn = []
    for (task, label), own in evaluations.groupby(["task", "label"], sort=False):
        # A task whose episodes end early is evaluated at other env steps in each run.
        runs = own.pivot_table("score", ["task", "encoder", "run"], "env_steps")
        runs = runs.interpolate("index", axis=1, limit_area="inside").dropna(axis=1)
        if runs.empty:  # no env steps that the evaluations of all runs span
            continue
        found = stats.estimate(stats.mean, runs.reset_index(), columns=list(runs))
        about = {"panel": task, "label": label, "n": str(len(runs))}
        drawn.append(_estimated(found, x=runs.columns, **about, line="mean", thin=False))
        if found.low is None and len(runs) > 1:  # too few for an interval: the runs themselves
            curves = own[["env_steps", "score", "run"]].set_axis(["x", "y", "line"], axis=1)
            drawn.append(curves.assign(**about, thin=True))
    if drawn:
        page.figure(
            f"{name}-curves",
            f"Episode return along training: mean over runs, interpolated between evaluations, with "
            f"{stats.CONFIDENCE:.0%} bootstrap intervals from {stats.MIN_RUNS} runs up, below that with a thin line "
            "per run.",
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


COSTS = {
    "s per encoder update": ("seconds_per_update", ".3g"),
    "s per agent step": ("seconds_per_decision", ".3g"),
    "encoder updates at this scale": ("budget_updates", ",.0f"),
    "hours at this scale": ("projected_hours", ".3g"),
    "hours of collecting": ("collecting", ".3g"),
    "encoder updates, paper's budget": ("paper_updates", ",.0f"),
    "hours, paper's budget": ("paper_projected_hours", ".3g"),
    "the same and collecting": ("hours", ".3g"),
}
"""Heading to the column of ``timing.csv``, or of what follows from it, and its format."""


def _efficiency(page: Page, name: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    rows = _records(page, cells, jobs, ["timing"], "timing")
    if rows.empty:
        return
    transitions = jobs["facts"].str.get("transitions")
    data = rows["job"].map(lambda job: transitions[_needed([job], jobs, "dataset")].mean())
    rows["collecting"] = rows["collection_seconds"].astype(float) / 3600
    rows["hours"] = rows["paper_projected_hours"] + (rows["collecting"] * (PAPER.transitions / data)).fillna(0)
    table = []
    for (device, threads, method, count), own in rows.groupby(["device", "threads", "method", "domains"], sort=False):
        average = own.mean(numeric_only=True)
        where = device if device != "cpu" else _count(int(threads), "thread")
        line: dict[str, Any] = {"method": method, "domains": count, "on": where}
        line |= {title: _number(average[column], spec) for title, (column, spec) in COSTS.items()}
        line["s per encoder update"] += f" (n = {len(own)})"
        if method in published.EFFICIENCY and count in (1, 2, 3):
            hours, updates = (values[count - 1] for values in published.EFFICIENCY[method])
            line["encoder updates, paper's budget"] += f"\npaper {updates:,}"
            line["hours, paper's budget"] += f"\npaper {hours:g}"
        table.append({**line, "machine": ", ".join(sorted(set(jobs.loc[own["job"], "machine"]) - {""}))})
    page.table(
        "Pre-training by number of domains: projected from some timed updates (n timings) to whole budgets; the "
        "paper's hours are those of an NVIDIA Tesla P100. Compare times within one machine only. Hours of active "
        "methods include their environments. Random data is collected once for all methods that use it: its hours are "
        "those of this scale, and for the paper's budget in proportion to its transitions.",
        table,
    )


# --- measurements of encoders and data ------------------------------------------------------------------------------


def _measurements(page: Page, experiment: str, name: str, cells: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Report the small tables of jobs. A job in two groups, as an (S) method's, counts once."""
    groups = cells.groupby("job")["group"].agg(lambda own: ", ".join(sorted(set(own))))
    once = cells.drop_duplicates("job").assign(group=lambda own: own["job"].map(groups))
    for kind, measure in (("coverage", _coverage), ("embeddings", _embeddings)):
        rows = _records(page, once, jobs, [kind], kind)
        if len(rows):
            measure(page, name, rows, jobs)
    trained = ["encoder", "explored", "finetuned"]
    if experiment == "prototypes":
        rows = _records(page, once, jobs, trained, "pretrain", "updates", *SPREAD)
        if len(rows):
            _prototypes(page, name, rows)
    else:
        rows = _records(page, cells, jobs, trained, "pretrain", "updates")
        for group, own in rows.groupby("group") if len(rows) else ():
            _diagnostics(page, f"{name}-{group}", f"Group {group}: diagnostics" if group else "Diagnostics", own)
    rows = _records(page, cells, jobs, ["probe"], "probe")
    if len(rows):
        _probes(page, rows)


SPREAD = {
    "prototype_kne_3": "KNE, k = 3",
    "prototype_kne_half": "KNE, k = M/2",
    "prototype_ane": "ANE",
    "prototype_dispersion": "L_intr",
}
"""Column of ``pretrain.csv`` to its heading."""


def _last(rows: pd.DataFrame, keys: list[str], numbers: list[str], window: int = 1) -> pd.DataFrame:
    """Return, by keys, the number of jobs, and the mean over jobs of the last values of each number."""
    by_job = rows.groupby([*keys, "job"], sort=False)[numbers]
    ends = by_job.agg(lambda own: own.dropna().tail(window).mean()).groupby(keys, sort=False)
    return ends.mean().assign(n=ends.size()).reset_index()


def _prototypes(page: Page, name: str, rows: pd.DataFrame) -> None:
    table = []
    for end in _last(rows, ["label"], [*SPREAD, "updates"]).to_dict("records"):
        paper = published.PROTOTYPE_METRICS.get(end["label"])
        line = {"variant": end["label"], "encoders": end["n"], "updates": f"{end['updates']:,.0f}"}
        for column, title in SPREAD.items():
            printed = _number(getattr(paper, column, math.nan), ".3f")
            line[title] = _beside(f"{end[column] * 1e4:.3f}", printed)
        table.append(line)
    page.table(
        "Spread of the prototypes at the end of pre-training, in units of 1e-4, mean over encoders; lower is wider. "
        "The k of the paper's KNE is unpublished: its values are shown beside k = 3, which is another quantity.",
        table,
    )
    points = rows.rename(columns={"updates": "x", "job": "line", **SPREAD})
    points = points.melt(["label", "line", "x"], list(SPREAD.values()), "panel", "y")
    caption = "Spread of the prototypes along training, a line per encoder."
    page.figure(f"{name}-spread", caption, draw(points, "encoder updates"))


def _coverage(page: Page, name: str, rows: pd.DataFrame, jobs: pd.DataFrame) -> None:
    """Show how much of a domain the data covers along pre-training: random policy against explorers."""
    rows["label"] = (rows["method"].astype(str) + " explorer").mask(rows["source"] == "random", "random policy")
    # Several explorers share one random dataset: equal rows are one curve.
    rows = rows.drop_duplicates(["domain", "label", "env_steps", "coverage", "samples"])
    ends = _last(rows, ["domain", "label"], ["env_steps", "samples", "coverage"])
    ends["all windows"] = _last(rows, ["domain", "label"], ["coverage"], window=10)["coverage"]
    for column, form in {"env_steps": ",.0f", "samples": ",.0f", "coverage": ".4f", "all windows": ".4f"}.items():
        ends[column] = ends[column].map(f"{{:{form}}}".format)
    page.table(
        "Coverage at the end: particle estimate over observations from the last of up to ten equal windows of the "
        "training, and from as many agent steps of the random policy; mean over n runs; higher is wider. Env steps are "
        "the explorer's in all domains.",
        ends.rename(columns={"label": "data"}),
    )
    points = rows.rename(columns={"domain": "panel", "job": "line", "env_steps": "x", "coverage": "y"})
    caption = "Coverage along pre-training, a line per run; compare equal numbers of samples only."
    figure = draw(points, "env steps of the explorer, all domains", "particle estimate")
    page.figure(f"{name}-curves", caption, figure)


def _embeddings(page: Page, name: str, rows: pd.DataFrame, jobs: pd.DataFrame) -> None:
    for place, (job, own) in enumerate(rows.groupby("job", sort=False), 1):
        path = jobs.loc[job, "path"] / "explained.json"
        try:
            shares = read_json(path, error=RecordError)["explained_variance_ratio"]
        except (RecordError, KeyError) as reason:
            page.text(f"Left out: {path} cannot be read ({reason}).", "warning")
            continue
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
"""Column of ``pretrain.csv`` to its heading."""
DRAWN = ("comp", "embedding_cosine", "assignment_entropy_frac")  # along training, those that a record has
WINDOW = 5  # a final value is the mean over this many rows at the end of a record
PLATEAU = 0.99  # of ln M: a comparative loss that stays below has left the plateau, where all prototypes look alike


def left_plateau(record: pd.DataFrame) -> float:
    """Return after how many encoder updates a comparative loss has left its plateau for good.

    This is the first row of ``pretrain.csv`` from which the loss stays below 99 % of ln M; infinity if the record ends
    on the plateau, and NaN if there is no such loss.
    """
    known = record.reindex(columns=["updates", "comp", "ln_num_prototypes"]).dropna()
    if known.empty:
        return math.nan
    on_plateau = np.flatnonzero(known["comp"] >= PLATEAU * known["ln_num_prototypes"])
    first = on_plateau[-1] + 1 if len(on_plateau) else 0
    return float(known["updates"].iloc[first]) if first < len(known) else math.inf


def _diagnostics(page: Page, name: str, title: str, rows: pd.DataFrame) -> None:
    shown = {column: heading for column, heading in DIAGNOSTICS.items() if column in rows}
    drawn = [shown[column] for column in DRAWN if column in shown]
    points = rows.rename(columns={"job": "line", "updates": "x", **shown})
    points["n"] = points.groupby("label")["line"].transform("nunique").astype(str)
    points = points.melt(["label", "line", "x", "n"], drawn, "panel", "y").dropna(subset="y")
    if len(points):
        has_plateau = "ln_num_prototypes" in rows and points["panel"].iloc[0] == DIAGNOSTICS["comp"]
        logs = rows["ln_num_prototypes"].dropna().unique() if has_plateau else ()
        marks = {f"ln M = {value:.3f}": value for value in logs}
        caption = f"{title} along pre-training, a line per encoder (n in the legend)."
        page.figure(name, caption, draw(points, "encoder updates", marks=marks))
    ends = _last(rows, ["label"], list(shown), WINDOW).rename(columns={"n": "encoders", **shown})
    ends[list(shown.values())] = ends[list(shown.values())].map(lambda value: _number(value, ".4g"))
    by_run = rows.groupby(["label", "job"])
    left = pd.Series({run: left_plateau(record) for run, record in by_run})
    summary = pd.DataFrame({"updates": by_run["updates"].max(), "left the plateau at": left})
    summary = summary.groupby(level=0).agg(_or).replace("inf", "not left", regex=True)
    ends = ends[["label"]].join(summary, on="label").join(ends.drop(columns="label"))
    page.table(
        f"{title} at the end of pre-training. Mean of the last {WINDOW} rows of a record, then over encoders. The "
        f"plateau is left where the comparative loss stays below {PLATEAU:.0%} of ln M from then on: at ln M, or with "
        "a cosine near 1, nothing has been learned yet.",
        ends,
    )


MEASURES = {
    "r2_position": ("R2 of positions", 3),
    "r2_velocity": ("R2 of velocities", 3),
    "effective_rank": ("Effective rank (at most the number of observations)", 1),
    "mean_cosine": ("Mean pairwise cosine", 4),
}
"""Measure of ``probe.csv`` to its heading and digits."""


def _probes(page: Page, rows: pd.DataFrame) -> None:
    """Show a table per measure and embedding, with a column per domain and colours."""
    page.text(
        f"R2 is computed on held-out episodes: {_or(rows['samples'])} observations per probe, "
        f"{_or(rows['held_out_episodes'])} episodes held out. A mean over coordinates counts a negative R2 as 0. "
        "Episodes are held out from the regression only: an encoder trained on a domain's random data may have seen "
        "these observations, without their states. Active and untrained encoders have not, and no encoder has seen "
        "those of unseen domains.",
        "note",
    )
    means = rows[rows["coordinate"].isna()].dropna(subset="value").sort_values(["domain", "colors"], kind="stable")
    colors = (", " + means["colors"].str.replace("_", " ")).mask(means["colors"] == "normal", "")
    groups = ", " + means["group"] if means["group"].nunique() > 1 else ""
    seen = means["seen"].map({"yes": "seen", "no": "unseen"})
    means = means.assign(at=means["domain"] + colors, encoder=means["label"] + groups, seen=seen)
    for embedding, (measure, (title, digits)) in product(means["embedding"].unique(), MEASURES.items()):
        own = means[(means["embedding"] == embedding) & (means["measure"] == measure)]
        if own.empty:  # e.g. the R2 of positions that hardly vary
            continue
        places = own.groupby(["encoder", "group", "at"], sort=False)
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
