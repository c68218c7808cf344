"""What is logged: means since the last row, per domain where that matters, and the prototypes' state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import psutil
import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from crptpro.objectives.metrics import mean_pairwise_cosine, prototype_metrics

PROBE_ROWS = 128
RAW_FEATURES_THRESHOLD = 0.9999
LATENTS_THRESHOLD = 0.99


class Window:
    """Running sums of a loss's outputs, kept on the device until a row is due.

    Args:
        loss: the loss being trained.
        domains: names in cyclic order.
        is_mixed: whether batches have rows of every domain, under one name then: rows get no columns per domain.
    """

    def __init__(self, loss: LossModule, domains: list[str], *, is_mixed: bool = False) -> None:
        self.loss = loss
        self.domains = domains
        self.is_mixed = is_mixed
        self.sums: Tensor | None = None
        self.counts = [0] * len(domains)
        self.cosines: dict[str, float] = {}
        self._probes: dict[int, Tensor] = {}

    def add(self, values: Tensor, domain: int) -> None:
        """Add the outputs of one update on one domain."""
        if self.sums is None:
            self.sums = values.new_zeros(len(self.domains), len(values))
        self.sums[domain] += values
        self.counts[domain] += 1

    def probe(self, batch: TensorDictBase, domain: int) -> None:
        """Remember some images of a domain, for losses that do not report the cosine of their embeddings."""
        key = getattr(getattr(self.loss, "tensor_keys", None), "observation", "pixels")
        pixels = batch.get(key, None)
        if pixels is None:
            return
        images = pixels.reshape(-1, *pixels.shape[-3:])
        if self.is_mixed:  # the first rows are all of one domain
            spread = torch.linspace(0, len(images) - 1, min(len(images), PROBE_ROWS)).long()
            images = images[spread.to(images.device)]
        self._probes[domain] = images[:PROBE_ROWS].clone()

    def row(self, names: list[str]) -> dict[str, float]:
        """Return the metrics of the window without closing it.

        Args:
            names: what :meth:`add` added, loss terms first.
        """
        if self.sums is None or not sum(self.counts):
            return {}
        means = (self.sums.sum(0) / sum(self.counts)).tolist()
        row = dict(zip(names, means))
        terms = [index for index, name in enumerate(names) if name.startswith("loss")]
        row = {"loss": sum(means[index] for index in terms), **row}
        rows = self.sums.tolist()
        for domain, (sums, count) in enumerate(zip(rows, self.counts)):
            if count and not self.is_mixed:
                row[f"loss/{self.domains[domain]}"] = sum(sums[index] for index in terms) / count
        self._measure_cosines(names, rows)
        if not self.is_mixed:
            row.update({f"cosine/{domain}": value for domain, value in self.cosines.items()})
        row.update(self._prototype_row(row))
        return row

    def close(self) -> None:
        """Start the next window."""
        if self.sums is not None:
            self.sums.zero_()
        self.counts = [0] * len(self.domains)
        self._probes = {}

    def state_dict(self) -> dict[str, Any]:
        """Return the open window."""
        probes = {str(domain): pixels for domain, pixels in self._probes.items()}
        return {"sums": self.sums, "counts": self.counts, "cosines": self.cosines, "probes": probes}

    def load_state_dict(self, state: Mapping[str, Any], device: torch.device) -> None:
        """Restore :meth:`state_dict`."""
        self.sums = None if state["sums"] is None else state["sums"].to(device)
        self.counts = list(state["counts"])
        self.cosines = dict(state["cosines"])
        self._probes = {int(domain): pixels.to(device) for domain, pixels in state["probes"].items()}

    def _measure_cosines(self, names: list[str], rows: list[list[float]]) -> None:
        if "embedding_cosine" in names:
            column = names.index("embedding_cosine")
            for domain, (sums, count) in enumerate(zip(rows, self.counts)):
                if count:
                    self.cosines[self.domains[domain]] = sums[column] / count
            return
        for domain, pixels in self._probes.items():
            if (cosine := self._probe_cosine(pixels)) is not None:
                self.cosines[self.domains[domain]] = cosine

    @torch.no_grad()
    def _probe_cosine(self, pixels: Tensor) -> float | None:
        encoder = getattr(self.loss, "encoder", None)
        if not isinstance(encoder, nn.Module):
            return None
        latents = encoder(pixels)
        if isinstance(projector := getattr(self.loss, "projector", None), nn.Module):
            latents = projector(latents)
        if not isinstance(latents, Tensor) or latents.ndim != 2:
            return None
        return float(mean_pairwise_cosine(F.normalize(latents.float(), dim=-1)))

    @torch.no_grad()
    def _prototype_row(self, row: Mapping[str, float]) -> dict[str, float]:
        count = num_prototypes(self.loss)
        if count is None:
            return {}
        extra = {"ln_num_prototypes": math.log(count)}
        if "assignment_entropy" in row and count > 1:
            extra["assignment_entropy_frac"] = row["assignment_entropy"] / math.log(count)
        if count >= 4:
            offset = float(getattr(self.loss, "offset", 1.5))
            measured = prototype_metrics(self.loss.prototypes.weight.detach(), offset=offset)
            extra.update({name: float(value) for name, value in measured.items()})
        return extra


def num_prototypes(loss: LossModule) -> int | None:
    """Number of prototypes of a loss, or ``None`` if it has none."""
    weight = getattr(getattr(loss, "prototypes", None), "weight", None)
    return weight.shape[0] if isinstance(weight, Tensor) else None


def cosine_threshold(loss: LossModule) -> float:
    """Cosine above which embeddings count as collapsed.

    Raw convolutional features are non-negative and share the background, so healthy ones come close to 1;
    latents do not.
    """
    has_latents = isinstance(getattr(loss, "projector", None), nn.Module)
    return LATENTS_THRESHOLD if has_latents else RAW_FEATURES_THRESHOLD


def memory_row(device: torch.device) -> dict[str, int]:
    """Memory in bytes: resident on the host, and the peak on a GPU."""
    row = {"resident_bytes": psutil.Process().memory_info().rss}
    if device.type == "cuda":
        row["device_peak_bytes"] = torch.cuda.max_memory_allocated(device)
    return row
