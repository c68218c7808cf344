"""Base of the transforms: keys of images in replay batches and on environments."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data.tensor_specs import Composite
from torchrl.envs.transforms import Transform

#: One (nested) key, or a list of keys: as in TorchRL, a tuple is one key.
Keys = Any


def require_pairs(transform: Transform) -> None:
    """Require as many out keys as in keys."""
    read, written = transform.in_keys, transform.out_keys
    if len(read) != len(written):
        raise ValueError(f"in_keys {read} and out_keys {written} must pair up.")


class PixelTransform(Transform):
    """Computes one entry from each image entry, in replay batches and in environments.

    Without ``out_keys`` the images are replaced. A subclass implements ``_apply_transform`` and, if the output has
    another spec than the image, :meth:`written_spec`.
    """

    def __init__(self, in_keys: Keys, out_keys: Keys | None = None) -> None:
        super().__init__(in_keys=in_keys)
        self.out_keys = list(self.in_keys) if out_keys is None else out_keys
        require_pairs(self)

    def written_spec(self, read: Any) -> Any:
        """Return the spec of the output for an image of spec ``read``."""
        return read.clone()

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        spec = observation_spec.clone()
        for in_key, out_key in zip(self.in_keys, self.out_keys):
            spec[out_key] = self.written_spec(spec[in_key])
        return spec
