"""Small instances of every loss, and what the conformance tests need to know about each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import LossModule, SoftUpdate

from crptpro.modules import DeterministicActor, PixelEncoder, SquashedGaussianActor, TwinCritic
from crptpro.objectives import (
    ATCLoss,
    AveragedSACLoss,
    BeCLLoss,
    DrQLoss,
    ProtoLoss,
    RADSACLoss,
    SimCLRLoss,
    SkillDDPGLoss,
)

IMAGE = (3, 15, 15)
FEATURES, ACTIONS, SKILLS = 12, 2, 3
HEADS = {"bottleneck_dim": 5, "hidden_dim": 16}


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


def skill_image_batch(count: int = 6, seed: int = 0) -> TensorDict:
    skills = F.one_hot(torch.arange(count) % SKILLS, SKILLS).float()
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
    actor = SquashedGaussianActor(FEATURES, ACTIONS, **HEADS)
    return RADSACLoss(actor, TwinCritic(FEATURES, ACTIONS, **HEADS), **options)


def with_views(td: TensorDict, key: str, seed: int) -> TensorDict:
    """The batch with other values, of the same kind, as second views of a key."""
    other = transition_batch(len(td), seed) if key == "features" else image_batch(len(td), seed)
    td.set(f"{key}_view", other[key])
    td.set(("next", f"{key}_view"), other["next", key])
    return td


def two_view_batch(count: int = 6, seed: int = 0) -> TensorDict:
    return with_views(transition_batch(count, seed), "features", seed + 100)


def averaged_sac(seed: int = 0, **options) -> AveragedSACLoss:
    torch.manual_seed(seed)
    actor = SquashedGaussianActor(FEATURES, ACTIONS, **HEADS)
    return AveragedSACLoss(actor, TwinCritic(FEATURES, ACTIONS, **HEADS), **options)


def pixel_batch(count: int = 6, seed: int = 0) -> TensorDict:
    td, images = transition_batch(count, seed), image_batch(count, seed)
    del td["features"], td["next", "features"]
    td["pixels"], td["next", "pixels"] = images["pixels"], images["next", "pixels"]
    return with_views(td, "pixels", seed + 100)


def drq(seed: int = 0, **options) -> DrQLoss:
    torch.manual_seed(seed)
    encoder = small_encoder()
    sizes = (encoder.feature_dim, ACTIONS)
    actor = SquashedGaussianActor(*sizes, **HEADS, has_tanh=True)
    return DrQLoss(encoder, actor, TwinCritic(*sizes, **HEADS, has_tanh=True), **options)


def skill_batch(count: int = 6, seed: int = 0) -> TensorDict:
    td = transition_batch(count, seed)
    generator = torch.Generator().manual_seed(seed + 1)
    skills = torch.randint(SKILLS, (count,), generator=generator)
    td["skill"] = F.one_hot(skills, SKILLS).float()
    td["next", "discount"] = 0.9 * (~td["next", "terminated"]).float()
    return td


def skill_ddpg(seed: int = 0, **options) -> SkillDDPGLoss:
    torch.manual_seed(seed)
    actor = DeterministicActor(FEATURES, ACTIONS, skill_dim=SKILLS, **HEADS)
    critic = TwinCritic(FEATURES + SKILLS, ACTIONS, **HEADS, has_tanh=True)
    return SkillDDPGLoss(actor, critic, **options)


SAC_ROUTING = {
    "loss_qvalue": {"qvalue_network_params"},
    "loss_actor": {"actor_network_params"},
    "loss_alpha": {"log_alpha"},
}
SAC_KEYS = {"action": "action", "reward": "reward", "done": "done", "terminated": "terminated"}

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
    ),
    LossCase(
        name="ATCLoss",
        make=atc,
        batch=image_batch,
        routing={"loss_contrast": {"encoder_params", "projector_params", "anchor_head_params"}},
        keys={"observation": "pixels", "next_observation": ("next", "pixels")},
        keys_hold_under_next=False,
        targets=("encoder", "projector"),
    ),
    LossCase(
        name="SimCLRLoss",
        make=simclr,
        batch=view_batch,
        routing={"loss_contrast": {"encoder_params", "projector_params"}},
        keys={"observation": "pixels", "observation_view": "pixels_view"},
        keys_hold_under_next=False,
        targets=(),
    ),
    LossCase(
        name="BeCLLoss",
        make=becl,
        batch=skill_image_batch,
        routing={"loss_contrast": {"encoder_params", "projector_params"}},
        keys={"next_observation": ("next", "pixels"), "skill": "skill"},
        keys_hold_under_next=False,
        targets=(),
    ),
    LossCase(
        name="RADSACLoss",
        make=rad_sac,
        batch=transition_batch,
        routing=SAC_ROUTING,
        keys={"observation": "features", **SAC_KEYS},
        keys_hold_under_next=True,
        targets=("qvalue_network",),
    ),
    LossCase(
        name="AveragedSACLoss",
        make=averaged_sac,
        batch=two_view_batch,
        routing=SAC_ROUTING,
        keys={"observation": "features", "observation_view": "features_view", **SAC_KEYS},
        keys_hold_under_next=True,
        targets=("qvalue_network",),
    ),
    LossCase(
        name="DrQLoss",
        make=drq,
        batch=pixel_batch,
        routing=SAC_ROUTING,
        keys={"observation": "pixels", "observation_view": "pixels_view", **SAC_KEYS},
        keys_hold_under_next=True,
        targets=("qvalue_network",),
    ),
    LossCase(
        name="SkillDDPGLoss",
        make=skill_ddpg,
        batch=skill_batch,
        routing={"loss_qvalue": {"qvalue_network_params"}, "loss_actor": {"actor_network_params"}},
        keys={
            "observation": "features",
            "skill": "skill",
            "action": "action",
            "reward": "reward",
            "discount": "discount",
        },
        keys_hold_under_next=True,
        targets=("qvalue_network",),
    ),
]


def run(loss: LossModule, td: TensorDictBase, seed: int = 7) -> TensorDictBase:
    torch.manual_seed(seed)
    return loss(td)


def target_state(loss: LossModule, name: str) -> dict[str, torch.Tensor]:
    """The live tensors of a target network, by the names of its own state dictionary."""
    leaves = loss._modules[f"target_{name}_params"].items(True, True)
    named = {key if isinstance(key, str) else ".".join(key): value.data for key, value in leaves}
    return {key.removeprefix("module."): value for key, value in named.items()}


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


def double(rows: list) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def unit(*shape: int, seed: int = 0) -> torch.Tensor:
    values = torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return F.normalize(values, dim=-1)


def close(actual: torch.Tensor, expected: torch.Tensor, tolerance: float = 1e-6) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance)
