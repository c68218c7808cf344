"""What the frozen encoder makes of observations: of the live one to act on, and of sampled ones under a shift."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from tqdm.auto import tqdm

from crptpro.data import FrameReplay
from crptpro.modules import PixelEncoder
from crptpro.transforms import DenseShiftCache, DenseShiftFeatures


class FrozenFeatures:
    """Two ways to the same features: cut from dense maps kept per observation, or encoded whenever needed.

    Args:
        encoder: frozen, already in its compute dtype.
        replay: where observations live.
        mode: ``"dense"`` or ``"reencode"``; see :func:`crptpro.transforms.choose_feature_mode`.
        slots: observations to keep dense maps of; by default all that the replay can hold. A smaller number must
            be at least the number of observations that will ever be stored; see :func:`dense_slots`.
        maps_dtype: of the dense maps, by default what the encoder computes in; features come in the latter.
        pad: largest random shift in pixels.
        generator: source of the shifts.
        device: where features live.
        projector: with one, ``sample`` also gives ``("next", "embedding")``, its output on the next features. In mode
            ``"dense"`` it is kept for every shift of an observation, so that no update computes it.
        n_step: agent steps from an observation to the next one of a sample; None for plain transitions.
        discount: per agent step, of the return over ``n_step``.

    Raises:
        ValueError: no slots, or (in mode ``"dense"``) an encoder without dense maps.
    """

    def __init__(
        self,
        encoder: PixelEncoder,
        replay: FrameReplay,
        *,
        mode: Literal["dense", "reencode"],
        pad: int,
        slots: int | None = None,
        maps_dtype: torch.dtype | None = None,
        generator: torch.Generator,
        device: torch.device | str = "cpu",
        projector: nn.Module | None = None,
        n_step: int | None = None,
        discount: float = 0.99,
    ) -> None:
        self.encoder = encoder
        self.replay = replay
        self.mode = mode
        self._window: dict[str, Any] = {} if n_step is None else {"n_step": n_step, "discount": discount}
        self.device = torch.device(device)
        self.slots = replay.window if slots is None else slots
        self.cache: DenseShiftCache | None = None
        if mode == "dense":
            self.cache = DenseShiftCache(
                encoder,
                self.slots,
                pad=pad,
                dtype=maps_dtype or encoder.compute_dtype,
                features_dtype=encoder.compute_dtype,
                device=device,
                projector=projector,
            )
        self.shifted = DenseShiftFeatures(
            self.cache,
            mode=mode,
            encoder=encoder,
            projector=projector,
            pad=pad,
            slot_keys=("cache_slot", ("next", "cache_slot")),
            embedding_keys=None if projector is None else [None, ("next", "embedding")],
            generator=generator,
            reuse_output=True,
        )

    @property
    def keeps_projections(self) -> bool:
        """Whether projections are read from the cache."""
        return self.cache is not None and self.cache.has_embeddings

    @torch.no_grad()
    def observe(self, pixels: Tensor, slot: int) -> Tensor:
        """Take in the observation that was just stored and return its un-shifted features.

        Args:
            pixels: uint8 ``[C, H, W]``.
            slot: where the replay stored its newest frame.

        Returns:
            ``[1, feature_dim]``.
        """
        if self.cache is None:
            return self.encoder(pixels.unsqueeze(0).to(self.device))
        rows = self._cache_slots(torch.tensor([slot]))
        self.cache.write(rows, pixels.unsqueeze(0))
        return self.cache.center(rows)

    def sample(self, batch_size: int) -> TensorDictBase:
        """Sample transitions with ``features`` and ``("next", "features")``, each observation under its own shift.

        Args:
            batch_size: B.

        Returns:
            The replay's sample ``[B]`` with features ``[B, feature_dim]``, and the next embeddings ``[B, D]`` with a
            projector, all on :attr:`device`. With ``n_step`` the next observation is so many agent steps ahead, the
            reward is the return until then, and ``("next", "discount")`` weighs what follows. The features are valid
            until the next call.
        """
        batch = self.replay.sample(batch_size, pixels=self.cache is None, **self._window)
        if self.cache is None:
            return self.shifted(batch.to(self.device))
        # Slots stay on the CPU until they are looked up: there the cache can check without waiting for a device.
        batch.set("cache_slot", self._cache_slots(batch["row"]))
        batch.set(("next", "cache_slot"), self._cache_slots(batch["next", "row"]))
        return self.shifted(batch).to(self.device)

    def rebuild(self, *, progress: bool = True) -> None:
        """Encode again every stored observation, after the replay was restored from a checkpoint.

        One by one, as they were encoded when they entered: a convolution may round differently in a batch.
        """
        if self.cache is None:
            return
        slots = self.replay.live_slots().tolist()
        for slot in tqdm(
            slots, desc="encode replay", unit="obs", leave=False, disable=None if progress else True
        ):
            one = torch.tensor([slot])
            self.cache.write(self._cache_slots(one), self.replay.observations_at(one))

    def _cache_slots(self, slots: Tensor) -> Tensor:
        # Live observations are among the newest `window` rows, so their numbers differ modulo `window`. The ring
        # itself is longer by its slack, for which no maps are kept. With fewer slots no number ever reaches them.
        return self.replay.numbers_at(slots) % self.slots


def dense_slots(replay: FrameReplay, agent_steps: int) -> int:
    """Return how many observations a run must keep dense maps of, so that no two live ones share a slot.

    Args:
        replay: where observations live.
        agent_steps: decisions of the whole run, parts before a resumption included.

    Returns:
        What the replay can hold, or all that the run can store if that is less: each decision stores one
        observation, each episode one more, and no episode is shorter than one decision.
    """
    return min(replay.window, 2 * agent_steps)
