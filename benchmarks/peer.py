"""A released agent that the user has checked out, timed beside ours: liuxin0824/CRPTpro or denisyarats/proto.

Both keep ``proto.py``, ``utils.py`` and ``replay_buffer.py`` in their root and read packages of 2020. Where one of
those cannot be imported, the few names that the three files use are stood in for while they are being imported: an
import that succeeds and nothing more, except that ``kornia.augmentation.RandomCrop`` crops (integer offsets, one per
sample, as the pinned kornia does) and ``hydra.utils.instantiate`` builds. The latter always does so here, because the
released configuration files speak to hydra 0.11. Nothing of the agents' own arithmetic is touched.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.plain_pretrain import StackedStore
from crptpro.errors import CRPTproError

FILES = ("proto.py", "utils.py", "replay_buffer.py")
IMAGE_SIZE = 84
"""The released encoder's features are written into its code: 32 x 35 x 35, of 84 x 84 images."""
_MODULES = tuple(Path(file).stem for file in FILES)


class RandomCrop(nn.Module):
    """Stand-in for ``kornia.augmentation.RandomCrop`` without padding: an integer crop per sample."""

    def __init__(self, size: Sequence[int]) -> None:
        super().__init__()
        self.size = tuple(size)

    def forward(self, images: Tensor) -> Tensor:
        """Crop ``[B, C, H, W]``."""
        height, width = self.size
        windows = images.unfold(2, height, 1).unfold(3, width, 1)
        row = torch.randint(windows.shape[2], (len(images),))
        column = torch.randint(windows.shape[3], (len(images),))
        return windows[torch.arange(len(images)), :, row, column]


class Peer:
    """The agent of a checkout with the numbers of its own configuration file, batch and prototypes excepted.

    Args:
        directory: the checkout.
        batch_size: transitions per update.
        prototypes: M.

    Raises:
        CRPTproError: ``directory`` is no such checkout, or does not import.
    """

    def __init__(self, directory: Path, *, batch_size: int, prototypes: int = 512) -> None:
        self.modules = load(directory)
        self.batch_size, self.prototypes = batch_size, prototypes

    def pretrain_update(self, store: StackedStore) -> Callable[[], None]:
        """Return a call that does one whole update of the task-agnostic stage.

        That of denisyarats/proto includes the SAC update of its exploring policy, that of liuxin0824/CRPTpro a
        forward pass for an unused reward: it is what their users wait for.
        """
        agent, buffer = self._agent(store, task_agnostic=True), self._buffer(store)
        return lambda: agent.update(buffer, 2)  # an even number: every gate of the schedules is open

    def downstream_update(self, store: StackedStore) -> Callable[[], None]:
        """Return a call that does one update of the downstream stage; every second includes the actor."""
        agent, buffer = self._agent(store, task_agnostic=False), self._buffer(store)
        steps = iter(range(sys.maxsize))
        return lambda: agent.update(buffer, next(steps))

    def _agent(self, store: StackedStore, *, task_agnostic: bool) -> Any:
        obs_shape, action_shape = store.content.obs.shape[1:], tuple(store.content.action.shape[1:])
        if tuple(obs_shape[1:]) != (IMAGE_SIZE, IMAGE_SIZE):
            raise CRPTproError(f"The peer's encoder takes images of {IMAGE_SIZE} px, not {obs_shape[-1]}.")
        proto = self.modules["proto"]
        wide = {"feature_dim": 50, "action_shape": action_shape, "hidden_dim": 1024, "hidden_depth": 2}
        try:
            return proto.ProtoAgent(
                obs_shape=tuple(obs_shape), action_shape=action_shape, action_range=[-1.0, 1.0],
                device=torch.device("cpu"),
                encoder_cfg=_Config(proto.Encoder, obs_shape=tuple(obs_shape), proj_dim=128),
                critic_cfg=_Config(proto.Critic, repr_dim=0, **wide),
                actor_cfg=_Config(proto.Actor, repr_dim=0, log_std_bounds=[-10, 2], **wide),
                proto_cfg=_Config(
                    proto.Proto, proj_dim=128, pred_dim=512, T=0.1, num_protos=self.prototypes, num_iters=3, topk=3,
                    queue_size=2_048,
                ),
                discount=0.99, init_temperature=0.1, lr=1e-4, actor_update_frequency=2, critic_target_tau=0.01,
                critic_target_update_frequency=2, encoder_target_tau=0.05, encoder_update_frequency=2,
                batch_size=self.batch_size, task_agnostic=task_agnostic, intr_coef=0.2, num_seed_steps=0,
            )  # fmt: skip
        except (AttributeError, TypeError) as reason:
            raise CRPTproError(f"The peer's ProtoAgent cannot be built: {reason}.") from reason

    def _buffer(self, store: StackedStore) -> Any:
        """Their buffer over the very arrays of ours: no second copy in memory."""
        obs, action, reward, next_obs, not_terminated = store.content
        buffer = self.modules["replay_buffer"].ReplayBuffer(
            tuple(obs.shape[1:]), tuple(action.shape[1:]), 1, torch.device("cpu")
        )
        buffer.obses, buffer.next_obses = obs.numpy(), next_obs.numpy()
        buffer.actions, buffer.rewards = action.numpy(), reward.numpy()
        buffer.not_dones, buffer.capacity, buffer.full = not_terminated.numpy(), len(store), True
        return buffer


