"""Features of all 81 random shifts of an image as crops of a few dense maps: the same numbers, encoded once.

An un-padded convolutional encoder with total stride S maps a shifted image to a crop of its map of the larger,
border-replicated image. Shifts that differ by a multiple of S share one map ("phase"): the shift (dy, dx) is the crop
at (dy // S, dx // S) of the map of phase (dy % S, dx % S), as in the shift-and-stitch of OverFeat (Sermanet et al.
2013, https://arxiv.org/abs/1312.6229).
"""

from __future__ import annotations

import math
import threading
from typing import Any, Literal, Self

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data.tensor_specs import TensorSpec
from torchrl.envs.transforms import Transform

from crptpro.errors import CRPTproError
from crptpro.modules import PixelEncoder
from crptpro.modules.precision import device_of, evaluating
from crptpro.transforms.base import Keys, require_pairs
from crptpro.transforms.random_shift import as_numpy_bits, draw_offsets
from crptpro.values import as_int, read_entry


def dense_shift_geometry(encoder: nn.Module, pad: int = 4) -> tuple[int, int, tuple[int, int, int, int]]:
    """Return the sizes for shifts of up to ``pad`` pixels; a ``ValueError`` for an encoder that has no dense maps.

    They are the phases per axis (2 for the default encoder), the side in pixels of the image that each phase encodes
    (92), and the shape ``(phases**2, C, m, m)`` of the dense maps of one image (4, 32, 39, 39).
    """
    if not isinstance(encoder, PixelEncoder):
        raise ValueError(
            f"dense-shift features need an un-padded convolutional PixelEncoder, got {type(encoder).__name__}; "
            "encode shifted images instead."
        )
    stride = math.prod(encoder.strides)
    if stride > 2 * pad + 1:
        raise ValueError(
            f"the encoder's total stride {stride} exceeds the {2 * pad + 1} shifts per axis of pad {pad}; "
            "encode shifted images instead."
        )
    channels, height, width = encoder.feature_map_shape
    extra = 2 * pad // stride
    shape = (stride**2, channels, height + extra, width + extra)
    return stride, encoder.image_size + stride * extra, shape


@torch.no_grad()
def dense_shift_maps(
    encoder: PixelEncoder, pixels: Tensor, *, pad: int = 4, dtype: torch.dtype | None = None
) -> Tensor:
    """Encode images once per stride phase, border replicated, for every shift of up to ``pad`` pixels.

    Returns ``[B, phases**2, C, m, m]`` contiguous, of ``dtype`` or the encoder's compute dtype, phases ordered (row,
    column); not standardised.
    """
    phases, window, _ = dense_shift_geometry(encoder, pad)
    expected = (encoder.in_channels, encoder.image_size, encoder.image_size)
    if pixels.ndim != 4 or tuple(pixels.shape[1:]) != expected:
        raise ValueError(f"expected pixels of shape [B, {expected}], got {tuple(pixels.shape)}.")
    # The last phase's window ends beyond the padded image; no crop depends on those lines.
    far = pad + max(0, phases - 1 + window - (encoder.image_size + 2 * pad))
    padded = F.pad(pixels, (pad, far, pad, far), mode="replicate")
    origins = [(row, column) for row in range(phases) for column in range(phases)]
    windows = [padded[:, :, row : row + window, column : column + window] for row, column in origins]
    maps = encoder.feature_map(torch.stack(windows, dim=1))
    return maps.to(dtype=maps.dtype if dtype is None else dtype, memory_format=torch.contiguous_format)


@torch.no_grad()
def crop_features(maps: Tensor, rows: Tensor, offsets: Tensor, out: Tensor, *, pad: int = 4) -> Tensor:
    """Read the features of one shift per image, int64 ``offsets`` ``[B, 2]``, from the maps at ``rows`` ``[B]``.

    Fills and returns ``out`` ``[B, feature_dim]``, of the maps' dtype (or float32 for bfloat16 maps): the value of
    ``encoder(random_shift(pixels, offsets, pad=pad))``, not standardised. In float32 it is equal bit for bit where
    the convolution's order of summation does not depend on the image size (oneDNN on x86); otherwise to about 1e-6 of
    the largest feature.
    """
    phases, channels = math.isqrt(maps.shape[1]), maps.shape[2]
    extra = 2 * pad // phases
    height, width = maps.shape[-2] - extra, maps.shape[-1] - extra
    if maps.device.type != "cpu":
        return out.copy_(_crop_by_index(maps, rows, offsets, phases, (extra + 1, height, width)))
    # numpy's slices are faster: 512 float32 crops took 23 ms on one thread, torch.stack of slices 28 ms.
    widens = out.dtype != maps.dtype
    source = as_numpy_bits(maps)
    target = out.view(torch.int32).numpy() if widens else as_numpy_bits(out)
    target = target.reshape(len(rows), channels, height, width)
    for crop, row, (dy, dx) in zip(target, rows.tolist(), offsets.tolist()):
        top, left = dy // phases, dx // phases
        phase = dy % phases * phases + dx % phases
        crop[:] = source[row, phase, :, top : top + height, left : left + width]
        if widens:
            crop <<= 16  # the bits of a bfloat16 are the upper half of the same number's in float32
    return out


