"""What losses share: networks that stay tied to their parameters, and the keys and latents of pre-training losses."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from crptpro.values import as_float


class NetworkLoss(LossModule):
    """A loss whose networks hold its own parameters, also in a copy, and are re-initialised together with its targets.

    A subclass converts its networks with ``convert_to_functional`` and lists their names in ``network_names``, and what
    ``forward`` returns in ``default_out_keys``.
    """

    network_names: ClassVar[tuple[str, ...]] = ()
    default_out_keys: ClassVar[tuple[str, ...]] = ()

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.out_keys = list(self.default_out_keys)
        self._set_in_keys()

    @torch.no_grad()
    def reset_parameters_recursive(self) -> None:
        """Re-initialise every network, in the order of ``network_names``, and copy the new parameters into the targets.

        TorchRL's version re-draws the targets independently and cannot reach plain modules.
        """
        for name in self.network_names:
            network, params = getattr(self, name), getattr(self, f"{name}_params")
            with params.to_module(network, preserve_module_state=False):
                _reset(network)
            if (target := self._modules.get(f"target_{name}_params")) is not None:
                target.data.update_(params.data)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore from a pickle or a deep copy, tying the networks to the copied parameters again."""
        super().__setstate__(state)
        self._erase_cache()  # of detached views of the original's parameters
        for name in self.network_names:
            getattr(self, f"{name}_params").to_module(getattr(self, name), preserve_module_state=False)

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        super()._forward_value_estimator_keys(**kwargs)
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        """All accepted keys, in the order of their definition."""
        self._in_keys = [getattr(self.tensor_keys, field.name) for field in fields(self.tensor_keys)]


class PretrainingLoss(NetworkLoss):
    """A self-supervised loss on pairs of consecutive observations.

    A subclass writes ``forward``. Targets, where it has any, follow by ``SoftUpdate``.
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

    encoder: nn.Module
    encoder_params: Any
    target_encoder_params: Any
    projector: nn.Module
    projector_params: Any
    target_projector_params: Any

    method_name: str | None = None
    """Registered method that built this loss, if it was built by name."""

    @property
    def views(self) -> dict[NestedKey, NestedKey]:
        """Entries of ``in_keys`` that are a second view of another one: ``{"pixels_view": "pixels"}``.

        No dataset holds them: who trains the loss makes them by augmenting the named entry once more, independently.
        """
        return {}

    def _register_coefficients(self, **values: float | None) -> None:
        # float64 scalars do not promote float32 tensors, and 0.1 stays 0.1.
        for name, value in values.items():
            number = None if value is None else as_float(value, name)
            self.register_coeff_buffer(name, number, dtype=torch.float64)

    def _apply_network(self, name: str, inputs: Tensor, *, target: bool = False) -> Tensor:
        network = getattr(self, name)
        params = getattr(self, f"target_{name}_params" if target else f"{name}_params")
        with params.to_module(network, preserve_module_state=False):
            return network(inputs)

    def _latents(self, pixels: Tensor) -> Tensor:
        return self._apply_network("projector", self._apply_network("encoder", pixels))

    @torch.no_grad()
    def _target_latents(self, pixels: Tensor) -> Tensor:
        features = self._apply_network("encoder", pixels, target=True)
        return self._apply_network("projector", features, target=True)

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
