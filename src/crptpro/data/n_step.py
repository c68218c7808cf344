"""Windows of n transitions of one episode: drawing them from a ring, and what a learner makes of one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torchrl.data import RandomSampler

from crptpro.errors import DatasetError

if TYPE_CHECKING:
    from crptpro.data.ring_storage import RingStorage

# Redraws before the admissible anchors are listed, which costs 50 times a redraw for 100,000 transitions. With
# episodes of 500 transitions two draws nearly always suffice; only rings of very short episodes get that far.
_REDRAWS = 8


@dataclass(frozen=True)
class Reading:
    """What a sample is made of.

    Attributes:
        pixels: Read the frames.
        n_step: n, transitions from an observation to its successor.
        discount: gamma; None leaves ``("next", "discount")`` out, which only ``n_step`` 1 allows.
    """

    pixels: bool = True
    n_step: int = 1
    discount: float | None = None


def n_step_return(rewards: Tensor, terminated: Tensor, discount: float) -> tuple[Tensor, Tensor]:
    r"""Discounted return of windows, and the discount of the value that follows (url_benchmark, replay_buffer.py).

    .. math::
        R = \sum_{i=0}^{n-1} \gamma^i \Big(\prod_{j<i} d_j\Big) r_i, \qquad
        D = \gamma^n \prod_{j=0}^{n-1} d_j

    with the environment's discount :math:`d_j = 0` where transition j terminated and 1 elsewhere.

    Args:
        rewards: ``[B, n, 1]``.
        terminated: bool ``[B, n, 1]``; a truncation is none.
        discount: gamma, in [0, 1].

    Returns:
        R and D, each ``[B, 1]``.
    """
    total, factor = torch.zeros_like(rewards[:, 0]), torch.ones_like(rewards[:, 0])
    for reward, ended in zip(rewards.unbind(1), terminated.unbind(1)):
        total = total + factor * reward
        factor = factor * (discount * (~ended).to(factor))
    return total, factor


class WindowSampler(RandomSampler):
    """Draws uniformly, with replacement, from the transitions whose window of n lies in one episode.

    For windows of 1 it is its base class, draw for draw. For longer ones a draw that does not fit is made again,
    so that the cost does not grow with the ring.
    """

    def sample(self, storage: RingStorage, batch_size: int) -> tuple[Tensor, dict]:
        """Return indices ``[B]``, and no further information.

        Raises:
            DatasetError: no window fits.
            RuntimeError: there is no transition.
        """
        n_step = storage.reading.n_step
        count = len(storage) - n_step + 1
        if n_step == 1 or len(storage) == 0:
            return super().sample(storage, batch_size)
        if count < 1:
            raise DatasetError(_NO_WINDOW.format(n=n_step, count=len(storage)))

        def draw(among: int, number: int) -> Tensor:
            return torch.randint(among, (number,), generator=self._rng)

        index = draw(count, batch_size)
        for _ in range(_REDRAWS):
            misfits = (~storage.has_window(index, n_step)).nonzero().squeeze(-1)
            if not len(misfits):
                return index, {}
            index[misfits] = draw(count, len(misfits))
        every = torch.arange(count)
        admissible = every[storage.has_window(every, n_step)]
        if not len(admissible):
            raise DatasetError(_NO_WINDOW.format(n=n_step, count=len(storage)))
        misfits = (~storage.has_window(index, n_step)).nonzero().squeeze(-1)
        index[misfits] = admissible[draw(len(admissible), len(misfits))]
        return index, {}


_NO_WINDOW = (
    "None of the replay's {count} transitions is followed by enough of its own episode for n_step={n}: use a "
    "smaller n_step, or let more be stored before the first update (random_agent_steps)."
)
