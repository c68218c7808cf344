"""The README and the page of results say what the committed records say."""

from __future__ import annotations

import math
import re
import runpy
from collections.abc import Iterable, Iterator
from pathlib import Path

import pandas as pd
import pytest

from crptpro.experiments.published import SEEN, UNSEEN

RESULTS = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "results.py"))
RECORDS = RESULTS["RECORDS"]
RUNS = ("paper_scale", "paper_scale_10k")
AUTHORS = "CRPTpro, its authors' log"


@pytest.mark.parametrize("page", RESULTS["PAGES"], ids=lambda page: page.name)
def test_every_table_is_the_one_that_the_records_give(page: Path) -> None:
    text = page.read_text()
    assert "<!-- table: " in text
    assert RESULTS["filled"](text) == text, "run `python docs/results.py`"


def test_the_readme_quotes_the_returns_of_the_quickstart() -> None:
    readme = " ".join(RESULTS["PAGES"][0].read_text().split())
    ours = r"the returns were (\d+) \(pre-trained\), (\d+) \(untrained\) and (\d+) \(random actions\)"
    quoted = re.search(ours, readme)
    assert quoted is not None
    assert list(quoted.groups()) == [cell.split()[0] for cell in RESULTS["quickstart"]().iloc[-1, -3:]]


def listed(values: Iterable[float]) -> str:
    return " and ".join(", ".join(f"{value:.0f}" for value in values).rsplit(", ", 1))


def verdict(task: str, method: str, at: list[int]) -> Iterator[str]:
    """What is said by the rule that was decided on beforehand."""
    runs = dict(RESULTS["evaluations"](task))
    trained, untrained = (runs[name][at].mean(axis=1) for name in (method, "`random-encoder`"))
    met = trained.mean() - untrained.mean() >= 100 and trained.min() > untrained.max()
    means = f"is {trained.mean():.0f} on the pre-trained encoder and {untrained.mean():.0f} on untrained ones"
    if method == "`crptpro`":
        yield f"{means}. The rule is {'met' if met else 'not met'}: the difference is at least 100"
    else:
        yield f"{means}. By the rule pre-training {'helps' if met else 'does not help'}: the difference is at least 100"
    if method == "`crptpro`":
        alone = runs["`crptpro-no-bonus`"][at].mean(axis=1).mean()
        ours = f"{trained.mean():.0f} with bonus, {alone:.0f} without"
        yield f"is {ours}, {untrained.mean():.0f} on untrained encoders (three each)"
    else:
        yield f"runs on `group-a` average {trained.mean():.0f}, on untrained encoders {untrained.mean():.0f},"


def without_bonus_on_finger_spin() -> Iterator[str]:
    """What encoder and bonus contribute there, each without the other's effect."""
    runs = dict(RESULTS["evaluations"]("finger_spin"))
    names = ("`crptpro`", "`crptpro-no-bonus`", "`random-encoder`")
    both, alone, untrained = (runs[name][[40_000, 60_000]].mean(axis=1) for name in names)
    means = f"{alone.mean():.0f} on the pre-trained encoder ({listed(alone)}) and {untrained.mean():.0f} on untrained"
    met = alone.mean() - untrained.mean() >= 100 and alone.min() > untrained.max()
    yield f"{means} ones ({listed(untrained)}). These runs would {'meet' if met else 'not meet'} the rule"
    yield f"{listed(alone)} on the pre-trained encoder, {listed(untrained)} on untrained ones, means at 40,000"
    yield f"is for those with the bonus, {listed(both)}, and is met"
    yield f"the same means average {both.mean():.0f} with it, {alone.mean():.0f} without"
    yield f"The three runs with it have means of {listed(both)}, those without it {listed(alone)}"
    within, above = alone.between(both.min(), both.max()).sum(), (alone > both.max() + 100).sum()
    assert (within, above) == (2, 1)
    yield "Two without it lie in the range of those with it, the other far above"
    early = [listed(runs[name][20_000]) for name in names]
    yield f"At 20,000 env steps those with it returned {early[0]}, those without it {early[1]}"


