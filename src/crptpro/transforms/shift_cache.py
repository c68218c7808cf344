"""A store of dense maps beside the replay buffer, and the choice whether to have one."""

from __future__ import annotations

import logging
from typing import Literal

import torch
from torch import Tensor, nn

from crptpro.host_memory import empty_on_huge_pages
from crptpro.modules import PixelEncoder
from crptpro.transforms.dense_shift import (
    crop_features,
    crop_rows,
    dense_shift_geometry,
    dense_shift_maps,
    require_readable,
)
from crptpro.transforms.free_memory import free_bytes

FeatureMode = Literal["auto", "dense", "reencode"]

logger = logging.getLogger(__name__)

# What the cache may take of the memory that is free; the rest is for networks, batches and the page cache.
MEMORY_SHARE = 0.8


class DenseShiftCache:
    """Dense maps of every observation in a replay buffer: encoded once on entry, cropped when sampled.

    The maps are derived data: they are not part of any checkpoint; write the frames again after resuming.
    Memory is taken as slots are written (2 MB at a time), except on GPUs, where it is taken at once.

    Args:
        encoder: frozen encoder, see :func:`~crptpro.transforms.dense_shift.dense_shift_geometry`. Its
            weights must not change while the cache is in use.
        slots: rows of the store; one per stored observation.
        pad: largest shift in pixels.
        dtype: of the stored maps. bfloat16 halves the memory and rounds each feature to eight significant bits
            (exact if the encoder computes in bfloat16).
        features_dtype: of the features read: that of the maps when None, or float32 of bfloat16 maps, which takes no
            longer than float32 of float32.
        device: where the store lives and the encoder runs.
        projector: with a projector, its output for all ``(2 * pad + 1)**2`` shifts is kept too (float32),
            computed from the maps as stored.

    Attributes:
        nbytes: memory of the full store.

    Raises:
        ValueError: an encoder that is not of this form, no slots, or features in a format that maps are not read in.
    """

    def __init__(
        self,
        encoder: PixelEncoder,
        slots: int,
        *,
        pad: int = 4,
        dtype: torch.dtype = torch.bfloat16,
        features_dtype: torch.dtype | None = None,
        device: torch.device | str = "cpu",
        projector: nn.Module | None = None,
    ) -> None:
        if slots < 1:
            raise ValueError(f"slots must be at least 1, got {slots}.")
        geometry = dense_shift_geometry(encoder, pad)
        self.encoder, self.projector = encoder, projector
        self.slots, self.pad, self.dtype = slots, pad, dtype
        self.features_dtype = dtype if features_dtype is None else features_dtype
        require_readable(dtype, self.features_dtype)
        self.device = torch.device(device)
        self.feature_dim = geometry.feature_dim
        self._maps = self._allocate((slots, *geometry.maps_shape), dtype)
        self._embeddings: Tensor | None = None
        if projector is not None:
            latent_dim = _latent_dim(projector, geometry.feature_dim, self.device)
            self._embeddings = self._allocate((slots, (2 * pad + 1) ** 2, latent_dim), torch.float32)
        self._written = torch.zeros(slots, dtype=torch.bool)
        self.nbytes = self._maps.nbytes + (0 if self._embeddings is None else self._embeddings.nbytes)
        logger.debug(
            "Dense-shift cache: %.2f GiB on %s when full (%d observations, %s).",
            self.nbytes / 2**30,
            self.device,
            slots,
            str(dtype).removeprefix("torch."),
        )

    @torch.no_grad()
    def write(self, slots: Tensor | int, pixels: Tensor) -> None:
        """Encode observations into their slots. What was there is overwritten.

        Args:
            slots: int64 ``[N]``, or one number.
            pixels: ``[N, C, H, W]``, or ``[C, H, W]`` with one number; uint8 or floating, values 0..255.

        Raises:
            ValueError: pixels of another shape or count.
            IndexError: a slot outside the store.
        """
        images = (pixels.unsqueeze(0) if pixels.ndim == 3 else pixels).to(self.device)
        rows = torch.as_tensor(slots, dtype=torch.int64).reshape(-1)
        if rows.shape[0] != images.shape[0]:
            raise ValueError(f"got {rows.shape[0]} slots for {images.shape[0]} observations.")
        self._require_inside(rows)
        chunk = max(1, self.encoder.micro_batch // self._maps.shape[1]) if self.device.type == "cpu" else 256
        for part_rows, part in zip(rows.split(chunk), images.split(chunk)):
            maps = dense_shift_maps(self.encoder, part, pad=self.pad, dtype=self.dtype)
            self._maps[part_rows.to(self.device)] = maps
            if self._embeddings is not None:
                self._embeddings[part_rows.to(self.device)] = self._embed_all_shifts(maps)
        self._written[rows.cpu()] = True

    def gather(self, slots: Tensor, offsets: Tensor, *, out: Tensor | None = None) -> Tensor:
        """Return the features of shifted observations.

        Args:
            slots: int64 ``[B]``.
            offsets: int64 ``[B, 2]``, (row, column) in ``{0, ..., 2 * pad}``.
            out: ``[B, feature_dim]`` of :attr:`features_dtype` to write into; reusing one halves the time on a
                CPU.

        Returns:
            ``[B, feature_dim]``: the encoder's features of ``random_shift(pixels, offsets)``, in its order.

        Raises:
            IndexError: a slot outside the store or never written (checked for slots on the CPU).
        """
        self._require_written(slots)
        return crop_rows(self._maps, slots, offsets, pad=self.pad, out=out, dtype=self.features_dtype)

    def center(self, slots: Tensor | int) -> Tensor:
        """Return the features of the observations as they are, un-shifted: what an agent acts on.

        Args:
            slots: int64 ``[B]``, or one number.

        Returns:
            ``[B, feature_dim]``, or ``[feature_dim]`` for one number.
        """
        rows = torch.as_tensor(slots, dtype=torch.int64)
        offsets = torch.full((rows.numel(), 2), self.pad, device=rows.device)
        return self.gather(rows.reshape(-1), offsets).reshape(*rows.shape, self.feature_dim)

    def gather_embeddings(self, slots: Tensor, offsets: Tensor) -> Tensor:
        """Return the projections of shifted observations.

        Args:
            slots: int64 ``[B]``.
            offsets: int64 ``[B, 2]``, (row, column) in ``{0, ..., 2 * pad}``.

        Returns:
            float32 ``[B, D]``, not normalised: the projector's output on :meth:`gather`, up to the rounding
            of its matrix product.

        Raises:
            RuntimeError: the cache was built without a projector.
            IndexError: a slot outside the store or never written (checked for slots on the CPU).
        """
        if self._embeddings is None:
            raise RuntimeError(
                "this cache holds no embeddings; build it with DenseShiftCache(projector=...)."
            )
        self._require_written(slots)
        offsets = offsets.to(self.device)
        return self._embeddings[slots.to(self.device), offsets[:, 0] * (2 * self.pad + 1) + offsets[:, 1]]

    @property
    def has_embeddings(self) -> bool:
        """Whether projections are kept too."""
        return self._embeddings is not None

    def _embed_all_shifts(self, maps: Tensor) -> Tensor:
        assert self.projector is not None
        side = torch.arange(2 * self.pad + 1)
        offsets = torch.cartesian_prod(side, side)
        return torch.stack(
            [
                self.projector(crop_features(m.expand(len(offsets), *m.shape), offsets, pad=self.pad))
                for m in maps
            ]
        ).float()

    def _allocate(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        if self.device.type == "cpu":
            return empty_on_huge_pages(shape, dtype)
        return torch.empty(shape, dtype=dtype, device=self.device)

    def _require_inside(self, slots: Tensor) -> None:
        # Slots on a GPU are not read: that would wait for the device at every update.
        if slots.device.type != "cpu" or slots.numel() == 0:
            return
        low, high = (int(bound) for bound in torch.aminmax(slots))
        if low < 0 or high >= self.slots:
            raise IndexError(
                f"slots {low}..{high} do not fit a store of {self.slots}; use 0..{self.slots - 1}."
            )

    def _require_written(self, slots: Tensor) -> None:
        self._require_inside(slots)
        if slots.device.type == "cpu" and not bool(self._written[slots].all()):
            missing = slots[~self._written[slots]].unique().tolist()
            raise IndexError(
                f"slots {missing[:5]} of the dense-shift cache were never written; call write() first."
            )


def choose_feature_mode(
    mode: FeatureMode,
    encoder: nn.Module,
    slots: int,
    dtype: torch.dtype = torch.bfloat16,
    available_bytes: int | None = None,
    *,
    pad: int = 4,
    latent_dim: int | None = None,
    device: torch.device | str = "cpu",
) -> tuple[Literal["dense", "reencode"], str]:
    """Decide between the dense-shift cache and re-encoding at every update; both give the same features.

    Args:
        mode: ``"auto"`` takes the cache where the encoder has the form and the memory suffices; the other
            two are obeyed.
        encoder: the frozen encoder.
        slots: observations to hold.
        dtype: of the stored maps.
        available_bytes: free memory, of which the cache may take four fifths; measured when None (on a CPU
            within the limits of the container or batch job).
        pad: largest shift in pixels.
        latent_dim: length of the projections if they are to be kept too.
        device: whose memory is measured.

    Returns:
        The mode, and the reason in one line, to be shown to the user.

    Raises:
        ValueError: ``"dense"`` for an encoder that is not of the form, or an unknown mode.
    """
    if mode == "reencode":
        return "reencode", "re-encoding at every update, as asked"
    if mode not in ("auto", "dense"):
        raise ValueError(f"mode must be 'auto', 'dense' or 'reencode', got {mode!r}.")
    try:
        needed = dense_cache_bytes(encoder, slots, dtype, pad=pad, latent_dim=latent_dim)
    except ValueError as error:
        if mode == "dense":
            raise
        return "reencode", f"re-encoding at every update: {error}"
    available = free_bytes(torch.device(device)) if available_bytes is None else available_bytes
    size = f"{needed / 2**30:.1f} GiB for {slots} observations, {available / 2**30:.1f} GiB free"
    if mode == "dense":
        if needed > available:
            logger.warning("The dense-shift cache was asked for and may not fit: %s.", size)
        return "dense", f"dense-shift cache, as asked ({size})"
    if needed > MEMORY_SHARE * available:
        in_bf16 = dense_cache_bytes(encoder, slots, torch.bfloat16, pad=pad, latent_dim=latent_dim)
        fits = in_bf16 <= MEMORY_SHARE * available
        remedy = f"; in bf16, by dense_precision, it would fit with {in_bf16 / 2**30:.1f} GiB" if fits else ""
        return (
            "reencode",
            f"re-encoding at every update: too little memory for the dense-shift cache ({size}{remedy})",
        )
    return "dense", f"dense-shift cache ({size})"


def dense_cache_bytes(
    encoder: nn.Module, slots: int, dtype: torch.dtype, *, pad: int = 4, latent_dim: int | None = None
) -> int:
    """Return the memory of a full :class:`DenseShiftCache` in bytes; see :func:`choose_feature_mode`.

    Raises:
        ValueError: an encoder that is not of the form.
    """
    values = dense_shift_geometry(encoder, pad).values
    return slots * (values * dtype.itemsize + (latent_dim or 0) * 4 * (2 * pad + 1) ** 2)


@torch.no_grad()
def _latent_dim(projector: nn.Module, feature_dim: int, device: torch.device) -> int:
    return int(projector(torch.zeros(1, feature_dim, device=device)).shape[-1])
