"""A baseline with active pre-training (Proto-RL, APT, BeCL), then SAC on each task.

    python recipes/explore.py --method proto-rl-c --domains A     # one encoder for a group; days on two cores
    python recipes/explore.py --method apt-s --domains walker     # one encoder for one domain
    python recipes/explore.py --method becl --domains A

One agent per domain explores for the intrinsic reward alone, and the encoder learns from its observations. Every
default is the method's number. Disk: a replay per domain (-c on group A 0.8 GB, -s 2.4 GB), 1.3 GB per task (Proto-RL
2.6). If killed, the same command resumes. Writes one eval.csv per task below OUT, a row per episode.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from crptpro.console import parse, run_main
from crptpro.domains import expand_groups, get_domain
from crptpro.objectives import get_method
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.seeding import derive_seed, seed_everything
from crptpro.training import DownstreamConfig, ExploreConfig, pretrain_active, train_downstream


@dataclass
class Config:
    """Method, domains and tasks; the numbers of a stage are below --explore.* and --downstream.*."""

    method: Literal["proto-rl-c", "proto-rl-s", "apt-c", "apt-s", "becl"] = "proto-rl-c"
    """-c: one encoder for several domains; -s: for one domain"""
    domains: tuple[str, ...] = ("A",)
    """domains or group letters"""
    tasks: tuple[str, ...] | None = None
    """tasks to learn (None: the domains' own)"""
    out: Path = Path("runs/explore")
    """everything is written below this directory"""
    seed: int = 0
    """seeds every stage"""
    quality: Literal["exact", "fast"] = "exact"
    """render quality"""
    explore: ExploreConfig = field(default_factory=ExploreConfig)
    """active pre-training"""
    downstream: DownstreamConfig = field(default_factory=DownstreamConfig)
    """SAC on the frozen encoder"""


def main(config: Config) -> None:
    """Run the two stages; finished ones are skipped."""
    domains = expand_groups(config.domains)
    tasks = config.tasks or [get_domain(domain).task for domain in domains]
    for task in tasks:
        get_domain(task)  # an unknown name ends the recipe here, not hours later
    method = get_method(config.method)
    name = f"{config.method}_{'_'.join(config.domains)}_seed_{config.seed}"

    seed_everything(config.seed)
    loss = method.build(method.build_encoder())
    settings = replace(config.explore, seed=config.seed, quality=config.quality)
    result = pretrain_active(loss, domains, method=config.method, run_dir=config.out / name, config=settings)
    pretrained = load_pretrained(save_pretrained(result, config.out / name / "encoder"))

    for task in tasks:
        seed = derive_seed(config.seed, "task", task)
        settings = replace(config.downstream, seed=seed, quality=config.quality)
        train_downstream(task, pretrained, run_dir=config.out / f"{task}_{name}", config=settings)


if __name__ == "__main__":
    run_main(lambda: main(parse(Config, __doc__)))
