"""The paper's pipeline for one group and one method: collect, pre-train one encoder, then SAC on each task.

    python recipes/paper.py --group A                             # CRPTpro at paper scale: days on two cores
    python recipes/paper.py --group A --method atc                # another loss on the same random data
    python recipes/paper.py --group C --tasks walker_run          # an unseen task on group C's encoder
    python recipes/paper.py --group A --method random-encoder     # the control: the same without pre-training

Every default is the paper's number, or the sources' where the paper is silent. Disk: 2.1 GB per domain and 1.3 GB per
task. Memory: 4 GB; with dense maps 20 GB (bfloat16) or 36 GB (float32). If killed, the same command resumes; another
seed needs another --out, because its random data differ. Writes one eval.csv per task below OUT, a row per episode.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from crptpro.console import parse, run_main
from crptpro.data import collect_group
from crptpro.domains import GROUPS, get_domain
from crptpro.objectives import get_method
from crptpro.pretrained import load_pretrained, random_pretrained, save_pretrained
from crptpro.seeding import derive_seed, seed_everything
from crptpro.training import DownstreamConfig, PretrainConfig, pretrain, train_downstream


@dataclass
class Config:
    """Group, method and tasks; the numbers of a stage are below --pretrain.* and --downstream.*."""

    group: Literal["A", "B", "C", "D"] = "A"
    """domains to pre-train on: A cheetah walker quadruped, B cartpole pendulum manipulation, C manipulation hopper
    finger, D walker pendulum hopper"""
    method: Literal["crptpro", "crptpro-fast", "released-code", "atc", "atc-native", "random-encoder",
                    "random-encoder-standardised"] = "crptpro"  # fmt: skip
    """how the encoder learns from random data, or which control"""
    tasks: tuple[str, ...] | None = None
    """tasks to learn (None: the group's own)"""
    out: Path = Path("runs/paper")
    """everything is written below this directory"""
    seed: int = 0
    """seeds every stage"""
    transitions: int = 100_000
    """b: random transitions per domain"""
    workers: int = 2
    """collecting processes"""
    quality: Literal["exact", "fast"] = "exact"
    """render quality"""
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    """pre-training"""
    downstream: DownstreamConfig = field(default_factory=DownstreamConfig)
    """SAC on the frozen encoder"""


def main(config: Config) -> None:
    """Run the three stages; finished ones are skipped."""
    tasks = config.tasks or [get_domain(domain).task for domain in GROUPS[config.group]]
    for task in tasks:
        get_domain(task)  # an unknown name ends the recipe here, not hours later
    method = get_method(config.method)
    name = f"{config.method}_group_{config.group}_seed_{config.seed}"
    datasets = {}
    if config.method != "random-encoder":
        datasets = collect_group(
            GROUPS[config.group],
            config.out / "data",
            transitions=config.transitions,
            seed=config.seed,
            workers=config.workers,
            quality=config.quality,
        )

    if method.loss_class is None:  # a control
        pretrained = random_pretrained(config.seed, method=config.method, datasets=datasets.values())
    else:
        seed_everything(config.seed)
        loss = method.build(method.build_encoder())
        settings = replace(config.pretrain, seed=config.seed)
        result = pretrain(loss, datasets, method=config.method, run_dir=config.out / name, config=settings)
        pretrained = load_pretrained(save_pretrained(result, config.out / name / "encoder"))

    for task in tasks:
        seed = derive_seed(config.seed, "task", task)
        settings = replace(config.downstream, seed=seed, quality=config.quality)
        train_downstream(task, pretrained, run_dir=config.out / f"{task}_{name}", config=settings)


if __name__ == "__main__":
    run_main(lambda: main(parse(Config, __doc__)))
