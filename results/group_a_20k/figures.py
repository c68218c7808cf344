"""Draw the figures of this run from its records and print its table.

python results/group_a_20k/figures.py WORK    (WORK holds data/ and runs/ of commands.sh; pictures go beside this file)
"""

from __future__ import annotations

import csv
import statistics
import sys
from collections import defaultdict
from pathlib import Path

from crptpro.analysis.embeddings import embed_samples
from crptpro.data import FrameDataset
from crptpro.experiments.markdown import markdown_table
from crptpro.experiments.plots import plot_embeddings, plot_learning_curves, plot_pretraining, plot_stacks
from crptpro.pretrained import load_pretrained, random_pretrained

HERE = Path(__file__).parent
LABELS = {"crptpro": "crptpro, 3,000 updates", "random": "random-encoder"}


def returns(path: Path) -> dict[int, list[float]]:
    """Episode returns of a record by env steps."""
    found = defaultdict(list)
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            found[int(row.get("env_steps", 0))].append(float(row["episode_return"]))
    return dict(found)


def cell(values: list[float]) -> str:
    """Mean and standard deviation over episodes."""
    return f"{statistics.fmean(values):.1f} ± {statistics.stdev(values):.1f}"


def main(work: Path) -> None:
    """Pictures and table."""
    runs = work / "runs"
    plot_pretraining(runs / "group_a" / "pretrain.csv", HERE / "pretraining.png")
    datasets = {name: FrameDataset.open(work / "data" / name) for name in ("cheetah", "walker", "quadruped")}
    plot_stacks(datasets, HERE / "stacks.png")
    for label, pretrained in (
        ("crptpro", load_pretrained(runs / "group_a/encoder")),
        ("random", random_pretrained(seed=0)),
    ):
        points = embed_samples(pretrained.encoder, datasets, projector=pretrained.projector)
        plot_embeddings(points, HERE / f"embeddings_{label}.png", title=LABELS[label])
    rows = []
    for task in ("walker_run", "cheetah_run"):
        chance = returns(runs / f"{task}_uniform.csv")[0]
        records = {LABELS[name]: runs / f"{task}_{name}" / "eval.csv" for name in LABELS}
        rows.append({"task": task, "encoder": "uniform random policy", "0 env steps": cell(chance)})
        for label, record in records.items():
            scores = {
                f"{steps:,} env steps": cell(values) for steps, values in sorted(returns(record).items())
            }
            rows.append({"task": task, "encoder": label} | scores)
        spread = (statistics.fmean(chance), statistics.stdev(chance))
        plot_learning_curves(records, HERE / f"{task}.png", baseline=spread, title=f"{task}, one seed")
    columns = max(rows, key=len)
    print(markdown_table([{name: row.get(name, "") for name in columns} for row in rows]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
