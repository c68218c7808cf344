"""Features of a sampled batch under a fresh random shift, from the dense-shift cache or by encoding again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data.tensor_specs import TensorSpec
from torchrl.envs.transforms import Transform

from crptpro.transforms.keys import as_key_list
from crptpro.transforms.random_shift import draw_offsets, random_shift
from crptpro.transforms.shift_cache import DenseShiftCache

SLOT_KEYS: list[NestedKey] = ["rows", ("next", "rows")]
PIXEL_KEYS: list[NestedKey] = ["pixels", ("next", "pixels")]
FEATURE_KEYS: list[NestedKey] = ["features", ("next", "features")]


class DenseShiftFeatures(Transform):
    """Write the frozen encoder's features of randomly shifted observations into a replay batch.

    Every key and every sample draws its own shift. In mode ``"dense"`` the features are crops from a
    :class:`~crptpro.transforms.DenseShiftCache`; in mode ``"reencode"`` the pixels are shifted and encoded.
    Both draw the same offsets from the generator, as :class:`~crptpro.transforms.RandomShift` would for the
    same keys: the mode changes speed and memory, and the features by rounding only.

    For replay batches; on an environment use :class:`~crptpro.transforms.FrozenEncoder`.

    Args:
        cache: the store to read; required in mode ``"dense"``.
        mode: where features come from; see :func:`~crptpro.transforms.choose_feature_mode`.
        encoder: frozen encoder; required in mode ``"reencode"``.
        projector: for ``embedding_keys``: used in mode ``"reencode"``, and in mode ``"dense"`` where the
            cache keeps no projections.
        pad: largest shift in pixels; the cache's own in mode ``"dense"``.
        slot_keys: int64 ``[*]`` or ``[*, 1]``, the cache rows of the observations; read in mode ``"dense"``.
        pixel_keys: ``[*, C, H, W]``; read in mode ``"reencode"``.
        out_keys: features ``[*, feature_dim]``, one key per observation.
        embedding_keys: where each observation's projection ``[*, D]`` goes, None for those that want none.
        features_dtype: of the features; as stored, or as the encoder returns them, when None.
        reuse_output: write each batch over the previous one, which saves half the time on a CPU. The
            features of a call are then valid until the next one.
        generator: source of the offsets; torch's global generator when None. Not part of the state dict.

    Raises:
        ValueError: key lists of unequal length, an unknown mode, or a mode without what it needs.
    """

    def __init__(
        self,
        cache: DenseShiftCache | None = None,
        *,
        mode: Literal["dense", "reencode"] = "dense",
        encoder: nn.Module | None = None,
        projector: nn.Module | None = None,
        pad: int = 4,
        slot_keys: NestedKey | Sequence[NestedKey] = SLOT_KEYS,
        pixel_keys: NestedKey | Sequence[NestedKey] = PIXEL_KEYS,
        out_keys: NestedKey | Sequence[NestedKey] = FEATURE_KEYS,
        embedding_keys: list[NestedKey | None] | None = None,
        features_dtype: torch.dtype | None = None,
        reuse_output: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        if mode not in ("dense", "reencode"):
            raise ValueError(f"mode must be 'dense' or 'reencode', got {mode!r}; see choose_feature_mode.")
        if mode == "dense" and cache is None:
            raise ValueError("mode 'dense' needs a DenseShiftCache: pass cache=, or use mode='reencode'.")
        if mode == "reencode" and encoder is None:
            raise ValueError("mode 'reencode' needs the frozen encoder: pass encoder=.")
        in_keys = as_key_list(slot_keys if mode == "dense" else pixel_keys)
        out_keys = as_key_list(out_keys)
        embedding_keys = [None] * len(out_keys) if embedding_keys is None else list(embedding_keys)
        if not len(in_keys) == len(out_keys) == len(embedding_keys):
            raise ValueError(
                f"keys differ in length: in {in_keys}, out {out_keys}, embeddings {embedding_keys}."
            )
        has_embeddings = projector is not None or (cache is not None and cache.has_embeddings)
        if any(key is not None for key in embedding_keys) and not has_embeddings:
            raise ValueError(f"embedding_keys {embedding_keys} need a projector: pass projector=.")
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        self.mode = mode
        self.cache = cache
        self.encoder, self.projector = encoder, projector
        self.pad = cache.pad if mode == "dense" and cache is not None else pad
        self.embedding_keys = embedding_keys
        self.features_dtype = features_dtype
        self.reuse_output = reuse_output
        self.generator = generator
        self._outputs: dict[NestedKey, Tensor] = {}

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add features, and projections where asked for, to a sampled batch.

        Raises:
            KeyError: an in key is missing.
        """
        for in_key, out_key, embedding_key in zip(self.in_keys, self.out_keys, self.embedding_keys):
            value = tensordict.get(in_key, None)
            if value is None:
                present = list(tensordict.keys(True, True))
                raise KeyError(f"DenseShiftFeatures ({self.mode}) found no {in_key!r} among {present}.")
            if self.mode == "dense":
                slots = _without_unit_axis(value, tensordict)
                lead, flat = slots.shape, slots.reshape(-1)
            else:
                lead, flat = value.shape[:-3], value.reshape(-1, *value.shape[-3:])
            offsets = draw_offsets(flat.shape[0], self.pad, self.generator, flat.device)
            dense = self.mode == "dense"
            features = self._dense(flat, offsets, out_key) if dense else self._encode(flat, offsets)
            if embedding_key is not None:
                embeddings = self._embed(flat, offsets, features)
                tensordict.set(embedding_key, embeddings.reshape(*lead, embeddings.shape[-1]))
            if self.features_dtype is not None:
                features = features.to(self.features_dtype)
            tensordict.set(out_key, features.reshape(*lead, features.shape[-1]))
        return tensordict

    def clone(self) -> DenseShiftFeatures:
        """Return a transform without parent and with outputs of its own; cache, networks and generator are shared."""
        copy = super().clone()
        copy._outputs = {}
        return copy

    def _dense(self, slots: Tensor, offsets: Tensor, out_key: NestedKey) -> Tensor:
        assert self.cache is not None
        if not self.reuse_output:
            return self.cache.gather(slots, offsets)
        out = self._outputs.get(out_key)
        if out is not None and out.shape[0] != slots.shape[0]:
            out = None
        self._outputs[out_key] = self.cache.gather(slots, offsets, out=out)
        return self._outputs[out_key]

    def _encode(self, pixels: Tensor, offsets: Tensor) -> Tensor:
        assert self.encoder is not None
        return self.encoder(random_shift(pixels, offsets, pad=self.pad))

    def _embed(self, slots: Tensor, offsets: Tensor, features: Tensor) -> Tensor:
        if self.mode == "dense" and self.cache is not None and self.cache.has_embeddings:
            return self.cache.gather_embeddings(slots, offsets)
        assert self.projector is not None
        return self.projector(features)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError(_REPLAY_ONLY)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError(_REPLAY_ONLY)

    def transform_output_spec(self, output_spec: TensorSpec) -> TensorSpec:
        """Refuse to be part of an environment.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(_REPLAY_ONLY)


_REPLAY_ONLY = "DenseShiftFeatures reads a replay batch; on an environment use FrozenEncoder."


def _without_unit_axis(slots: Tensor, tensordict: TensorDictBase) -> Tensor:
    # Replay buffers store a scalar per row as [*] or as [*, 1].
    return slots.squeeze(-1) if slots.ndim == tensordict.batch_dims + 1 else slots
