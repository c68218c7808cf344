"""Base of the transforms: keys of images in replay batches and on environments."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data.tensor_specs import Composite
from torchrl.envs.transforms import Transform

from crptpro.values import read_entry

#: One (nested) key, or a list of keys: as in TorchRL, a tuple is one key.
Keys = Any


def require_pairs(transform: Transform) -> None:
    """Require as many out keys as in keys."""
    read, written = transform.in_keys, transform.out_keys
    if len(read) != len(written):
        raise ValueError(f"in_keys {read} and out_keys {written} must pair up.")


class PixelTransform(Transform):
    """Computes one entry from each image entry, in replay batches (``forward``) and in environments.

    Environments ignore keys under ``"next"``. ``in_keys`` are required; by default they are ``"pixels"`` and, if
    present, ``("next", "pixels")``. Without ``out_keys`` the images are replaced. A subclass writes
    ``_apply_transform`` and, if it is not that of the image, :meth:`written_spec`.
    """

    def __init__(self, in_keys: Keys | None = None, out_keys: Keys | None = None) -> None:
        next_pixels = ("next", "pixels")
        super().__init__(in_keys=["pixels", next_pixels] if in_keys is None else in_keys)
        self.out_keys = list(self.in_keys) if out_keys is None else out_keys
        require_pairs(self)
        self._optional = next_pixels if in_keys is None else None

    def written_spec(self, read: Any) -> Any:
        """Return the spec of the output for an image of spec ``read``."""
        return read.clone()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._apply_to(tensordict, zip(self.in_keys, self.out_keys))

    def _apply_to(self, tensordict: TensorDictBase, pairs: Any) -> TensorDictBase:
        for in_key, out_key in pairs:
            if in_key != self._optional or in_key in tensordict.keys(True):
                tensordict.set(out_key, self._apply_transform(read_entry(self, tensordict, in_key)))
        return tensordict

    def _root_pairs(self) -> list[tuple[Any, Any]]:
        pairs = zip(self.in_keys, self.out_keys)
        return [pair for pair in pairs if isinstance(pair[0], str) or pair[0][0] != "next"]

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._apply_to(next_tensordict, self._root_pairs())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        output_spec = output_spec.clone()
        observations = output_spec["full_observation_spec"]
        for in_key, out_key in self._root_pairs():
            if in_key not in observations.keys(True, True):
                raise KeyError(f"{type(self).__name__} found no {in_key!r} in the observations {observations}.")
            observations[out_key] = self.written_spec(observations[in_key])
        return output_spec
