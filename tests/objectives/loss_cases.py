"""Small instances of every loss, and what the conformance tests need to know about each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import LossModule, SoftUpdate

from crptpro.modules import PixelEncoder, SquashedGaussianActor, TwinCritic
from crptpro.objectives import ATCLoss, BeCLLoss, ProtoLoss, RADSACLoss, SimCLRLoss

IMAGE = (3, 15, 15)
FEATURES, ACTIONS, SKILLS = 12, 2, 3


@dataclass(frozen=True)
class LossCase:
    """A loss under test."""

    name: str
    make: Callable[..., LossModule]
    batch: Callable[..., TensorDict]
    routing: dict[str, set[str]]
    """``loss_*`` key -> names of the parameter groups that receive its gradient."""

    keys: dict[str, object]
    """Configurable key -> its default."""

    keys_hold_under_next: bool
    """Whether a key also names the entry under "next"."""

    targets: tuple[str, ...]
    """Networks that have target parameters."""

    masked: tuple = field(default=())
    """Entries into which the mask test writes garbage."""

    per_row: tuple[str, ...] = ()
    """``loss_*`` keys that have one value per row under ``reduction="none"``."""

    rows_are_coupled: bool = False
    """Whether a row's loss depends on the other rows, so that masked ones must not even take part."""

    def __str__(self) -> str:
        return self.name


def small_encoder() -> PixelEncoder:
    return PixelEncoder(IMAGE[0], channels=(4, 4), strides=(2, 1), image_size=IMAGE[1])