def conditioning() -> Iterator[str]:
    """What standardised features of untrained encoders reach, beside the pre-trained and the plain untrained ones."""
    runs = dict(RESULTS["evaluations"]("cheetah_run"))
    names = ("crptpro-no-bonus", "random-encoder-standardised", "random-encoder")
    trained, standardised, plain = (runs[f"`{name}`"][[60_000, 80_000, 100_000]].mean(axis=1) for name in names)
    each = "{:.0f}, {:.0f} and {:.0f}".format
    yield f"is {standardised.mean():.0f} ({each(*standardised)})"
    count = "All three" if standardised.max() < trained.min() else "Some"
    yield f"{count} runs lie below those on the pre-trained encoder"
    how = "overlaps with" if standardised.min() < plain.max() else "lies above"
    yield f"Their range {how} that of plain untrained ones ({each(*plain)})"
    others = f"{each(*standardised)} on untrained ones with standardised features"
    yield f"{each(*trained)} on the pre-trained encoder, {others}"
    ours = f"on those with standardised features {standardised.mean():.0f} (three each)"
    yield f"on untrained encoders {plain.mean():.0f}, {ours}"


def sentences() -> Iterator[str]:
    """What the page says outside its tables, computed from the records."""
    record, first = (pd.read_csv(RECORDS / name / "pretrain.csv", index_col="updates")["loss_comp"] for name in RUNS)
    yield f"The loss is lowest at {record.idxmin():,} updates"
    yield f"a first attempt had a loss lower by {record[24_000] - first[24_000]:.3f} at 24,000 updates"
    wide = pd.read_csv(RESULTS["ALL_DOMAINS"] / "pretrain.csv", index_col="updates")
    loss, end = wide["loss_comp"], wide.filter(like="cosine/").iloc[-1].max()
    near = loss.index[(loss / math.log(512) - 1).abs() < 0.005].max()
    yield f"stays near ln 512 for {near:,} updates, is lowest at {loss.idxmin():,}"
    yield f"ends {loss.iloc[-1] - loss.min():.3f} above that"
    yield f"no domain's cosine exceeds {end:.3f}"

    paths = RESULTS["PROBES"] | {-n: RECORDS / RUNS[1] / f"probe_{n}_updates.csv" for n in (1_000, 3_000, 10_000)}
    probes = pd.DataFrame(RESULTS["probe_scores"](paths)).unstack("domain").loc[["r2_position", "r2_velocity"]]
    gains = (probes[50_000] - probes[30_000]).loc["r2_velocity"]
    much = gains[["cheetah", "finger", "walker"]]
    yield (
        f"the velocities of cheetah, finger and walker still gain {much.min():.3f} to {much.max():.3f}, those of the "
        f"others {gains.drop(much.index).max():.3f} at most"
    )
    apart = max((probes[n] - probes[-n]).abs().max().max() for n in (1_000, 3_000, 10_000))
    yield f"a first attempt's after 1,000, 3,000 and 10,000 updates differ by {apart:.3f} at most"

    scores = pd.DataFrame(RESULTS["probe_scores"](RESULTS["EIGHT_DOMAINS"])).unstack("measure")
    untrained, trained = (scores[name] for name in ("random-encoder", "group-a"))
    gains = trained - untrained
    count = "all eight" if (gains["r2_velocity"] > 0).all() else "some"
    yield f"are more predictable from `group-a` than from the untrained encoder in {count} domains"
    most = gains["r2_velocity"].idxmax()
    velocities = [own.at[most, "r2_velocity"] for own in (untrained, trained)]
    yield "The gain is largest in {}, from {:.3f} to {:.3f}".format(most, *velocities)
    low = sorted(trained.index[trained["r2_velocity"] < 0.07])
    yield f"Velocities of {' and '.join(low)} stay below 0.07"
    yield f"quadruped's positions fall by {-gains.at['quadruped', 'r2_position']:.3f}"
    wide = scores["all-domains"]
    count = "all eight" if (wide > untrained)["r2_velocity"].all() else "some"
    yield f"From `all-domains`, too, velocities are more predictable than from the untrained encoder in {count}"
    gains = (wide - trained)["r2_velocity"]
    yield f"Velocities gain {gains['cartpole']:.3f} in cartpole and {gains['cheetah']:.3f} in cheetah"
    yield f"and lose {-gains['walker']:.3f} in walker"
    yield f"the other five differ by {gains.drop(['cartpole', 'cheetah', 'walker']).abs().max():.3f} at most"
    yield f"the other six differ by {gains.drop(['cartpole', 'walker']).abs().max():.3f} at most"
    yield f"Positions differ by {(wide - trained)['r2_position'].abs().max():.3f} at most"

    means = RESULTS["cheetah_run_means"]().set_index("cheetah_run")["at 60,000, 80,000 and 100,000"]
    each = means.str.findall(r"[(, ](\d+)").map(lambda runs: " and ".join(", ".join(runs).rsplit(", ", 1)))
    yield f"{each['`crptpro-no-bonus`']} on the pre-trained encoder, {each['`random-encoder`']} on untrained ones"
    yield from verdict("cheetah_run", "`crptpro-no-bonus`", [60_000, 80_000, 100_000])
    yield from conditioning()
    both = RESULTS["cheetah_run_means"]().set_index("cheetah_run")["evaluations at 60,000 and 80,000 env steps"]
    bonus, none = (both[name].split()[0] for name in ("`crptpro`", "`crptpro-no-bonus`"))
    yield f"the runs with the bonus average {bonus}, those without it {none}"
    files = sorted(RESULTS["PAPER_SCALE"].glob("cheetah_run/*/train.csv"))
    runs = {path.parent.name: pd.read_csv(path) for path in files}
    near = pd.Series({name: run["env_steps"][run["entropy"] >= 3].max() for name, run in runs.items()})
    is_trained, is_plain = (near.index.str.startswith(name) for name in ("crptpro", "random-encoder_seed"))
    yield "falls below 3 nats (uniform: 4.16) after {:,}, {:,} and {:,} env steps".format(*near[is_plain])
    yield f"it does so after {near[is_trained].min():,} to {near[is_trained].max():,}"
    yield "in those with standardised features after {:,}, {:,} and {:,}".format(*near[~is_trained & ~is_plain])
    runs = RESULTS["PAPER_SCALE"].glob("cheetah_run/crptpro_seed_*/episodes.csv")
    ends = [end for path in runs if (end := pd.read_csv(path)["env_steps"].max()) < 100_000]
    runs = dict(RESULTS["evaluations"]("cheetah_run"))
    ours, authors = (runs[name][list(range(20_000, 120_000, 20_000))] for name in ("`crptpro`", AUTHORS))
    within = authors.iloc[0].between(ours.min(), ours.max())
    count = "all five" if within.all() else within.sum()
    yield f"It lies within the range of our runs with the bonus at {count} evaluations"
    pairs = [runs[name][[60_000, 80_000]].mean(axis=1) for name in ("`crptpro`", "`crptpro-no-bonus`")]
    gpu, cpu = ([own.iloc[part].mean() for own, part in zip(pairs, at, strict=True)]
                for at in ((slice(3), slice(1)), (slice(3, None), slice(1, None))))  # fmt: skip
    yield f"three GPU runs with the bonus average {gpu[0]:.0f}, the three CPU runs {cpu[0]:.0f}"
    yield f"one GPU run has {gpu[1]:.0f}, two CPU runs {cpu[1]:.0f}"
    drq = runs["DrQ, its authors' log"][[60_000, 80_000, 100_000]].mean(axis=1)
    yield f"From 60,000 to 100,000 env steps its runs average {RESULTS['_spread'](drq)}"
    complete = runs["`crptpro`"].loc[:, :100_000].dropna()
    means = complete[[60_000, 80_000, 100_000]].mean(axis=1)
    within = "within" if 200 <= means.mean() <= 340 else "outside"
    yield f"from 60,000 to 100,000 env steps is {means.mean():.0f} ({listed(means)}), {within} the 200 to 340"
    theirs = authors[[60_000, 80_000, 100_000]].mean(axis=1).iloc[0]
    all_of_theirs = runs[AUTHORS].loc[:, 60_000:100_000].mean(axis=1).iloc[0]
    yield f"The authors' run has {theirs:.0f} ({all_of_theirs:.0f} over all its evaluations there"
    yield f"parity with the authors' run ({theirs:.0f})"
    yield f"three new ones average {means.mean():.0f}"
    log = "[the authors' log](#a-task-with-the-settings-of-the-paper)"
    yield f"env steps is {means.mean():.0f}, that of {log} {theirs:.0f}"
    without = runs["`crptpro-no-bonus`"][[60_000, 80_000, 100_000]].mean(axis=1).mean()
    yield f"the three complete runs with the bonus average {means.mean():.0f}, those without it {without:.0f}"
    yield f"means from 60,000 to 100,000 env steps are {means.mean():.0f} with it, {without:.0f} without"
    yield f"cut off after {min(ends):,} to {max(ends):,} env steps"

    long = runs["`crptpro`"].loc["crptpro_seed_5"]
    yield f"Its evaluations fall from {long[200_000]:.0f} at 200,000 env steps to {long[240_000]:.0f} at 240,000"
    yield f"and rise to {long[340_000]:.0f} at 340,000"
    yield f"stay between {long.loc[340_000:].min():.0f} and {long.loc[340_000:].max():.0f}"
    (paper,) = (row.scores["crptpro"] for row in SEEN if (row.group, row.task) == ("A", "cheetah_run"))
    log, end = runs[AUTHORS].iloc[0], long[500_000]
    record = RESULTS["PAPER_SCALE"] / "cheetah_run/crptpro_seed_5"
    episodes = pd.read_csv(record / "eval.csv").query("env_steps == 500_000")["episode_return"]
    yield f"it returned {end:.0f}, over ten episodes between {episodes.min():.0f} and {episodes.max():.0f}"
    yield f"The paper reports {paper}, without saying over what; the authors' log has {log[500_000]:.0f}"
    yield f"this evaluation is {'the highest of all' if end == long.max() else 'not the highest'}"
    late = list(range(420_000, 520_000, 20_000))
    drq = RESULTS["_spread"](runs["DrQ, its authors' log"][late].mean(axis=1))
    yield f"its mean is {long[late].mean():.0f}. The authors' run has {log[late].mean():.0f}, DrQ's ten runs {drq}"
    yield f"five evaluations average {long[late].mean():.0f}, the authors' {log[late].mean():.0f}, DrQ's {drq}"
    yield f"the final one is {end:.0f}, the paper's {paper}"
    yield f"is {end:.0f}, that of the paper {paper}, of the authors' log {log[500_000]:.0f}"
    yield f"the last five average {long[late].mean():.0f}, those of the log {log[late].mean():.0f}"
    table = RESULTS["cheetah_run_long"]().set_index("cheetah_run")[["320,000 to 400,000", "420,000 to 500,000"]]
    ours, theirs = (table.loc[f"{name}, training episodes"].tolist() for name in ("`crptpro`", AUTHORS))
    yield f"from {ours[0]} between 300,000 and 400,000 env steps to {ours[1]} in the last 100,000"
    yield f"of the authors' run rise from {theirs[0]} to {theirs[1]}"

    (paper,) = (row.scores["crptpro"] for row in UNSEEN if (row.group, row.task) == ("A", "finger_spin"))
    yield f"The paper reports {paper} after 500,000 env steps"
    finger = dict(RESULTS["evaluations"]("finger_spin"))
    ours, untrained = (finger[name].mean() for name in ("`crptpro`", "`random-encoder`"))
    best_untrained = finger["`random-encoder`"][60_000].max()
    drq = finger["DrQ, its authors' log"]
    alone = finger["`crptpro-no-bonus`"]
    reached = f"{ours[60_000]:.0f} after 60,000 env steps, {alone[60_000].mean():.0f} without bonus"
    yield f"is: {reached}, {untrained[60_000]:.0f} on untrained encoders"
    yield f"DrQ's runs have {RESULTS['_spread'](drq[60_000])}"
    yield f"{RESULTS['_spread'](drq[[40_000, 60_000]].mean(axis=1))} for DrQ (ten)"
    yield from verdict("finger_spin", "`crptpro`", [40_000, 60_000])
    wide, narrow = (finger[name] for name in ("`all-domains`", "`crptpro`"))
    yield from without_bonus_on_finger_spin()
    means = wide[[40_000, 60_000]].mean(axis=1)
    stated = f"the three runs have a mean of {means.mean():.0f} at 40,000 and 60,000 env steps ({listed(means)})"
    yield f"{stated}, beside {narrow[[40_000, 60_000]].mean(axis=1).mean():.0f} on `group-a`"
    theirs = f"where the runs on `group-a` have {narrow[20_000].mean():.0f} on average"
    yield f"At 20,000 they returned {listed(wide[20_000])}, {theirs}"
    theirs = listed(narrow[[40_000, 60_000]].mean(axis=1))
    yield f"are {listed(means)} on `all-domains`, {theirs} on `group-a`"
    folders = [RESULTS["PAPER_SCALE"] / f"finger_spin/all-domains_seed_{seed}" for seed in range(3)]
    early = pd.read_csv(folders[2] / "episodes.csv").query("env_steps <= 40_000")["episode_return"]
    yield f"training episodes returned {early.mean():.0f} on average, {early.max():.0f} at most"
    trained = [pd.read_csv(folder / "train.csv", index_col="env_steps") for folder in folders]
    sure = [run.index[run["entropy"] < 1].min() for run in trained]
    yield "below 1 nat after {2:,} env steps, as in the other two ({0:,} and {1:,})".format(*sure)
    yield f"The critic's mean value at 40,000 was {trained[2]['q_mean'][40_000]:.0f}, nearly all"
    numbers = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "all ten")
    more, more_than_alone = (
        [numbers[count] for count in (drq[[20_000, 60_000]] > runs.mean()[[20_000, 60_000]]).sum()]
        for runs in (narrow, alone)
    )
    early = f"{ours[40_000]:.0f} with the bonus and {alone[40_000].mean():.0f} without it"
    yield f"at 40,000 env steps they average {early}, the others {untrained[40_000]:.0f}"
    above = (pd.concat([narrow, alone])[60_000] > best_untrained).sum()
    yield f"one on an untrained encoder returned {best_untrained:.0f}, more than all but {numbers[above]} on the"
    yield f"At 20,000 env steps {more[0]} of its ten runs returned more than the mean of ours with the bonus"
    yield f"at 60,000 {more[1]}. For our mean without it, the numbers are {' and '.join(more_than_alone)}."

    evaluations = pd.read_csv(RESULTS["PAPER_SCALE"] / "walker_walk/crptpro_seed_0/eval.csv")
    example = evaluations.groupby("env_steps")["episode_return"].mean()[20_000]
    chance = pd.read_csv(RESULTS["PAPER_SCALE"] / "uniform_walker_walk.csv")["episode_return"].mean()
    drq = RESULTS["_spread"](RESULTS["_published"]("walker_walk")[20_000])
    yield f"One run of this command returned {example:.0f}; random actions return {chance:.0f}, DrQ's ten runs {drq}"

    returns = RESULTS["_control_returns"]()[0][20_000].unstack("run")
    bonus = returns.loc["crptpro"] - returns.loc["crptpro-no-bonus"]
    yield f"Each of the five seeds returned more with it, by {bonus.min():.0f} to {bonus.max():.0f}"
    (small,) = (RECORDS / "controls" / "jobs").glob("encoder-crptpro-*/pretrain.csv")
    end = pd.read_csv(small).iloc[-1]
    below = 1 - end["loss_comp"] / end["ln_num_prototypes"]
    yield f"its comparative loss is {below:.0%} below that of uniform predictions".replace("%", " %")


def test_the_readme_and_the_page_say_what_the_records_give() -> None:
    text = " ".join(f"{RESULTS['PAGES'][0].read_text()} {RESULTS['PAGES'][-1].read_text()}".split())
    assert [sentence for sentence in sentences() if sentence not in text] == []
