"""Linear probes of the simulator's state from a frozen encoder: a measure of pre-training that needs no RL."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from crptpro.analysis.coordinates import joints_of, position_coordinates, velocity_coordinates
from crptpro.analysis.embeddings import effective_rank, embed_pixels, gram_matrix
from crptpro.data import FrameDataset
from crptpro.data.storage import gather_stacks, stack_rows
from crptpro.errors import DatasetError
from crptpro.objectives.functional import mean_pairwise_cosine
from crptpro.seeding import derive_seed
from crptpro.values import as_int

HELD_OUT = 0.25
"""Fraction of the episodes that is held out, and of the others that is used to choose the penalty."""
LEAST_SPREAD = 1e-3
"""Standard deviation (m, rad, m/s, rad/s; 1 for sines and rotations) below which a coordinate counts as constant."""
PENALTIES = tuple(10.0**power for power in range(-6, 3))
"""Candidate ridge penalties, in units of the mean eigenvalue of the fitted samples' Gram matrix."""


@dataclass(frozen=True)
class ProbeSamples:
    """Observations of one domain with their states, split into parts that share no episode."""

    pixels: Tensor  #: uint8 ``[N, C, H, W]``
    targets: Tensor  #: float64 ``[N, T]``, positions and velocities
    names: list[tuple[str, str]]  #: of the targets: ``"position"`` or ``"velocity"``, and the coordinate
    train: Tensor  #: rows to fit on
    validation: Tensor  #: rows to choose the penalty on
    test: Tensor  #: rows to score
    held_out_episodes: int  #: number of episodes in ``test``


@dataclass(frozen=True)
class ProbeResult:
    """How well one kind of embedding of one domain predicts the state.

    ``positions`` and ``velocities`` map coordinates to R2 on held-out episodes. ``left_out`` lists kind and name of the
    coordinates that hardly vary in the training or in the held-out episodes. ``effective_rank`` and ``mean_cosine``
    (over pairs) describe the spread of the embeddings.
    """

    positions: dict[str, float]
    velocities: dict[str, float]
    left_out: tuple[tuple[str, str], ...]
    effective_rank: float
    mean_cosine: float

    @property
    def position_r2(self) -> float:
        """Mean R2 of the positions; a negative one counts as 0."""
        return _mean(self.positions)

    @property
    def velocity_r2(self) -> float:
        """Mean R2 of the velocities, likewise."""
        return _mean(self.velocities)


def probe_samples(
    dataset: FrameDataset, *, samples: int = 2_000, seed: int = 0, frame_stack: int | None = None
) -> ProbeSamples:
    """Draw observations and states of a dataset, and split its episodes.

    The same seed draws the same observations and splits, whatever the colours of the dataset. ``samples`` are drawn
    without replacement; all transitions if there are fewer. ``frame_stack`` is the dataset's if ``None``.

    Raises:
        DatasetError: there is no physical state, or too few episodes or samples to split.
    """
    samples = as_int(samples, "samples", minimum=1)
    frame_stack = dataset.frame_stack if frame_stack is None else as_int(frame_stack, "frame_stack", minimum=1)
    if "qpos" not in dataset.frames or "qvel" not in dataset.frames:
        raise DatasetError(
            f"The dataset of {dataset.domain!r} stores no physical state. Its environment must emit `qpos` and `qvel` "
            "when it is made with physics_state."
        )
    transitions = dataset.transitions
    generator = torch.Generator().manual_seed(derive_seed(seed, "probe", dataset.domain))
    chosen = torch.randperm(len(transitions), generator=generator)[:samples].sort().values
    row, step, episode = (transitions.get(name)[chosen] for name in ("row", "step", "episode"))
    episodes = episode.unique()
    episodes = episodes[torch.randperm(len(episodes), generator=generator)]
    held_out = max(1, round(HELD_OUT * len(episodes)))
    for_choice = max(1, round(HELD_OUT * (len(episodes) - held_out)))
    split = (episodes[held_out + for_choice :], episodes[held_out:][:for_choice], episodes[:held_out])
    train, validation, test = [torch.isin(episode, part).nonzero().squeeze(-1) for part in split]
    if min(len(train), len(validation), len(test)) < 2:
        raise DatasetError(
            f"A probe of {dataset.path} has {len(chosen)} samples of {len(episodes)} episodes; it "
            "needs two in each of three parts that share no episode. Collect more episodes, or draw more samples."
        )
    joints = joints_of(dataset.card.get("task", dataset.domain))
    position_names, positions = position_coordinates(dataset.frames["qpos"][row], joints)
    velocity_names, velocities = velocity_coordinates(dataset.frames["qvel"][row], joints)
    names = [("position", name) for name in position_names] + [("velocity", name) for name in velocity_names]
    rows = stack_rows(row, step, frame_stack)
    pixels = gather_stacks(dataset.frames["pixels"], rows)
    targets = torch.cat([positions, velocities], 1)
    return ProbeSamples(pixels, targets, names, train, validation, test, held_out)


