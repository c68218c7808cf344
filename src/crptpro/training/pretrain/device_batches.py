"""Batches drawn, gathered and shifted where the frames are, without a word to the host."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import RandomSampler

from crptpro.data import FrameDataset
from crptpro.data.frame_stacks import stack_rows
from crptpro.seeding import derive_seed
from crptpro.training.captured import CapturedCall
from crptpro.training.compiled import Compiled
from crptpro.transforms.random_shift import draw_offsets

#: How many rows behind a transition's own the newest frame of an observation lies.
_AHEAD: dict[NestedKey, int] = {"pixels": 0, ("next", "pixels"): 1}


class DeviceBatches:
    """The pre-training batches of datasets whose frames a GPU holds.

    Transitions and shifts are drawn by one generator per dataset on the device, and the pixels of both observations
    are copied from the frames in one pass, shifted on the way. Everything is written into one tensordict,
    :attr:`batch`, which a recorded update reads in place. The samples have the distribution of
    :meth:`crptpro.data.FrameDataset.sample` followed by :func:`crptpro.transforms.random_shift.random_shift`.

    Args:
        datasets: by domain, in cyclic order; all on one device. See :meth:`fits`.
        batch_size: transitions per batch.
        keys: entries that the loss reads, ``"pixels"`` and ``("next", "pixels")`` or views of them among them.
        views: second, independently shifted views of an observation, by their keys.
        pad: width of the random shift; 0 for none.
        seed: seeds the generators.
        compiled: whether the gathering is compiled, into one kernel per observation.
        captures: whether it is recorded as a CUDA graph, one per dataset.
    """

    def __init__(
        self,
        datasets: Mapping[str, FrameDataset],
        *,
        batch_size: int,
        keys: Sequence[NestedKey],
        views: Mapping[NestedKey, NestedKey] | None = None,
        pad: int = 4,
        seed: int = 0,
        compiled: Compiled | None = None,
        captures: bool = False,
    ) -> None:
        self.datasets = dict(datasets)
        self.batch_size, self.pad = batch_size, pad
        first = next(iter(self.datasets.values()))
        frames = first.frames.get("pixels")
        self.device = frames.device
        views = views or {}
        self.observations = {key: views.get(key, key) for key in keys if views.get(key, key) in _AHEAD}
        self.columns = [key for key in keys if key not in self.observations]
        self.generators = {
            name: torch.Generator(self.device).manual_seed(derive_seed(seed, "pretrain", "device", name))
            for name in self.datasets
        }
        self.batch = TensorDict({}, [batch_size], device=self.device)
        channels, *size = frames.shape[1:]
        for key in self.observations:
            shape = (batch_size, first.frame_stack * channels, *size)
            self.batch.set(key, torch.zeros(shape, dtype=frames.dtype, device=self.device))
        for key in self.columns:
            self.batch.set(
                key, first.transitions.get(key)[:1].expand(batch_size, *_shape(first, key)).clone()
            )
        self.draws = TensorDict({}, [batch_size], device=self.device)
        self.draws.set("index", torch.zeros(batch_size, dtype=torch.int64, device=self.device))
        for number in range(len(self.observations)):
            offsets = torch.zeros(batch_size, 2, dtype=torch.int64, device=self.device)
            self.draws.set(f"offsets_{number}", offsets)
        self.compiled = compiled or Compiled(is_on=False)
        self._gather = self.compiled.wrap(gather_shifted_)
        self._fill = {
            name: CapturedCall(self._filler(dataset), inputs=self.draws)
            if captures
            else self._filler(dataset)
            for name, dataset in self.datasets.items()
        }

    @staticmethod
    def fits(
        datasets: Mapping[str, Any],
        keys: Sequence[NestedKey] | None,
        views: Mapping[NestedKey, NestedKey] | None = None,
    ) -> bool:
        """Whether datasets can be sampled like this: ours, read as they are, on one device, with all the keys."""
        views = views or {}
        if keys is None or not any(views.get(key, key) in _AHEAD for key in keys):
            return False
        shapes = set()
        for dataset in datasets.values():
            if type(dataset) is not FrameDataset or not dataset.is_read_directly:
                return False
            if type(dataset.sampler) is not RandomSampler:
                return False
            held = {*dataset.transitions.keys(True, True), *_AHEAD}
            if any(views.get(key, key) not in held for key in keys):
                return False
            frames = dataset.frames.get("pixels")
            columns = [_shape(dataset, key) for key in keys if views.get(key, key) not in _AHEAD]
            shapes.add((frames.device, frames.shape[1:], dataset.frame_stack, *columns))
        return len(shapes) == 1

    def sample(self, domain: str) -> TensorDictBase:
        """Draw the next batch of a domain into :attr:`batch` and return that; valid until the next call."""
        self._draw(domain)
        self.compiled.attempt(lambda: self._fill[domain](self.draws))
        return self.batch

    def state_dict(self) -> dict[str, Any]:
        """Return the generators' states."""
        return {name: generator.get_state() for name, generator in self.generators.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        for name, generator in self.generators.items():
            generator.set_state(state[name])

    def _draw(self, domain: str) -> None:
        """Draw which transitions, and the shift of every observation; outside of any recording."""
        generator, count = self.generators[domain], len(self.datasets[domain])
        index = torch.randint(0, count, (self.batch_size,), generator=generator, device=self.device)
        self.draws.get("index").copy_(index)
        for number in range(len(self.observations)):
            offsets = draw_offsets(self.batch_size, self.pad, generator, self.device)
            self.draws.get(f"offsets_{number}").copy_(offsets)

    def _filler(self, dataset: FrameDataset) -> Any:
        frames, transitions = dataset.frames.get("pixels"), dataset.transitions
        row, step, stack = transitions.get("row"), transitions.get("step"), dataset.frame_stack

        def fill(draws: TensorDictBase) -> dict[str, Tensor]:
            index = draws.get("index")
            for number, (key, original) in enumerate(self.observations.items()):
                ahead = _AHEAD[original]
                rows = stack_rows(row[index] + ahead, step[index] + ahead, stack)
                self._gather(self.batch.get(key), frames, rows, draws.get(f"offsets_{number}"), self.pad)
            for key in self.columns:
                self.batch.get(key).copy_(transitions.get(key)[index])
            return {}

        return fill


def gather_shifted_(stacks: Tensor, frames: Tensor, rows: Tensor, offsets: Tensor, pad: int) -> None:
    """Write stacks of frames, each shifted by its own offset with the border repeated, in one pass.

    What :func:`crptpro.transforms.random_shift.shifted_stacks` returns, as one gather without a look at the values.

    Args:
        stacks: ``[B, k * C, H, W]``, written.
        frames: ``[F, C, H, W]``, single frames.
        rows: int64 ``[B, k]``, the frames of each stack, oldest to newest.
        offsets: int64 ``[B, 2]``, (row, column) in ``{0, ..., 2 * pad}``.
        pad: width of the repeated border.
    """
    channels, height, width = frames.shape[1:]
    device = frames.device
    y = (torch.arange(height, device=device) + (offsets[:, :1] - pad)).clamp(0, height - 1)
    x = (torch.arange(width, device=device) + (offsets[:, 1:] - pad)).clamp(0, width - 1)
    plane = torch.arange(channels, device=device)
    images = frames[
        rows[:, :, None, None, None],
        plane[:, None, None],
        y[:, None, None, :, None],
        x[:, None, None, None, :],
    ]  # (B, k, C, H, W)
    stacks.copy_(images.reshape(stacks.shape))


def _shape(dataset: FrameDataset, key: NestedKey) -> torch.Size:
    return dataset.transitions.get(key).shape[1:]