def _crop_by_index(maps: Tensor, rows: Tensor, offsets: Tensor, phases: int, sizes: tuple[int, int, int]) -> Tensor:
    origins, height, width = sizes
    slots, phase_count, channels = maps.shape[:3]
    row_stride, phase_stride, channel_stride, line, column = maps.stride()
    every_crop = maps.as_strided(
        (slots, phase_count, origins, origins, channels, height, width),
        (row_stride, phase_stride, line, column, channel_stride, line, column),
    )
    rows, offsets = rows.to(maps.device), offsets.to(maps.device)
    origin, remainder = offsets // phases, offsets % phases
    phase = remainder[:, 0] * phases + remainder[:, 1]
    return every_crop[rows, phase, origin[:, 0], origin[:, 1]].flatten(1)


class DenseShiftFeatures(Transform):
    """Write a frozen encoder's features of randomly shifted observations into a replay batch.

    Attached to a :class:`~crptpro.data.FrameReplay` it does what ``RandomShift`` and ``FrozenEncoder`` would, with the
    same shifts from the same generator and the same bits. It encodes each observation only once, when first sampled.
    Its dense maps are kept until the replay has overwritten it, or a weight changes. No state dictionary, copy or
    pickle holds them. If the transform is not attached, call :meth:`forget` after loading a state of the replay.

    Threads may share it. On an environment use :class:`~crptpro.transforms.FrozenEncoder`.

    Args:
        encoder: frozen, see :func:`dense_shift_geometry`; a change of its weights drops all maps.
        replay: a :class:`~crptpro.data.FrameReplay`, or any object with ``observations(numbers)``, uint8
            ``[B, C, H, W]``, and a ``window``: the observations held at once have numbers that differ modulo this.
        pad: largest shift in pixels.
        projector: its float32 output for all ``(2 * pad + 1)**2`` shifts of an observation is kept too, and
            ``("next", "embedding")`` is written, ``[*, D]`` of the observation of the last in key; None for neither.
        dtype: of the kept maps; the encoder's compute dtype when None. bfloat16 halves the memory and rounds each
            feature to eight significant bits (exact if the encoder computes in bfloat16).
        generator: source of the offsets, which the state dict excludes; torch's global one when None.
        observations: maps to keep, each 0.78 MB in float32 (default encoder); what the replay can hold when None.
            Fewer will do for a run that stores fewer.
        in_keys: int64 ``[*]`` or ``[*, 1]``, numbers of observations; ``"number"`` and ``("next", "number")`` if None.
        out_keys: features ``[*, feature_dim]`` in the encoder's compute dtype, one key per observation; ``"features"``
            and ``("next", "features")`` if None.

    Raises:
        ValueError: an encoder without dense maps, key lists of unequal length, or a ``dtype`` unfit for the encoder's.
    """

    encoder: PixelEncoder
    projector: nn.Module | None

    def __init__(
        self,
        encoder: PixelEncoder,
        replay: Any,
        *,
        pad: int = 4,
        projector: nn.Module | None = None,
        dtype: torch.dtype | None = None,
        generator: torch.Generator | None = None,
        observations: int | None = None,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        super().__init__(in_keys=["number", ("next", "number")] if in_keys is None else in_keys)
        self.out_keys = ["features", ("next", "features")] if out_keys is None else out_keys
        require_pairs(self)
        self.pad = as_int(pad, "pad", minimum=0)
        self.maps_shape = dense_shift_geometry(encoder, self.pad)[2]
        computed = encoder.compute_dtype
        self.dtype = computed if dtype is None else dtype
        if computed != self.dtype and (self.dtype, computed) != (torch.bfloat16, torch.float32):
            raise ValueError(f"maps in {self.dtype} are read as {self.dtype}, or bfloat16 as float32; got {computed}.")
        # Hidden from nn.Module: the caller owns the networks, which are not part of a replay's state.
        self.__dict__["encoder"] = encoder
        self.__dict__["projector"] = projector
        if not hasattr(replay, "observations") or (observations is None and not hasattr(replay, "window")):
            raise ValueError(
                f"A {type(replay).__name__} has no observations by number: store them in a FrameReplay, or use "
                "RandomShift and FrozenEncoder."
            )
        self.replay = replay
        slots = replay.window if observations is None else observations
        self.observations = as_int(slots, "observations", minimum=1)
        self.generator = generator
        self._own_lock = threading.RLock()
        self.forget()

    def forget(self) -> None:
        """Drop all maps, and free their memory."""
        self._held = torch.full((self.observations,), -1, dtype=torch.int64, device="cpu")
        self._maps: Tensor | None = None
        self._embeddings: Tensor | None = None
        self._encoded_with: list[tuple[int, int]] = []  # identifies the weights that the maps come from

    @property
    def _lock(self) -> Any:
        """The replay's lock, so that no observation is overwritten between its draw and its use."""
        return getattr(self.replay, "_replay_lock", None) or self._own_lock

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        numbers = [self._numbers(tensordict, key) for key in self.in_keys]
        # The lock is held until the crops are read: another thread might need the same slot for a newer observation.
        with self._lock:
            maps, embeddings = self._encode_missing(torch.cat([flat for flat, _ in numbers]))
            for (flat, lead), out_key in zip(numbers, self.out_keys):
                offsets = draw_offsets(flat.shape[0], self.pad, self.generator)
                rows = flat % self.observations
                features = crop_features(maps, rows, offsets, self._new_output(len(flat)), pad=self.pad)
                tensordict.set(out_key, self.encoder.standardised(features).reshape(*lead, -1))
            if embeddings is not None:
                shifts = offsets[:, 0] * (2 * self.pad + 1) + offsets[:, 1]
                found = embeddings[rows.to(embeddings.device), shifts.to(embeddings.device)]
                tensordict.set(("next", "embedding"), found.reshape(*lead, -1))
        return tensordict

    @torch.no_grad()
    def unshifted(self, number: int) -> Tensor:
        """Return an observation's features ``[1, feature_dim]`` without a shift, for a policy; its maps are kept."""
        numbers, centre = torch.tensor([number], device="cpu"), torch.full((1, 2), self.pad, device="cpu")
        with self._lock:
            maps, _ = self._encode_missing(numbers)
            features = crop_features(maps, numbers % self.observations, centre, self._new_output(1), pad=self.pad)
        return self.encoder.standardised(features)

    def _numbers(self, tensordict: TensorDictBase, key: NestedKey) -> tuple[Tensor, torch.Size]:
        value = read_entry(self, tensordict, key)
        # Replay buffers store a scalar per row as [*] or as [*, 1].
        value = value.squeeze(-1) if value.ndim == tensordict.batch_dims + 1 else value
        return value.reshape(-1).cpu(), value.shape

    def _encode_missing(self, numbers: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return all maps and projections, after encoding those of these observations that are missing."""
        networks = [network for network in (self.encoder, self.projector) if network is not None]
        weights = [value for network in networks for value in (*network.parameters(), *network.buffers())]
        now = [(value.data_ptr(), 0 if value.is_inference() else value._version) for value in weights]
        if now != self._encoded_with:
            self.forget()
            self._encoded_with = now
        if self._maps is None:
            shape = (self.observations, *self.maps_shape)
            self._maps = torch.empty(shape, dtype=self.dtype, device=device_of(self.encoder))
        missing = numbers[self._held[numbers % self.observations] != numbers].unique()
        for number in missing.tolist():
            # One by one: a convolution may round differently in a batch, and then a resumed run would, too.
            pixels = self.replay.observations(torch.tensor([number], device="cpu")).to(self._maps.device)
            maps = dense_shift_maps(self.encoder, pixels, pad=self.pad, dtype=self.dtype)
            slot = number % self.observations
            self._maps[slot] = maps[0]
            if self.projector is not None:
                embeddings = self._embed_all_shifts(self.projector, maps)
                if self._embeddings is None:
                    self._embeddings = embeddings.new_empty(self.observations, *embeddings.shape)
                self._embeddings[slot] = embeddings
            self._held[slot] = number
        if len(missing) and not torch.equal(self._held[numbers % self.observations], numbers):
            raise ValueError(
                f"`observations` is {self.observations}, fewer than the replay holds: two observations of one batch "
                "map to the same slot. Leave it out, or keep as many as the replay."
            )
        return self._maps, self._embeddings

    def _embed_all_shifts(self, projector: nn.Module, maps: Tensor) -> Tensor:
        side = torch.arange(2 * self.pad + 1, device="cpu")
        offsets = torch.cartesian_prod(side, side)
        rows = torch.zeros(len(offsets), dtype=torch.int64, device="cpu")
        features = crop_features(maps, rows, offsets, self._new_output(len(offsets)), pad=self.pad)
        with evaluating(projector):  # it may be in training
            return projector(self.encoder.standardised(features)).float()

    def _new_output(self, count: int) -> Tensor:
        dtype, device = self.encoder.compute_dtype, device_of(self.encoder)
        return torch.empty(count, self.encoder.feature_dim, dtype=dtype, device=device)

    def clone(self) -> Self:
        copy = super().clone()
        copy._own_lock = threading.RLock()
        copy.forget()
        return copy

    def __getstate__(self) -> dict[str, Any]:
        derived = ("_own_lock", "_held", "_maps", "_embeddings", "_encoded_with")
        return {key: value for key, value in super().__getstate__().items() if key not in derived}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._own_lock = threading.RLock()
        self.forget()

    def _load_from_state_dict(self, *args: Any) -> None:
        self.forget()  # the loaded state may number observations differently

    def transform_output_spec(self, output_spec: TensorSpec) -> TensorSpec:
        raise NotImplementedError("DenseShiftFeatures reads a replay batch; on an environment use FrozenEncoder.")


def choose_feature_mode(
    mode: Literal["auto", "dense", "reencode"],
    encoder: nn.Module,
    observations: int,
    dtype: torch.dtype,
    available_bytes: int,
    *,
    latent_dim: int | None = None,
    share: float = 0.8,
) -> tuple[Literal["dense", "reencode"], str]:
    """Choose dense maps or re-encoding of shifted images, which give the same features; returns mode and reason.

    ``"auto"`` chooses dense maps for a suitable encoder if they fit in a ``share`` of the free memory,
    ``available_bytes``: the maps of ``observations`` in ``dtype`` and, with ``latent_dim``, their projections. The rest
    is for networks, batches and the page cache. Shifts are of up to 4 pixels. ``"dense"`` raises a ``ValueError`` for
    an unsuitable encoder, and a ``CRPTproError`` if the maps do not fit.
    """
    if mode == "reencode":
        return "reencode", "re-encoding at every update, as requested"
    try:
        needed = dense_maps_bytes(encoder, observations, dtype, latent_dim=latent_dim)
    except ValueError as error:
        if mode == "dense":
            raise
        return "reencode", f"re-encoding at every update: {error}"
    size = f"{needed / 2**30:.1f} GiB for {observations} observations, {available_bytes / 2**30:.1f} GiB free"
    if mode == "dense":
        if needed > available_bytes:
            raise CRPTproError(
                f"The dense maps do not fit in memory: {size}. features='reencode' needs none; a run that began with "
                "dense maps can be continued with it."
            )
        return "dense", f"dense maps, as requested ({size})"
    budget = share * available_bytes
    if needed <= budget:
        return "dense", f"dense maps ({size})"
    in_bf16 = dense_maps_bytes(encoder, observations, torch.bfloat16, latent_dim=latent_dim)
    if in_bf16 <= budget:
        size += f"; with features=dense-bf16 it would fit in {in_bf16 / 2**30:.1f} GiB"
    return "reencode", f"re-encoding at every update: too little memory for dense maps ({size})"


def dense_maps_bytes(
    encoder: nn.Module, observations: int, dtype: torch.dtype, *, latent_dim: int | None = None
) -> int:
    """Return the memory of dense maps in bytes; see :func:`choose_feature_mode`."""
    values = math.prod(dense_shift_geometry(encoder)[2])
    return observations * (values * dtype.itemsize + (latent_dim or 0) * 4 * 9**2)  # 9 x 9 shifts
