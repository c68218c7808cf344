"""Compute the tables of the README, docs/start.md and docs/results.md from the records in results/.

``python docs/results.py`` writes each table between its markers, ``<!-- table: name -->`` and ``<!-- end -->``, and
draws the figures. :func:`filled` is what a test compares the pages with.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import ttest_ind

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "results"
PAGES = (ROOT / "README.md", ROOT / "docs" / "start.md", ROOT / "docs" / "results.md")
METHODS = ("crptpro", "crptpro-fast", "crptpro-finetune", "proto-rl-c", "proto-rl-s", "atc", "apt-c", "apt-s", "becl",
           "drq", "crptpro-no-bonus", "paper-scale-10k", "random-encoder", "random-encoder-standardised")  # fmt: skip
DOMAINS = ("cheetah", "walker", "quadruped", "finger", "pendulum")
PAPER_SCALE = RECORDS / "paper_scale"
"""Records with the paper's settings; downstream runs in directories TASK/METHOD_seed_N."""
ENV_STEPS = {"cheetah_run": 100_000, "finger_spin": 60_000}
"""Length of these runs; those of cheetah_run that go on are shown apart."""
FIGURES = {task: (task, end) for task, end in ENV_STEPS.items()} | {"cheetah_run_long": ("cheetah_run", 500_000)}
"""Names of figures to the task and the env steps that are drawn."""
COLORS = {"`crptpro`": "#0b80c3", "`crptpro-no-bonus`": "#109e77", "`random-encoder`": "#d9640a",
          "`random-encoder-standardised`": "#b03a78", "`all-domains`": "#b8901b",
          "CRPTpro, its authors' log": "#5d6672", "DrQ, its authors' log": "#8a7bd8"}  # fmt: skip
PROBES = {
    **{n: PAPER_SCALE / f"probe_{n}_updates.csv" for n in (0, 1_000, 3_000, 10_000, 30_000)},
    50_000: ROOT / "src" / "crptpro" / "encoders" / "group-a" / "probe.csv",
}
"""Updates of the probed encoders to their records."""
ALL_DOMAINS = RECORDS / "all_domains"
EIGHT_DOMAINS = {
    **{name: ALL_DOMAINS / f"probe_{name}.csv" for name in ("random-encoder", "group-a")},
    "all-domains": ROOT / "src" / "crptpro" / "encoders" / "all-domains" / "probe.csv",
}
"""Encoders probed on all eight domains to their records."""


def downstream_runs(record: str, file: str = "eval") -> pd.DataFrame:
    """Return every episode of a record's finished downstream runs, with the method and the number of the seed."""
    found = []
    for done in sorted((RECORDS / record).glob("jobs/run-*/done.json")):
        facts = json.loads(done.with_name("job.json").read_text())["facts"]
        found.append(pd.read_csv(done.with_name(f"{file}.csv")).assign(method=facts["method"], run=facts["seed"]))
    if record == "controls":  # made with the same settings
        for run in sorted((RECORDS / "paper_scale_10k").glob("walker_run_seed_*")):
            table = pd.read_csv(run / f"{file}.csv")
            found.append(table.assign(method="paper-scale-10k", run=int(run.name.rpartition("_")[2])))
    table = pd.concat(found, ignore_index=True)
    table["method"] = pd.Categorical(table["method"], METHODS)  # whose order is that of the tables
    return table.sort_values(["method", "run"], kind="stable")


def quickstart() -> pd.DataFrame:
    """Returns on walker_stand at the end of each run of the quickstart."""
    rows = []
    for record in sorted((RECORDS / "quickstart_4096").glob("seed_*")):
        hardware = json.loads((record / "crptpro" / "config.json").read_text())["hardware"]
        row = {
            "seed": f"[{record.name.split('_')[1]}](../results/quickstart_4096/{record.name}/report.md)",
            "two cores with": hardware["cpu_instructions"].split(", ")[-1],
        }
        for name, method in {"pre-trained encoder": "crptpro", "untrained encoder": "random-encoder"}.items():
            runs = pd.read_csv(record / method / "eval.csv")
            row[name] = _spread(runs[runs["env_steps"] == runs["env_steps"].max()]["episode_return"])
        chance = json.loads((record / "scores.json").read_text())["uniform random policy"]
        rows.append(row | {"uniform random policy": f"{chance['mean']:.0f} ± {chance['std']:.0f}"})
    return pd.DataFrame(rows)