def image_batch(count: int = 6, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def images() -> torch.Tensor:
        return torch.randint(0, 256, (count, *IMAGE), dtype=torch.uint8, generator=generator)

    return TensorDict({"pixels": images(), "next": {"pixels": images()}}, [count])


def proto(seed: int = 0, **options) -> ProtoLoss:
    torch.manual_seed(seed)
    return ProtoLoss(small_encoder(), num_prototypes=10, latent_dim=6, hidden_dim=16, **options)


def view_batch(count: int = 6, seed: int = 0) -> TensorDict:
    pair = image_batch(count, seed)
    return TensorDict({"pixels": pair["pixels"], "pixels_view": pair["next", "pixels"]}, [count])


def skill_batch(count: int = 6, seed: int = 0) -> TensorDict:
    skills = torch.nn.functional.one_hot(torch.arange(count) % SKILLS, SKILLS).float()
    return image_batch(count, seed).set("skill", skills)


def atc(seed: int = 0, **options) -> ATCLoss:
    torch.manual_seed(seed)
    return ATCLoss(small_encoder(), **{"latent_dim": 6, "hidden_dim": 16, **options})


def simclr(seed: int = 0, **options) -> SimCLRLoss:
    torch.manual_seed(seed)
    return SimCLRLoss(small_encoder(), **{"latent_dim": 6, **options})


def becl(seed: int = 0, **options) -> BeCLLoss:
    torch.manual_seed(seed)
    return BeCLLoss(small_encoder(), **{"skill_dim": SKILLS, "hidden_dim": 16, **options})


def transition_batch(count: int = 6, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator)

    terminated = torch.zeros(count, 1, dtype=torch.bool)
    terminated[1:2] = True
    done = terminated.clone()
    done[2:3] = True  # truncated
    return TensorDict(
        {
            "features": draw(FEATURES),
            "action": draw(ACTIONS).tanh(),
            "next": {"features": draw(FEATURES), "reward": draw(1), "done": done, "terminated": terminated},
        },
        [count],
    )


def rad_sac(seed: int = 0, **options) -> RADSACLoss:
    torch.manual_seed(seed)
    shape = {"bottleneck_dim": 5, "hidden_dim": 16}
    actor = SquashedGaussianActor(FEATURES, ACTIONS, **shape)
    return RADSACLoss(actor, TwinCritic(FEATURES, ACTIONS, **shape), **options)


CASES = [
    LossCase(
        name="ProtoLoss",
        make=proto,
        batch=image_batch,
        routing={
            "loss_comp": {"encoder_params", "projector_params", "predictor_params", "prototypes_params"},
            "loss_intr": {"prototypes_params"},
        },
        keys={"observation": "pixels", "next_observation": ("next", "pixels")},
        keys_hold_under_next=False,
        targets=("encoder", "projector"),
        masked=("pixels", ("next", "pixels")),
        per_row=("loss_comp",),
        rows_are_coupled=True,
    ),
    LossCase(
        name="ATCLoss",
        make=atc,
        batch=image_batch,
        routing={"loss_contrast": {"encoder_params", "projector_params", "anchor_head_params"}},
        keys={"observation": "pixels", "next_observation": ("next", "pixels")},
        keys_hold_under_next=False,
        targets=("encoder", "projector"),
        masked=("pixels",),  # positives of masked rows stay as negatives
        per_row=("loss_contrast",),
    ),
    LossCase(
        name="SimCLRLoss",
        make=simclr,
        batch=view_batch,
        routing={"loss_contrast": {"encoder_params", "projector_params"}},
        keys={"observation": "pixels", "observation_view": "pixels_view"},
        keys_hold_under_next=False,
        targets=(),
        masked=("pixels", "pixels_view"),
        per_row=("loss_contrast",),
        rows_are_coupled=True,
    ),
    LossCase(
        name="BeCLLoss",
        make=becl,
        batch=skill_batch,
        routing={"loss_contrast": {"encoder_params", "projector_params"}},
        keys={"next_observation": ("next", "pixels"), "skill": "skill"},
        keys_hold_under_next=False,
        targets=(),
        masked=(("next", "pixels"), "skill"),
        per_row=("loss_contrast",),
        rows_are_coupled=True,
    ),
    LossCase(
        name="RADSACLoss",
        make=rad_sac,
        batch=transition_batch,
        routing={
            "loss_qvalue": {"qvalue_network_params"},
            "loss_actor": {"actor_network_params"},
            "loss_alpha": {"log_alpha"},
        },
        keys={
            "observation": "features",
            "action": "action",
            "reward": "reward",
            "done": "done",
            "terminated": "terminated",
        },
        keys_hold_under_next=True,
        targets=("qvalue_network",),
        masked=("features", "action", ("next", "features"), ("next", "reward")),
        per_row=("loss_qvalue", "loss_actor", "loss_alpha"),
    ),
]


def run(loss: LossModule, td: TensorDictBase, seed: int = 7) -> TensorDictBase:
    torch.manual_seed(seed)
    return loss(td)


def as_images(rows: torch.Tensor) -> torch.Tensor:
    """Vectors ``[B, D]`` as images of one pixel, which :func:`passing_through` hands on as they are."""
    return rows.reshape(*rows.shape, 1, 1)


def passing_through(dim: int = 2) -> tuple[torch.nn.Module, torch.nn.Module]:
    """An encoder and a projector, in double precision, whose latents are their images' values."""
    conv = torch.nn.Conv2d(dim, dim, 1, bias=False)
    linear = torch.nn.Linear(dim, dim, bias=False)
    with torch.no_grad():
        conv.weight.copy_(as_images(torch.eye(dim)))
        linear.weight.copy_(torch.eye(dim))
    return torch.nn.Sequential(conv, torch.nn.Flatten()).double(), linear.double()


def keep_targets(case: LossCase, loss: LossModule) -> Callable[[], None]:
    """Move the targets by 0.05; a loss without targets has nothing to move."""
    return SoftUpdate(loss, tau=0.05).step if case.targets else lambda: None


def total(out: TensorDictBase) -> torch.Tensor:
    return sum(value.sum() for key, value in out.items() if key.startswith("loss_"))


def leaves(td: TensorDictBase) -> dict:
    return dict(td.items(include_nested=True, leaves_only=True))


def assert_same(actual: TensorDictBase, expected: TensorDict) -> None:
    assert set(actual.keys()) == set(expected.keys())
    for key, value in expected.items():
        torch.testing.assert_close(actual[key], value, msg=lambda text, key=key: f"{key}: {text}")
