"""Small instances of every loss, and what the conformance tests need to know about each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule, SoftUpdate

from crptpro.modules import DeterministicActor, PixelEncoder, SquashedGaussianActor, TwinCritic
from crptpro.objectives import (
    ATCLoss,
    AveragedSACLoss,
    BeCLLoss,
    DrQLoss,
    PretrainingLoss,
    ProtoLoss,
    RADSACLoss,
    SimCLRLoss,
    SkillDDPGLoss,
)

IMAGE = (3, 15, 15)
FEATURES, ACTIONS, SKILLS = 12, 2, 3
HEADS: dict[str, Any] = {"bottleneck_dim": 5, "hidden_dim": 16}


def small_encoder() -> PixelEncoder:
    return PixelEncoder(IMAGE[0], channels=(4, 4), strides=(2, 1), image_size=IMAGE[1])


def maker(loss_class: type[PretrainingLoss], **small: Any) -> Callable[..., Any]:
    def make(seed: int = 0, **options: Any) -> PretrainingLoss:
        torch.manual_seed(seed)
        return loss_class(small_encoder(), **{**small, **options})

    return make


proto = maker(ProtoLoss, num_prototypes=10, latent_dim=6, hidden_dim=16)
atc = maker(ATCLoss, latent_dim=6, hidden_dim=16)
simclr = maker(SimCLRLoss, latent_dim=6)
becl = maker(BeCLLoss, skill_dim=SKILLS, hidden_dim=16)


def rad_sac(seed: int = 0, loss_class: type[RADSACLoss] = RADSACLoss, **options) -> RADSACLoss:
    torch.manual_seed(seed)
    actor = SquashedGaussianActor(FEATURES, ACTIONS, **HEADS)
    return loss_class(actor, TwinCritic(FEATURES, ACTIONS, **HEADS), **options)


def averaged_sac(seed: int = 0, **options) -> RADSACLoss:
    return rad_sac(seed, AveragedSACLoss, **options)


def drq(seed: int = 0, **options) -> DrQLoss:
    torch.manual_seed(seed)
    encoder = small_encoder()
    sizes = (encoder.feature_dim, ACTIONS)
    actor = SquashedGaussianActor(*sizes, **HEADS, has_tanh=True)
    return DrQLoss(encoder, actor, TwinCritic(*sizes, **HEADS, has_tanh=True), **options)


def skill_ddpg(seed: int = 0, **options) -> SkillDDPGLoss:
    torch.manual_seed(seed)
    actor = DeterministicActor(FEATURES, ACTIONS, skill_dim=SKILLS, **HEADS)
    critic = TwinCritic(FEATURES + SKILLS, ACTIONS, **HEADS, has_tanh=True)
    return SkillDDPGLoss(actor, critic, **options)


def image_batch(count: int = 6, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    pixels, following = torch.randint(0, 256, (2, count, *IMAGE), dtype=torch.uint8, generator=generator)
    return TensorDict({"pixels": pixels, "next": {"pixels": following}}, [count])


def view_batch(count: int = 6, seed: int = 0) -> TensorDict:
    pair = image_batch(count, seed)
    return TensorDict({"pixels": pair["pixels"], "pixels_view": pair["next", "pixels"]}, [count])


def skill_image_batch(count: int = 6, seed: int = 0) -> TensorDict:
    """With five rows, the first alone has its skill."""
    skills = F.one_hot((torch.arange(count) % SKILLS).roll(3), SKILLS).float()
    return image_batch(count, seed).set("skill", skills)


def transition_batch(count: int = 6, seed: int = 0) -> TensorDict:
    """Row 1 terminates, row 2 is truncated."""
    generator = torch.Generator().manual_seed(seed)
    features, following = torch.randn(2, count, FEATURES, generator=generator)
    terminated, done = (torch.zeros(count, 1, dtype=torch.bool) for _ in range(2))
    terminated[1:2] = done[1:3] = True
    after = {"features": following, "reward": torch.randn(count, 1, generator=generator)}
    action = torch.randn(count, ACTIONS, generator=generator).tanh()
    after |= {"done": done, "terminated": terminated}
    return TensorDict({"features": features, "action": action, "next": after}, [count])


def two_view_batch(count: int = 6, seed: int = 0) -> TensorDict:
    td, other = transition_batch(count, seed), transition_batch(count, seed + 100)
    td["features_view"], td["next", "features_view"] = other["features"], other["next", "features"]
    return td


def pixel_batch(count: int = 6, seed: int = 0) -> TensorDict:
    td = transition_batch(count, seed).exclude("features", ("next", "features"))
    for key, images in (("pixels", image_batch(count, seed)), ("pixels_view", image_batch(count, seed + 100))):
        td[key], td["next", key] = images["pixels"], images["next", "pixels"]
    return td


def skill_batch(count: int = 6, seed: int = 0) -> TensorDict:
    td, generator = transition_batch(count, seed), torch.Generator().manual_seed(seed + 1)
    td["skill"] = F.one_hot(torch.randint(SKILLS, (count,), generator=generator), SKILLS).float()
    return td


@dataclass(frozen=True)
class LossCase:
    """A loss under test."""

    name: str
    make: Callable[..., LossModule]
    batch: Callable[..., TensorDict]
    routing: dict[str, set[str]]  # ``loss_*`` key -> the parameter groups that receive its gradient
    keys: dict[str, object]  # configurable key -> its default
    targets: tuple[str, ...] = ()  # networks that have target parameters
    keys_hold_under_next: bool = False  # whether a key also names the entry under "next"

    def __str__(self) -> str:
        return self.name


PAIR = {"observation": "pixels", "next_observation": ("next", "pixels")}
CONTRAST = {"loss_contrast": {"encoder_params", "projector_params"}}
DDPG = {"loss_qvalue": {"qvalue_network_params"}, "loss_actor": {"actor_network_params"}}
SAC = {**DDPG, "loss_alpha": {"log_alpha"}}
SAC_KEYS = {name: name for name in ("action", "reward", "done", "terminated")}
SKILL_KEYS = {name: name for name in ("skill", "action", "reward", "terminated", "steps_to_next_obs")}
ON_FEATURES = {"observation": "features"}

CASES = [
    LossCase(
        "ProtoLoss", proto, image_batch,
        {"loss_comp": {"encoder_params", "projector_params", "predictor_params", "prototypes_params"},
         "loss_intr": {"prototypes_params"}},
        PAIR, ("encoder", "projector"),
    ),
    LossCase(
        "ATCLoss", atc, image_batch,
        {"loss_contrast": {"encoder_params", "projector_params", "anchor_head_params"}},
        PAIR, ("encoder", "projector"),
    ),
    LossCase("SimCLRLoss", simclr, view_batch, CONTRAST,
             {"observation": "pixels", "observation_view": "pixels_view"}),
    LossCase("BeCLLoss", becl, skill_image_batch, CONTRAST,
             {"next_observation": ("next", "pixels"), "skill": "skill"}),
    LossCase("RADSACLoss", rad_sac, transition_batch, SAC, ON_FEATURES | SAC_KEYS, ("qvalue_network",), True),
    LossCase("AveragedSACLoss", averaged_sac, two_view_batch, SAC,
             {**ON_FEATURES, "observation_view": "features_view", **SAC_KEYS}, ("qvalue_network",), True),
    LossCase("DrQLoss", drq, pixel_batch, SAC,
             {"observation": "pixels", "observation_view": "pixels_view", **SAC_KEYS}, ("qvalue_network",), True),
    LossCase("SkillDDPGLoss", skill_ddpg, skill_batch, DDPG, ON_FEATURES | SKILL_KEYS, ("qvalue_network",), True),
]  # fmt: skip


def run(loss: LossModule, td: TensorDictBase, seed: int = 7) -> TensorDictBase:
    torch.manual_seed(seed)
    return loss(td)


def disturb(module: nn.Module) -> None:
    """Targets differ from their sources afterwards, and prototypes are not unit."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))