def small_scale() -> pd.DataFrame:
    """Return of each run of each method at the end of the small-scale comparison."""
    runs = downstream_runs("seen_small")
    last = runs[runs["env_steps"] == runs["env_steps"].max()]
    means = last.groupby(["method", "run"], observed=True)["episode_return"].mean()
    chance = pd.read_csv(RECORDS / "group_a_20k" / "uniform_walker_run.csv")["episode_return"]
    rows = [(f"`{method}`", len(own), _list(own)) for method, own in means.groupby("method", observed=True)]
    rows.append(("control: uniform random policy", f"{len(chance)} episodes", f"{chance.mean():.0f}"))
    published = _published("walker_run")[20_000]
    rows.append(("reference: `drq`, its authors' log", len(published), _spread(published) + " over runs"))
    return pd.DataFrame(rows, columns=["", "runs", "returns"])


def controls() -> pd.DataFrame:
    """Mean return over the runs of each control, and each run's at the end."""
    evaluated, trained = _control_returns()
    return pd.DataFrame(
        {
            "": f"`{method}`",
            "runs": len(own),
            "before learning": _over_runs(own[0]),
            "10,000 env steps": _over_runs(own[10_000]),
            "20,000 env steps": _over_runs(own[20_000]),
            "each run": _list(own[20_000]),
            "last five training episodes of each run": _list(trained[method]),
        }
        for method, own in evaluated.groupby("method", observed=True)
    )


def control_differences() -> pd.DataFrame:
    """Differences between the controls at the end, with Welch's 95 % interval over runs."""
    evaluated, trained = _control_returns()
    rows = []
    for what, first, second in (
        ("the bonus", "crptpro", "crptpro-no-bonus"),
        ("pre-training, without bonus", "crptpro-no-bonus", "random-encoder"),
        ("standardised features, untrained encoder", "random-encoder-standardised", "random-encoder"),
        ("these instead of pre-training, without bonus", "random-encoder-standardised", "crptpro-no-bonus"),
    ):
        row = {"what differs": what, "": f"`{first}` - `{second}`"}
        for measure, returns in {"evaluations": evaluated[20_000], "last five training episodes": trained}.items():
            low, high = ttest_ind(returns[first], returns[second], equal_var=False).confidence_interval()
            row[measure] = f"{returns[first].mean() - returns[second].mean():+.0f} ({low:+.0f} to {high:+.0f})"
        rows.append(row)
    return pd.DataFrame(rows)


def _control_returns() -> tuple[pd.DataFrame, pd.Series]:
    """Return of each run by method: of its evaluations, a column each, and of its last five training episodes."""
    trained = downstream_runs("controls", "episodes").groupby(["method", "run"], observed=True)["episode_return"]
    evaluated = downstream_runs("controls").groupby(["method", "run", "env_steps"], observed=True)["episode_return"]
    return evaluated.mean().unstack(), trained.apply(lambda returns: returns.tail(5).mean())


def _published(task: str) -> pd.DataFrame:
    """Return of every run of DrQ that its authors published, a column per evaluation."""
    table = pd.read_csv(RECORDS / "references" / "drq.csv")
    return table[table["task"] == task].pivot(index="seed", columns="env_steps", values="episode_return")


def two_tasks() -> pd.DataFrame:
    """Mean and standard deviation of an evaluation's episodes, beside what DrQ's authors published."""
    rows = []
    for task in ("cheetah_run", "walker_run"):
        for name, file in {"`crptpro`": "crptpro", "`random-encoder`": "random"}.items():
            episodes = pd.read_csv(RECORDS / "group_a_20k" / f"eval_{task}_{file}.csv").groupby("env_steps")
            rows.append((task, name, "1", {n: _spread(own) for n, own in episodes["episode_return"]}))
        chance = pd.read_csv(RECORDS / "group_a_20k" / f"uniform_{task}.csv")["episode_return"]
        drq = _published(task)
        rows.append((task, "DrQ, its authors' log", str(len(drq)), {n: _spread(drq[n]) for n in drq}))
        rows.append((task, "uniform random policy", "", dict.fromkeys(drq, _spread(chance))))
    shown = [{f"{n:,} env steps": returns[n] for n in (10_000, 20_000, 30_000)} for *_, returns in rows]
    return pd.DataFrame([{"task": t, "": name, "runs": n, **r} for (t, name, n, _), r in zip(rows, shown, strict=True)])