@torch.no_grad()
def probe(samples: ProbeSamples, encoder: nn.Module, projector: nn.Module | None = None) -> dict[str, ProbeResult]:
    """Predict the state from an encoder's frozen features, and from the projections z if there is a projector.

    Ridge regression on standardised features, in float64. Held-out episodes take no part in fitting, standardising, or
    choosing the penalty. Images are not augmented. Returns results by ``"features"`` and, with a projector, ``"z"``.
    """
    heads = {"features": None} if projector is None else {"features": None, "z": projector}
    return {
        name: probe_embeddings(samples, embed_pixels(encoder, samples.pixels, projector=head).cpu())
        for name, head in heads.items()
    }


@torch.no_grad()
def probe_embeddings(samples: ProbeSamples, embeddings: Tensor) -> ProbeResult:
    """Predict the state from embeddings ``[N, D]`` of the samples, see :func:`probe`."""
    from sklearn.metrics import r2_score

    train, validation, test = (part.numpy() for part in (samples.train, samples.validation, samples.test))
    fitted = np.concatenate([train, validation])
    targets, names = samples.targets.numpy(), samples.names
    spread = np.min([targets[part].std(0, ddof=1) for part in (train, fitted, test)], 0)
    varies = np.flatnonzero(spread > LEAST_SPREAD)
    targets = targets[:, varies]
    # A feature's scale is its deviation plus the root mean square of all deviations. With its deviation alone, a ReLU
    # feature that is active in a few samples identifies them, and the R2 of velocities fell from 0.6 to 0.
    deviation, mean = torch.std_mean(embeddings[torch.from_numpy(fitted)].double(), 0, correction=0)
    usual = deviation.square().mean().sqrt()
    gram = gram_matrix(embeddings, mean, deviation + usual if usual else torch.ones_like(mean))
    tried = _predictions(gram, targets, train, validation)
    best = np.square(tried - targets[validation]).sum(1).argmin(0)
    predicted = _predictions(gram, targets, fitted, test)[best, :, np.arange(len(varies))].T
    r2 = r2_score(targets[test], predicted, multioutput="raw_values") if len(varies) else []
    scores = {names[index]: float(value) for index, value in zip(varies, r2)}
    return ProbeResult(
        positions={name: value for (kind, name), value in scores.items() if kind == "position"},
        velocities={name: value for (kind, name), value in scores.items() if kind == "velocity"},
        left_out=tuple(name for name in names if name not in scores),
        effective_rank=effective_rank(embeddings),
        mean_cosine=mean_pairwise_cosine(nn.functional.normalize(embeddings, dim=1)).item(),
    )


def _predictions(gram: np.ndarray, targets: np.ndarray, fitted: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Predict targets ``[P, A, T]`` for each penalty; features are centred at the fitted samples' mean."""
    from sklearn.kernel_ridge import KernelRidge
    from sklearn.preprocessing import KernelCenterer

    inner, across = gram[np.ix_(fitted, fitted)], gram[np.ix_(rows, fitted)]
    centre = KernelCenterer().fit(inner)
    inner, across = centre.transform(inner), centre.transform(across)
    scale = np.trace(inner) / len(fitted) or 1.0  # constant features predict the mean
    mean = targets[fitted].mean(0)
    fits = [
        KernelRidge(alpha=penalty * scale, kernel="precomputed").fit(inner, targets[fitted] - mean)
        for penalty in PENALTIES
    ]
    return np.stack([mean + fit.predict(across) for fit in fits])


def _mean(scores: dict[str, float]) -> float:
    return sum(max(0.0, r2) for r2 in scores.values()) / len(scores) if scores else float("nan")
