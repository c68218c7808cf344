"""A released agent that the user has checked out, timed beside ours: liuxin0824/CRPTpro or denisyarats/proto.

Both keep ``proto.py``, ``utils.py`` and ``replay_buffer.py`` in their root and read packages of 2020. Stand-ins replace
the few names that these use. Most only let an import succeed; kornia's ``RandomCrop`` crops at integer offsets, one per
sample, as the pinned kornia does, and hydra's ``instantiate`` builds. The agents' own arithmetic is untouched.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn

from benchmarks.plain import Batch, crop
from crptpro.errors import CRPTproError


class RandomCrop(nn.Module):
    """Stand-in for ``kornia.augmentation.RandomCrop`` without padding: an integer crop per sample."""

    def __init__(self, size: Sequence[int]) -> None:
        super().__init__()
        self.size = size

    def forward(self, images: Tensor) -> Tensor:
        return crop(images, self.size)


def load(directory: Path) -> dict[str, ModuleType]:
    """Import the three files of a checkout, leaving ``sys.path`` and ``sys.modules`` as they were.

    Raises:
        CRPTproError: ``directory`` is no such checkout, or does not import.
    """
    augmentation = SimpleNamespace(RandomCrop=RandomCrop)
    hydra = SimpleNamespace(utils=SimpleNamespace(instantiate=lambda cfg: cfg.cls(**vars(cfg.params))))
    stand_ins: dict[str, Any] = {
        "gym": SimpleNamespace(), "omegaconf": SimpleNamespace(OmegaConf=None), "hydra": hydra,
        "hydra.utils": hydra.utils, "kornia": SimpleNamespace(augmentation=augmentation),
        "kornia.augmentation": augmentation,
    }  # fmt: skip
    names = ("proto", "utils", "replay_buffer")
    path = [str(directory.resolve()), *sys.path]
    with mock.patch.dict(sys.modules, stand_ins), mock.patch.object(sys, "path", path):
        for name in names:
            sys.modules.pop(name, None)
        try:
            modules = {name: importlib.import_module(name) for name in names}
            if not hasattr(modules["proto"], "ProtoAgent"):
                raise ImportError("its proto.py defines no ProtoAgent")
        except Exception as reason:
            raise CRPTproError(
                f"{directory} cannot be used ({type(reason).__name__}: {reason}): --peer wants a checkout of "
                "liuxin0824/CRPTpro or denisyarats/proto."
            ) from reason
    return modules


def peer_update(
    directory: Path, store: Batch, *, batch_size: int, prototypes: int, task_agnostic: bool
) -> Callable[[int], Any]:
    """Return a call that does one whole update of the released agent, given its step.

    The numbers are those of its own configuration file, batch and prototypes excepted. The task-agnostic update of
    denisyarats/proto includes the SAC update of its exploring policy, that of liuxin0824/CRPTpro a forward pass for an
    unused reward: it is what their users wait for.

    Raises:
        CRPTproError: ``directory`` is no such checkout, or the images do not fit its encoder.
    """
    obs_shape, action_shape = tuple(store.obs.shape[1:]), tuple(store.action.shape[1:])
    if obs_shape[1:] != (84, 84):
        raise CRPTproError(f"The peer's encoder takes images of 84 px, not {obs_shape[-1]}.")
    modules = load(directory)
    proto = modules["proto"]

    def config(cls: Callable[..., Any], **params: Any) -> SimpleNamespace:
        return SimpleNamespace(cls=cls, params=SimpleNamespace(**params))

    wide: dict[str, Any] = {"repr_dim": 0, "feature_dim": 50, "action_shape": action_shape}
    wide |= {"hidden_dim": 1024, "hidden_depth": 2}
    agent = proto.ProtoAgent(
        obs_shape=obs_shape, action_shape=action_shape, action_range=[-1.0, 1.0], device=torch.device("cpu"),
        encoder_cfg=config(proto.Encoder, obs_shape=obs_shape, proj_dim=128),
        critic_cfg=config(proto.Critic, **wide), actor_cfg=config(proto.Actor, log_std_bounds=[-10, 2], **wide),
        proto_cfg=config(
            proto.Proto, proj_dim=128, pred_dim=512, T=0.1, num_protos=prototypes, num_iters=3, topk=3, queue_size=2_048
        ),
        discount=0.99, init_temperature=0.1, lr=1e-4, actor_update_frequency=2, critic_target_tau=0.01,
        critic_target_update_frequency=2, encoder_target_tau=0.05, encoder_update_frequency=2, batch_size=batch_size,
        task_agnostic=task_agnostic, intr_coef=0.2, num_seed_steps=0,
    )  # fmt: skip
    buffer = modules["replay_buffer"].ReplayBuffer(obs_shape, action_shape, 1, torch.device("cpu"))
    arrays = [column.numpy() for column in store]
    buffer.obses, buffer.actions, buffer.rewards, buffer.next_obses, buffer.not_dones = arrays
    buffer.capacity, buffer.full = len(store.obs), True
    return lambda step: agent.update(buffer, step)
