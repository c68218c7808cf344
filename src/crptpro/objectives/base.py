"""The wiring that every pre-training loss shares: keys, masks, target networks, re-initialisation."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS

from crptpro.objectives.out_keys import OutKeys


class PretrainingLoss(OutKeys, LossModule):
    """A self-supervised loss on pairs of consecutive observations.

    A subclass converts its networks with ``convert_to_functional``, lists their names in ``network_names``,
    its outputs in ``default_out_keys``, and writes ``forward``. Targets, where it has any, follow by
    ``SoftUpdate``.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            observation: images at time t.
            next_observation: images at time t + 1.
        """

        observation: NestedKey = "pixels"
        next_observation: NestedKey = ("next", "pixels")

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    network_names: ClassVar[tuple[str, ...]] = ()
    """Names given to ``convert_to_functional``, in the order of re-initialisation."""

    method_name: str | None = None
    """Registered method or preset that built this loss, if it was built by name."""

    def __init__(self, *, reduction: str | None = None) -> None:
        self._in_keys: list[NestedKey] | None = None
        super().__init__()
        reduction = "mean" if reduction is None else reduction
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}.")
        self.reduction = reduction

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that ``forward`` reads: all accepted keys, in the order of their definition."""
        if self._in_keys is None:
            self._in_keys = [getattr(self.tensor_keys, field.name) for field in fields(self.tensor_keys)]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def views(self) -> dict[NestedKey, NestedKey]:
        """Entries of ``in_keys`` that are a second view of another one: ``{"pixels_view": "pixels"}``.

        No dataset holds them: who trains the loss makes them by augmenting the named entry once more,
        independently. Empty for a loss that needs none.
        """
        return {}

    def target_state(self) -> dict[str, dict[str, Tensor]]:
        """State dictionary of every target network by its name: ``{"encoder": {"convs.0.weight": ...}}``.

        The tensors are the live ones, not copies. Empty for a loss without targets.
        """
        state = {}
        for name in self.network_names:
            target = self._modules.get(f"target_{name}_params")
            if target is not None:
                leaves = target.items(True, True)
                state[name] = {
                    ".".join(key) if isinstance(key, tuple) else key: value.data for key, value in leaves
                }
        return state

    @torch.no_grad()
    def reset_parameters_recursive(self) -> None:
        """Re-initialise every network, prototypes included, and copy the new parameters into the targets.

        TorchRL's version re-draws the targets independently and cannot reach plain modules; the method starts
        from targets that equal their sources.
        """
        for name in self.network_names:
            network, params = getattr(self, name), getattr(self, f"{name}_params")
            with params.to_module(network, preserve_module_state=False):
                _reset(network)
            target = self._modules.get(f"target_{name}_params")
            if target is not None:
                target.data.update_(params.data)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore from a pickle or a deep copy, tying the networks to the copied parameters again."""
        super().__setstate__(state)
        for name in self.network_names:
            getattr(self, f"{name}_params").to_module(getattr(self, name), preserve_module_state=False)

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        # No value estimator here; changed keys only have to show in in_keys.
        self._in_keys = None

    def _apply_network(self, name: str, inputs: Tensor, *, target: bool = False) -> Tensor:
        """Output of one of ``network_names``, with its own or with its target parameters."""
        network = getattr(self, name)
        params = getattr(self, f"target_{name}_params" if target else f"{name}_params")
        with params.to_module(network, preserve_module_state=False):
            return network(inputs)

    def _read(
        self, tensordict: TensorDictBase, key: NestedKey, *, event_dims: int
    ) -> tuple[Tensor, torch.Size]:
        """One entry with one batch dimension, its last ``event_dims`` as they are; the original batch shape."""
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(f"{type(self).__name__} needs the entry {key!r}; set_keys() names another one.")
        split = value.ndim - event_dims
        return value.reshape(-1, *value.shape[split:]), value.shape[:split]

    def _read_images(
        self, tensordict: TensorDictBase, first: NestedKey, second: NestedKey
    ) -> tuple[Tensor, Tensor, Tensor | None, torch.Size]:
        """Two entries of images without masked rows; the mask; the original batch shape."""
        one, lead = self._read(tensordict, first, event_dims=3)
        two, _ = self._read(tensordict, second, event_dims=3)
        valid = valid_rows(self, tensordict)
        if valid is not None:
            # Dropped, not multiplied by zero: batch-wise normalisations couple all rows.
            one, two = one[valid], two[valid]
        return one, two, valid, lead

    def _reduce_rows(self, rows: Tensor, valid: Tensor | None, lead: torch.Size) -> Tensor:
        """Reduce values of the rows that are left; ``"none"`` restores the batch shape, 0 where masked."""
        if self.reduction == "none":
            if valid is not None:
                rows = rows.new_zeros(valid.shape).masked_scatter(valid, rows)
            return rows.reshape(lead)
        return rows.sum() if self.reduction == "sum" else rows.sum() / max(rows.numel(), 1)


def mask_keys(loss: LossModule) -> tuple[NestedKey, ...]:
    """Entries that say which rows of a batch count, where it has them."""
    names = loss.loss_mask_key
    return AUTO_LOSS_MASK_KEYS if names == "auto" else () if names is None else (names,)


def valid_rows(loss: LossModule, tensordict: TensorDictBase) -> Tensor | None:
    """Which rows of a batch count, from the mask entries that ``loss.loss_mask_key`` names.

    Args:
        loss: any loss.
        tensordict: its input.

    Returns:
        Flat bool ``[B]`` over all batch dimensions, or None if the batch has no mask.
    """
    valid = None
    for key in mask_keys(loss):
        mask = tensordict.get(key, None)
        if mask is not None:
            valid = mask.reshape(-1) if valid is None else valid & mask.reshape(-1)
    return valid


def _reset(network: nn.Module) -> None:
    """Call the outermost ``reset_parameters`` of each branch."""
    reset = getattr(network, "reset_parameters", None)
    if callable(reset):
        reset()
        return
    for child in network.children():
        _reset(child)
