"""What every pre-training loss shares: keys, target networks, re-initialisation, copies."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from crptpro.values import as_float


class OutKeys:
    """Entries that ``forward`` returns, or those that a caller names; a base before ``LossModule``."""

    default_out_keys: ClassVar[tuple[str, ...]] = ()
    """Entries that ``forward`` returns."""

    _out_keys: list[NestedKey] | None = None

    @property
    def out_keys(self) -> list[NestedKey]:
        """Entries that ``forward`` returns."""
        if self._out_keys is None:
            self._out_keys = list(self.default_out_keys)
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values


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
    """Registered method that built this loss, if it was built by name."""

    def __init__(self) -> None:
        self._in_keys: list[NestedKey] | None = None
        super().__init__()

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

    def _register_coefficient(self, name: str, value: float | None) -> None:
        """Keep a coefficient as a float64 scalar: it does not promote float32 tensors, and 0.1 stays 0.1."""
        number = None if value is None else as_float(value, name)
        self.register_coeff_buffer(name, number, dtype=torch.float64)

    def _apply_network(self, name: str, inputs: Tensor, *, target: bool = False) -> Tensor:
        """Output of one of ``network_names``, with its own or with its target parameters."""
        network = getattr(self, name)
        params = getattr(self, f"target_{name}_params" if target else f"{name}_params")
        with params.to_module(network, preserve_module_state=False):
            return network(inputs)

    def _latents(self, pixels: Tensor) -> Tensor:
        """Latents of the online encoder and projector."""
        return self._apply_network("projector", self._apply_network("encoder", pixels))

    @torch.no_grad()
    def _target_latents(self, pixels: Tensor) -> Tensor:
        """Latents of the target encoder and projector."""
        return self._apply_network(
            "projector", self._apply_network("encoder", pixels, target=True), target=True
        )

    def _read(self, tensordict: TensorDictBase, key: NestedKey, *, event_dims: int = 3) -> Tensor:
        """One entry with one batch dimension, its last ``event_dims`` as they are."""
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(f"{type(self).__name__} needs the entry {key!r}; set_keys() names another one.")
        return value.reshape(-1, *value.shape[value.ndim - event_dims :])


def require_positive(**values: float) -> None:
    """Refuse coefficients that would only show as NaN thousands of updates later.

    Raises:
        ValueError: naming the first that is not a positive number.
    """
    for name, value in values.items():
        if not as_float(value, name) > 0:
            raise ValueError(f"`{name}` must be positive, got {value}.")


def _reset(network: nn.Module) -> None:
    """Call the outermost ``reset_parameters`` of each branch."""
    reset = getattr(network, "reset_parameters", None)
    if callable(reset):
        reset()
        return
    for child in network.children():
        _reset(child)
