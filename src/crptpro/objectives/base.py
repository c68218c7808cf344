"""Base classes of the losses: copies and re-initialisation of networks, keys and latents of pre-training losses."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from typing import Any, Self

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from crptpro.values import as_float, read_entry


class NetworkLoss(LossModule):
    """A loss whose networks hold its parameters, also after a copy or a move; re-initialising updates the targets.

    They are therefore called directly; only a target's parameters have to be swapped into a network, for a block. A
    subclass converts its networks and lists the outputs of ``forward``.
    """

    default_out_keys: tuple[str, ...] = ()

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.out_keys = list(self.default_out_keys)
        self._set_in_keys()

    def _convert(self, targets: Sequence[str] = (), **networks: nn.Module) -> None:
        with warnings.catch_warnings():
            # TorchRL expects class annotations, but these attributes are created and read by name only.
            warnings.filterwarnings("ignore", "The name .* wasn't part of the annotations")
            for name, network in networks.items():
                self.convert_to_functional(network, name, create_target_params=name in targets)

    @property
    def network_names(self) -> list[str]:
        """The networks in the order of their conversion."""
        names = [name for name, _ in self.named_children() if name.endswith("_params")]
        return [name.removesuffix("_params") for name in names if not name.startswith("target_")]

    @torch.no_grad()
    def reset_parameters_recursive(self) -> None:
        """Re-initialise all networks and copy them into their targets; TorchRL's version skips plain modules."""
        for name in self.network_names:
            _reset(getattr(self, name))
            if (target := self._modules.get(f"target_{name}_params")) is not None:
                target.data.update_(getattr(self, f"{name}_params").data)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore from a pickle or a deep copy; the networks hold the copied parameters."""
        super().__setstate__(state)
        self._erase_cache()  # detached views of the original's parameters
        self._tie_networks()

    def _apply(self, *args: Any, **kwargs: Any) -> Self:
        """Move or cast the loss; the networks hold the buffers that were moved."""
        super()._apply(*args, **kwargs)
        self._tie_networks()
        return self

    def _tie_networks(self) -> None:
        for name in self.network_names:
            getattr(self, f"{name}_params").to_module(getattr(self, name), preserve_module_state=False)

    def _as_target(self, name: str) -> AbstractContextManager[Any]:
        """Let a network hold its target's parameters in a block."""
        target = getattr(self, f"target_{name}_params")
        return target.to_module(getattr(self, name), preserve_module_state=False)

    def _set_in_keys(self) -> None:
        self._in_keys = [getattr(self.tensor_keys, field.name) for field in fields(self.tensor_keys)]


class PretrainingLoss(NetworkLoss):
    """A self-supervised loss on pairs of consecutive observations; its targets are updated by ``SoftUpdate``."""

    @dataclass
    class _AcceptedKeys:
        observation: NestedKey = "pixels"  # images at time t
        next_observation: NestedKey = ("next", "pixels")  # images at time t + 1

    default_keys: Any = _AcceptedKeys
    tensor_keys: Any

    encoder: nn.Module
    projector: nn.Module

    method_name: str | None = None  #: method of the table that built this loss, if any

    @property
    def views(self) -> dict[NestedKey, NestedKey]:
        """Entries that training loops create by a second augmentation of another: ``{"pixels_view": "pixels"}``."""
        return {}

    def _register_coefficients(self, **values: float | None) -> None:
        # float64 scalars do not promote float32 tensors.
        for name, value in values.items():
            number = None if value is None else as_float(value, name)
            self.register_coeff_buffer(name, number, dtype=torch.float64)

    def _latents(self, pixels: Tensor) -> Tensor:
        return self.projector(self.encoder(pixels))

    @torch.no_grad()
    def _target_latents(self, pixels: Tensor) -> Tensor:
        with self._as_target("encoder"), self._as_target("projector"):
            return self._latents(pixels)

    def _read(self, tensordict: TensorDictBase, key: NestedKey, *, event_dims: int = 3) -> Tensor:
        """Return an entry with one batch dimension before its last ``event_dims``."""
        value = read_entry(self, tensordict, key)
        return value.reshape(-1, *value.shape[value.ndim - event_dims :])


def require_positive(**values: float | None) -> None:
    """Require positive numbers, or None; otherwise a ``ValueError`` names the first."""
    for name, value in values.items():
        if value is not None and not as_float(value, name) > 0:
            raise ValueError(f"`{name}` must be positive, got {value}.")


def skills_of(one_hot: Tensor, rows: int) -> Tensor:
    """Return the index of each one-hot skill ``[B, K]``; other skills, such as integers, raise a ``ValueError``."""
    if one_hot.ndim != 2 or len(one_hot) != rows or one_hot.shape[-1] < 2:
        raise ValueError(
            f"Skills must be one-hot, [{rows}, K] with K of at least 2, got {list(one_hot.shape)}; "
            "torch.nn.functional.one_hot makes them from integers."
        )
    return one_hot.argmax(dim=-1)


def _reset(network: nn.Module) -> None:
    """Call the outermost ``reset_parameters`` of each branch."""
    reset = getattr(network, "reset_parameters", None)
    if callable(reset):
        reset()
        return
    for child in network.children():
        _reset(child)