def target_state(loss: LossModule, name: str) -> dict[str, Tensor]:
    """The live tensors of a target network, by the names of its own state dictionary."""
    leaves = loss._modules[f"target_{name}_params"].items(True, True)
    named = {key if isinstance(key, str) else ".".join(key): value.data for key, value in leaves}
    return {key.removeprefix("module."): value for key, value in named.items()}


def keep_targets(case: LossCase, loss: LossModule) -> Callable[[], None]:
    """Move the targets by 0.05; a loss without targets has nothing to move."""
    return SoftUpdate(loss, tau=0.05).step if case.targets else lambda: None


def total(out: TensorDictBase) -> Tensor:
    return sum(value.sum() for key, value in out.items() if key.startswith("loss_"))


def leaves(td: TensorDictBase) -> dict:
    return dict(td.items(include_nested=True, leaves_only=True))


def assert_same(actual: TensorDictBase, expected: TensorDict) -> None:
    assert set(actual.keys()) == set(expected.keys())
    for key, value in expected.items():
        torch.testing.assert_close(actual[key], value, msg=lambda text, key=key: f"{key}: {text}")


def released_sinkhorn(scores: Tensor, temperature: float, iterations: int = 3) -> Tensor:
    """The released code's arithmetic (denisyarats/proto, proto.py): exponentiated, on the transpose."""
    scaled = scores / temperature
    q = torch.exp(scaled - scaled.max()).T
    q = q / q.sum()
    for _ in range(iterations):
        q = q * (1 / q.shape[0] / q.sum(dim=1)).unsqueeze(1)
        q = q * (1 / q.shape[1] / q.sum(dim=0)).unsqueeze(0)
    return (q / q.sum(dim=0, keepdim=True)).T


def double(rows: list) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def unit(*shape: int, seed: int = 0) -> Tensor:
    values = torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return F.normalize(values, dim=-1)


def close(actual: Tensor, expected: Tensor, tolerance: float = 1e-6) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance)