def paper_scale(task: str) -> pd.DataFrame:
    """Return of a task with the paper's settings: mean, least and greatest run of each method."""
    (path,) = RECORDS.glob(f"*/uniform_{task}.csv")
    chance = pd.read_csv(path)["episode_return"].mean()
    shown = range(20_000, ENV_STEPS[task] + 1, 20_000)
    table = [[name, str(len(own)), *(_over_runs(own[n]) for n in shown)] for name, own in evaluations(task)]
    table.append(["uniform random policy", "", *[f"{chance:.0f}"] * len(shown)])
    return pd.DataFrame(table, columns=[task, "runs", *(f"{n:,} env steps" for n in shown)])


def cheetah_run_means() -> pd.DataFrame:
    """Means of cheetah_run over the evaluations decided on beforehand, and over the last training episodes."""
    return _means(
        "cheetah_run",
        {
            "evaluations at 60,000 and 80,000 env steps": [60_000, 80_000],
            "at 60,000, 80,000 and 100,000": [60_000, 80_000, 100_000],
        },
        trained=(80_000, 97_000),
    )


def cheetah_run_long() -> pd.DataFrame:
    """Means of cheetah_run over the evaluations of every 100,000 env steps, of runs longer than that."""
    at = [list(range(first + 20_000, first + 120_000, 20_000)) for first in range(0, 500_000, 100_000)]
    rows = []
    for name, own in evaluations("cheetah_run"):
        own = own.reindex(columns=[n for each in at for n in each])
        own = own[own[at[1]].notna().any(axis=1)]
        if own.empty:
            continue
        row = {"cheetah_run": name, "runs": len(own)}
        row |= {f"{each[0]:,} to {each[-1]:,}": _over_runs(own[each].mean(axis=1, skipna=False)) for each in at}
        rows.append(row | {"500,000 env steps": _over_runs(own[500_000])})
    logs = {"`crptpro`": PAPER_SCALE / "cheetah_run/crptpro_seed_5/episodes.csv",
            "CRPTpro, its authors' log": RECORDS / "references/crptpro_cheetah_run_train.csv"}  # fmt: skip
    for name, path in logs.items():
        trained = pd.read_csv(path).query("env_steps > 0")
        blocks = trained.groupby((trained["env_steps"] - 1) // 100_000)["episode_return"].mean()
        means = dict(zip(list(rows[0])[2:7], blocks.map("{:.0f}".format), strict=True))
        rows.append({"cheetah_run": f"{name}, training episodes", "runs": 1, **means})
    return pd.DataFrame(rows).fillna("")


def finger_spin_means() -> pd.DataFrame:
    """Means of finger_spin over the evaluations decided on beforehand, and over the last training episodes."""
    columns = {"evaluations at 40,000 and 60,000 env steps": [40_000, 60_000]}
    return _means("finger_spin", columns, trained=(40_000, 60_000))


def _means(task: str, columns: dict[str, list[int]], trained: tuple[int, int]) -> pd.DataFrame:
    files = {path.parent.name: path for path in sorted((PAPER_SCALE / task).glob("*/episodes.csv"))}
    for path in RECORDS.glob(f"references/crptpro_{task}_train.csv"):
        files["CRPTpro, its authors' log_seed_0"] = path
    episodes = pd.concat({run: pd.read_csv(path) for run, path in files.items()}, names=["run"])
    episodes = episodes[episodes["env_steps"].between(*trained, inclusive="right")]
    last = episodes.groupby("run")["episode_return"].mean()
    last_column = "training episodes, {:,} to {:,} env steps".format(*trained)
    rows = []
    for name, own in evaluations(task):
        row = {task: name, "runs": len(own)}
        row |= {k: _over_runs(own[at].mean(axis=1, skipna=False), each=True) for k, at in columns.items()}
        row[last_column] = _over_runs(last[last.index.str.startswith(name.strip("`") + "_seed_")], each=True)
        rows.append(row)
    return pd.DataFrame(rows)


def evaluations(task: str) -> list[tuple[str, pd.DataFrame]]:
    """Return of a task with the paper's settings, ours and published, by method: a row per run, a column each."""
    runs = {path.parent.name: pd.read_csv(path) for path in sorted((PAPER_SCALE / task).glob("*/eval.csv"))}
    means = pd.concat(runs, names=["run"]).groupby(["run", "env_steps"])["episode_return"].mean().unstack()
    rows = [(f"`{method}`", own) for method, own in means.groupby(lambda run: run.partition("_seed_")[0])]
    for path in RECORDS.glob(f"references/crptpro_{task}_eval.csv"):
        log = pd.read_csv(path, index_col="env_steps")["episode_return"]
        rows.append(("CRPTpro, its authors' log", log.to_frame().T))
    return [*rows, ("DrQ, its authors' log", _published(task))]


def pretraining(record: Path, shown: tuple[str, ...] = ()) -> pd.DataFrame:
    """One pre-training with the paper's settings; the cosine of these domains, or the range over all of them."""
    table = pd.read_csv(record / "pretrain.csv").set_index("updates")
    rows = table.loc[[500, 1_000, 3_000, 5_000, 10_000, 20_000, 30_000, 40_000, 50_000]]
    columns = {"updates": rows.index.map("{:,}".format), "loss": rows["loss_comp"].map("{:.3f}".format)}
    columns |= {f"cosine: {name}": rows[f"cosine/{name}"].map("{:.3f}".format) for name in shown}
    if not shown:
        cosines = rows.filter(like="cosine/")
        columns["cosine, over domains"] = cosines.apply(lambda row: f"{row.min():.3f} to {row.max():.3f}", axis=1)
    columns["prototypes in use"] = rows["prototypes_in_use"].map("{:.0f}".format)
    columns["prototypes: cosine to the third nearest"] = rows["prototype_kne_3"].map("{:.3f}".format)
    return pd.DataFrame(columns)


def probes() -> pd.DataFrame:
    """R² of positions and velocities along pre-training; a negative one counts as 0."""
    rows = []
    for updates, scores in probe_scores(PROBES).items():
        cells = {name: _positions_velocities(scores[name]) for name in DOMAINS}
        rows.append({"updates": f"{updates:,}" if updates else "0 (`random-encoder`)", **cells})
    return pd.DataFrame(rows)


def probes_of_eight_domains() -> pd.DataFrame:
    """R² of positions and velocities of every domain of the paper; a negative one counts as 0."""
    scores = probe_scores(EIGHT_DOMAINS)
    rows = []
    for name in pd.read_csv(EIGHT_DOMAINS["group-a"])["domain"].unique():
        row = {"domain": name, "in the training data of `group-a`": "yes" if name in DOMAINS[:3] else "no"}
        row |= {f"`{encoder}`": _positions_velocities(own[name]) for encoder, own in scores.items()}
        rows.append(row)
    return pd.DataFrame(rows)


def _positions_velocities(scores: pd.Series) -> str:
    return f"{scores['r2_position']:.3f} / {scores['r2_velocity']:.3f}"


def probe_scores(paths: Mapping[Any, Path]) -> dict[Any, pd.Series]:
    """Mean R² of each domain's coordinates by encoder; a negative one counts as 0."""
    found = {}
    for key, path in paths.items():
        table = pd.read_csv(path)
        table = table[table["embedding"] == "features"].assign(value=table["value"].clip(lower=0))
        found[key] = table.groupby(["domain", "measure"])["value"].mean()
    return found


TABLES = {"quickstart": quickstart, "small scale": small_scale, "controls": controls, "two tasks": two_tasks,
          "control differences": control_differences, "cheetah_run": partial(paper_scale, "cheetah_run"),
          "cheetah_run means": cheetah_run_means, "cheetah_run long": cheetah_run_long,
          "finger_spin": partial(paper_scale, "finger_spin"), "finger_spin means": finger_spin_means,
          "pre-training": partial(pretraining, PAPER_SCALE, DOMAINS[:3]), "probes": probes,
          "pre-training on eight domains": partial(pretraining, ALL_DOMAINS),
          "eight domains": probes_of_eight_domains}  # fmt: skip


def draw_pretraining() -> None:
    """Draw the loss and the probes along pre-training with the paper's settings."""
    figure, (loss, gain) = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
    for name, record in {"group A": PAPER_SCALE, "all eight domains": ALL_DOMAINS}.items():
        table = pd.read_csv(record / "pretrain.csv")
        loss.plot(table["updates"], table["loss_comp"], label=name)
    loss.axhline(math.log(512), color="grey", linestyle=":", label="ln 512: uniform predictions")
    loss.set(title="Pre-training", xlabel="updates", ylabel="comparative loss")
    scores = probe_scores(PROBES)
    for name in DOMAINS:
        gains = [scores[n][name, "r2_velocity"] - scores[0][name, "r2_velocity"] for n in PROBES]
        unseen = name not in DOMAINS[:3]
        gain.plot(list(PROBES), gains, "o--" if unseen else "o-", label=name + " (unseen)" * unseen)
    gain.set(title="State probe, encoders of group A", xlabel="updates", ylabel="R² of velocities, beyond untrained")
    gain.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    _save(figure, "pretraining")


def draw_controls() -> None:
    """Draw the training returns of the controls at small scale."""
    figure, axes = plt.subplots(figsize=(7.4, 3.8), layout="constrained")
    episodes = downstream_runs("controls", "episodes")
    episodes = episodes[episodes["method"] != "paper-scale-10k"]  # one run, not part of the comparison
    for method, own in episodes.groupby("method", observed=True):
        runs = own.pivot(index="env_steps", columns="run", values="episode_return").rolling(5).mean()
        mean, deviation = runs.mean(axis=1), runs.std(axis=1)
        (line,) = axes.plot(mean, label=f"{method} ({runs.shape[1]} runs, mean ± sd)")
        axes.fill_between(mean.index, mean - deviation, mean + deviation, color=line.get_color(), alpha=0.1)
    axes.set(title="walker_run, small scale", xlabel="env steps", ylabel="return, mean of 5 training episodes")
    _save(figure, "controls")


def draw_task(name: str, task: str, end: int) -> None:
    """Draw the evaluations up to ``end`` env steps, of runs longer than half of it, and those that others published."""
    figure, axes = plt.subplots(figsize=(7.4, 3.8), layout="constrained")
    for method, runs in evaluations(task):
        runs = runs.loc[:, runs.columns <= end]
        runs = runs[runs.loc[:, runs.columns > end / 2].notna().any(axis=1)]
        color = COLORS[method]
        label = f"{method.strip('`')} ({len(runs)} run{'s' * (len(runs) > 1)}{', mean ± sd' * (len(runs) >= 10)})"
        if len(runs) >= 10:
            mean, deviation = runs.mean(), runs.std()
            axes.plot(mean, color=color, label=label)
            axes.fill_between(mean.index, mean - deviation, mean + deviation, color=color, alpha=0.15)
        else:
            for place, (_, run) in enumerate(runs.iterrows()):
                axes.plot(run.dropna(), "o-", ms=3, lw=1.2, color=color, label=None if place else label)
    axes.set(title=task, xlabel="env steps", ylabel="return, mean of an evaluation's episodes")
    _save(figure, name)


def _save(figure: Figure, name: str) -> None:
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        if axes.get_legend() is None:
            axes.legend(frameon=False, fontsize=8)
    figure.savefig(ROOT / "docs" / f"{name}.png", dpi=110, metadata={"Software": None})


def filled(page: str) -> str:
    """Return the text of a page with every table computed from the records."""

    def fill(match: re.Match[str]) -> str:
        return f"<!-- table: {match[1]} -->\n{_markdown(TABLES[match[1]]())}\n<!-- end -->"

    return re.sub(r"<!-- table: (.+?) -->\n.*?<!-- end -->", fill, page, flags=re.DOTALL)


def _markdown(table: pd.DataFrame) -> str:
    lines = [list(table), ["---"] * len(table.columns), *table.astype(str).to_numpy().tolist()]
    return "\n".join(re.sub(r"  +", " ", f"| {' | '.join(line)} |") for line in lines)


def _list(returns: pd.Series) -> str:
    return ", ".join(f"{value:.0f}" for value in returns)


def _over_runs(returns: pd.Series, *, each: bool = False) -> str:
    """Mean over runs, with the standard deviation from five runs up; the extremes below five, or each of up to nine.

    The number of runs is said where some of them have no value.
    """
    known = returns.dropna()
    if known.empty:
        return ""
    details = []
    if each and 1 < len(known) < 10:
        details.append(_list(known))
    elif 1 < len(known) < 5:
        details.append(f"{known.min():.0f} to {known.max():.0f}")
    if len(known) < len(returns):
        details.append(f"{len(known)} of {len(returns)} runs")
    mean = _spread(known) if len(known) >= 5 else f"{known.mean():.0f}"
    return mean + (f" ({'; '.join(details)})" if details else "")


def _spread(returns: pd.Series) -> str:
    return f"{returns.mean():.0f} ± {returns.std():.0f}"


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(filled(path.read_text()))
    draw_pretraining()
    draw_controls()
    for name, (task, end) in FIGURES.items():
        draw_task(name, task, end)
