"""How large an experiment is: the paper's numbers, a size for two CPU cores, and one for the tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from crptpro.errors import UnknownNameError
from crptpro.experiments.pieces import Settings, settings
from crptpro.experiments.published import FINETUNE_UPDATES
from crptpro.objectives import Method, get_method
from crptpro.quality import Quality


@dataclass(frozen=True)
class Scale:
    """Every budget of every experiment; the values here are the paper's.

    Args:
        name: as on the command line.
        transitions: random transitions per domain.
        quality: render quality of everything.
        updates: encoder updates on datasets, over all domains.
        batch_size: transitions per pre-training update; ``None`` for the method's own.
        loss: options of a method's loss, by method; a variant of a method, which has its loss, takes them too.
        explore: settings of active pre-training, by method; budgets and schedules are in here. An exploring method
            that is not named takes Proto-RL's, with the encoder updates that it makes every time.
        single_ablation: settings of exploring that an (S) method has in ``ablation``, instead of those in ``explore``.
        finetune_updates: encoder updates of fine-tuning, by domain; others take the largest.
        run: settings of every downstream run.
        drq: settings of DrQ's, besides ``run``.
        seeds: number of downstream seeds per encoder unless the caller says otherwise.
        alphas: weights of the dispersion loss in ``sensitivity``, besides none and the method's own.
        capacities: random transitions per domain in ``sensitivity``.
        probe_samples: observations of a state probe.
        probe_transitions: of the dataset that is probed, which needs several episodes; ``None`` for the one that
            methods are trained on.
        timing_updates: encoder updates that ``efficiency`` times, after as many to warm up.
        paper_timing_updates: the same with the paper's batches and decisions; 0 for none.
        coverage_samples: observations of a coverage estimate.
        embedded_samples: observations of each source in ``visualize``.
    """

    name: str
    transitions: int = 100_000
    quality: Quality = "exact"
    updates: int = 50_000
    batch_size: int | None = None
    loss: Mapping[str, Settings] = field(default_factory=dict)
    explore: Mapping[str, Settings] = field(default_factory=dict)
    single_ablation: Settings = (("env_steps", 200_000),)
    finetune_updates: Mapping[str, int] = field(default_factory=lambda: FINETUNE_UPDATES)
    run: Settings = ()
    drq: Settings = ()
    seeds: int = 3
    alphas: tuple[float, ...] = (5e-4, 5e-2, 5e-1)
    capacities: tuple[int, ...] = (10_000, 50_000, 100_000)
    probe_samples: int = 4_000
    probe_transitions: int | None = None
    timing_updates: int = 100
    paper_timing_updates: int = 0
    coverage_samples: int = 1_024
    embedded_samples: int = 125

    def loss_options(self, method: Method) -> Settings:
        """Options of a method's loss."""
        same = [name for name in self.loss if get_method(name).loss_class is method.loss_class]
        return self.loss.get(method.name if method.name in self.loss else next(iter(same), ""), ())

    def exploration(self, method: Method) -> Settings:
        """Settings of a method's active pre-training."""
        if method.name in self.explore or method.exploration is None or not self.explore:
            return self.explore.get(method.name, ())
        usual = dict(self.explore["proto-rl-s" if method.exploration.is_single_domain else "proto-rl-c"])
        usual["encoder_update_interval"] *= method.exploration.encoder_updates_each
        return settings(**usual)

    def finetuning_updates(self, domain: str) -> int:
        """Encoder updates of fine-tuning on a domain."""
        return self.finetune_updates.get(domain, max(self.finetune_updates.values()))


def _explorers(group: Settings, single: Settings, interval: int) -> dict[str, Settings]:
    """Budgets of the (C) and of the (S) methods, with one encoder update per `interval` decisions on average."""
    methods = {name: dict(group) for name in ("proto-rl-c", "apt-c", "becl")}
    methods |= {name: dict(single) for name in ("proto-rl-s", "apt-s")}
    return {
        name: settings(encoder_update_interval=interval * _updates_each(name), **values)
        for name, values in methods.items()
    }


def _updates_each(method: str) -> int:
    exploration = get_method(method).exploration
    assert exploration is not None
    return exploration.encoder_updates_each


def _prototypes(**options: int) -> dict[str, Settings]:
    return {name: settings(**options) for name in ("crptpro", "proto-rl-c", "proto-rl-s")}


PAPER = Scale("paper")

SMALL = Scale(
    "small",
    transitions=20_000,
    updates=3_000,
    batch_size=128,
    # As many prototypes as rows, as in the paper (512 of both): with more, most rows are their own nearest candidates
    # and the prototype reward is 0.
    loss=_prototypes(num_prototypes=128),
    # 20,000 decisions and, after the random ones, as many encoder updates as the methods on random data have.
    explore=_explorers(
        settings(env_steps=40_000, random_agent_steps=667, checkpoint_interval_env_steps=2_000),
        settings(env_steps=40_000, random_agent_steps=2_000, checkpoint_interval_env_steps=2_000),
        interval=6,
    ),
    single_ablation=(),  # its exploring is cut down already
    finetune_updates={domain: updates * 3_000 // 50_000 for domain, updates in FINETUNE_UPDATES.items()},
    run=settings(
        env_steps=20_000,
        batch_size=128,
        learning_rate=1e-3,
        replay_capacity=12_000,
        checkpoint_interval_env_steps=2_000,
    ),
    seeds=2,
    capacities=(5_000, 20_000),
    probe_samples=2_000,
    timing_updates=25,
    paper_timing_updates=7,  # as many rows
    coverage_samples=512,
)
"""A fifth of the data, 6 % of the updates, 4 % of the env steps, a quarter of the batch: a day on two CPU cores."""

_TINY_EXPLORER = settings(
    env_steps=120, random_agent_steps=8, hidden_dim=16, queue_size=32, checkpoint_interval_env_steps=60
)
TINY = Scale(
    "tiny",
    transitions=130,  # an episode of manipulation has 125
    quality="fast",
    updates=6,
    batch_size=4,
    loss={
        **_prototypes(num_prototypes=16, latent_dim=8, hidden_dim=16),
        **{name: settings(latent_dim=8) for name in ("atc", "apt-c", "apt-s")},
        "becl": settings(hidden_dim=16),
    },
    explore=_explorers(
        _TINY_EXPLORER,
        _TINY_EXPLORER,
        interval=2,
    ),
    single_ablation=(),
    finetune_updates=dict.fromkeys(FINETUNE_UPDATES, 2),
    run=settings(
        env_steps=60,
        random_agent_steps=12,
        batch_size=4,
        replay_capacity=40,
        hidden_dim=16,
        queue_size=32,
        eval_interval_env_steps=60,
        eval_episodes=1,
        checkpoint_interval_env_steps=30,
        log_interval_env_steps=10,
    ),
    seeds=1,
    alphas=(5e-2,),
    capacities=(130,),  # the data is there
    probe_samples=60,
    probe_transitions=1_100,  # three episodes; one has 500 decisions
    timing_updates=2,
    coverage_samples=32,
    embedded_samples=8,
)
"""Minutes; shows that everything runs, and nothing else."""

SCALES: dict[str, Scale] = {scale.name: scale for scale in (TINY, SMALL, PAPER)}


def get_scale(name: str) -> Scale:
    """Look a scale up.

    Raises:
        UnknownNameError: if there is none of this name.
    """
    if name not in SCALES:
        raise UnknownNameError(f"There is no scale {name!r}; choose {', '.join(SCALES)}.")
    return SCALES[name]