def load(directory: Path) -> dict[str, ModuleType]:
    """Import the three files of a checkout, leaving ``sys.path`` and ``sys.modules`` as they were.

    Raises:
        CRPTproError: ``directory`` is no such checkout, or does not import.
    """
    missing = [file for file in FILES if not (directory / file).is_file()]
    if missing:
        raise CRPTproError(
            f"{directory} has no {', '.join(missing)}: --peer wants a checkout of liuxin0824/CRPTpro or "
            "denisyarats/proto."
        )
    with _importable(directory.resolve()):
        try:
            modules = {name: importlib.import_module(name) for name in _MODULES}
        except Exception as reason:
            raise CRPTproError(
                f"{directory} cannot be imported: {type(reason).__name__}: {reason}."
            ) from reason
    if not hasattr(modules["proto"], "ProtoAgent"):
        raise CRPTproError(f"{directory / 'proto.py'} defines no ProtoAgent: this is another repository.")
    modules["proto"].hydra = _hydra()  # type: ignore[attr-defined]
    return modules


class _Config(SimpleNamespace):
    """A class and its arguments, in the shape that the agents read: ``cfg.params.repr_dim = ...``."""

    def __init__(self, cls: Callable[..., Any], **params: Any) -> None:
        super().__init__(cls=cls, params=SimpleNamespace(**params))


def _instantiate(cfg: _Config) -> Any:
    return cfg.cls(**vars(cfg.params))


def _hydra() -> ModuleType:
    return _module("hydra", utils=_module("hydra.utils", instantiate=_instantiate))


def _stand_ins() -> dict[str, ModuleType]:
    augmentation = _module("kornia.augmentation", RandomCrop=RandomCrop)
    hydra = _hydra()
    return {
        "gym": _module("gym"),
        "hydra": hydra,
        "hydra.utils": hydra.utils,
        "kornia": _module("kornia", augmentation=augmentation),
        "kornia.augmentation": augmentation,
        "omegaconf": _module("omegaconf", OmegaConf=None),
    }


def _module(name: str, **content: Any) -> ModuleType:
    module = ModuleType(name)
    vars(module).update(content)
    return module


@contextmanager
def _importable(directory: Path) -> Iterator[None]:
    """Put the checkout first on the path, and stand-ins where a package is missing; take everything back after."""
    missing = {
        name: module for name, module in _stand_ins().items()
        if importlib.util.find_spec(name.split(".")[0]) is None
    }  # fmt: skip
    hidden = {name: sys.modules.pop(name) for name in _MODULES if name in sys.modules}
    sys.path.insert(0, str(directory))
    sys.modules.update(missing)
    try:
        yield
    finally:
        sys.path.remove(str(directory))
        for name in (*_MODULES, *missing):
            sys.modules.pop(name, None)
        sys.modules.update(hidden)
