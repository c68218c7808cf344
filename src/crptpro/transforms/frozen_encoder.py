"""A frozen encoder as a TorchRL transform: pixels in, features out, never a gradient."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data.tensor_specs import Composite, Unbounded
from torchrl.envs.transforms import ModuleTransform

from crptpro.modules.placement import device_of
from crptpro.transforms.keys import as_key_list
from crptpro.transforms.root_keys import KeyPair, OnRootKeys


class FrozenEncoder(OnRootKeys, ModuleTransform):
    """Encode images without gradient, on environments (single and batched) and in replay buffers.

    The encoder is used by reference: nothing is copied and its ``requires_grad`` flags stay as they are, so
    an encoder that a loss is still training can be looked through at any time. Acting on an environment
    encodes what each reset and step returned; ``("next", ...)`` keys are for replay batches only.

    An encoder may live on another device than the images: they are moved there, and the features come back to
    where the images were. (Attaching a transform to an environment that has a device moves the transform, and
    so the encoder, to that device: TorchRL does this to every transform.)

    TorchRL's ``ModuleTransform`` skips its module on reset (pytorch/rl#2595); this class does not.

    Args:
        encoder: maps ``[N, C, H, W]`` to ``[N, D]``.
        in_keys: images ``[*, C, H, W]`` with any number of leading dimensions.
        out_keys: features ``[*, D]``, in the encoder's output dtype.

    Raises:
        ValueError: ``in_keys`` and ``out_keys`` of unequal length.

    Examples:
        >>> from crptpro.modules import PixelEncoder
        >>> from tensordict import TensorDict
        >>> encoder = PixelEncoder(3, channels=(4, 4), strides=(2, 1), image_size=16)
        >>> FrozenEncoder(encoder)(TensorDict(pixels=torch.zeros(2, 3, 16, 16)))["features"].shape
        torch.Size([2, 100])
    """

    def __init__(
        self,
        encoder: nn.Module,
        *,
        in_keys: NestedKey | Sequence[NestedKey] = "pixels",
        out_keys: NestedKey | Sequence[NestedKey] = "features",
    ) -> None:
        in_keys, out_keys = as_key_list(in_keys), as_key_list(out_keys)
        if len(in_keys) != len(out_keys):
            raise ValueError(f"in_keys and out_keys differ in length: {in_keys} and {out_keys}.")
        any_batch = _AnyBatch(encoder)
        stages = [TensorDictModule(any_batch, [i], [o]) for i, o in zip(in_keys, out_keys)]
        super().__init__(module=TensorDictSequential(*stages), no_grad=True)
        self._pairs = list(zip(in_keys, out_keys))

    @property
    def encoder(self) -> nn.Module:
        """The encoder that was passed in."""
        return self.module[0].module.encoder

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Encode every key of a batch.

        Raises:
            KeyError: a key is missing.
        """
        return self._apply_to(tensordict, self._pairs)

    @torch.no_grad()
    def _apply_to(self, tensordict: TensorDictBase, pairs: list[KeyPair]) -> TensorDictBase:
        encode = self.module[0].module
        for in_key, out_key in pairs:
            pixels = tensordict.get(in_key, None)
            if pixels is None:
                present = list(tensordict.keys(True, True))
                raise KeyError(f"FrozenEncoder found no {in_key!r} among {present}; set in_keys.")
            tensordict.set(out_key, encode(pixels))
        return tensordict

    @torch.no_grad()
    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the features' shape and dtype, found by encoding one blank image.

        Raises:
            KeyError: the environment has no such observation.
        """
        for in_key, out_key in self._root_pairs():
            if in_key not in observation_spec.keys(True, True):
                raise KeyError(f"FrozenEncoder found no {in_key!r} in the observations {observation_spec}.")
            spec = observation_spec[in_key]
            blank = torch.zeros(spec.shape[-3:], dtype=spec.dtype, device=spec.device)
            features = self.module[0].module(blank)
            shape = (*spec.shape[:-3], *features.shape)
            observation_spec[out_key] = Unbounded(shape=shape, dtype=features.dtype, device=spec.device)
        return observation_spec


class _AnyBatch(nn.Module):
    """Give an image encoder any number of leading dimensions, none included, and images of any device."""

    def __init__(self, encoder: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, pixels: Tensor) -> Tensor:
        lead = pixels.shape[:-3]
        device = device_of(self.encoder) or pixels.device
        features = self.encoder(pixels.reshape(-1, *pixels.shape[-3:]).to(device)).to(pixels.device)
        return features.reshape(*lead, *features.shape[1:])
