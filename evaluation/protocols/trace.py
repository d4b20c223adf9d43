"""Traces: quantities of many episodes over time, from which figures are computed by array reductions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from evaluation.protocols.arena import Arena, Episode, Moment


@dataclass(frozen=True)
class Channel:
    """A quantity of every robot at every moment."""

    read: Callable[[Moment], Tensor]
    """Gives (N, *shape)."""
    shape: tuple[int, ...] = ()


@dataclass(frozen=True)
class Trace:
    """E equally long episodes, T control steps."""

    period: float
    """[s]"""
    channels: dict[str, np.ndarray]
    """Name -> (E, T, *shape); NaN where a robot is down."""
    fell: np.ndarray
    """Falls (E, T)."""
    failed: np.ndarray
    """Targets that were not finite (E, T)."""

    @property
    def has_fallen(self) -> np.ndarray:
        """Episodes with a fall, or with targets that were not finite (E,)."""
        return np.asarray((self.fell | self.failed).any(axis=1))

    def __getitem__(self, name: str) -> np.ndarray:
        """The channel called ``name``."""
        return self.channels[name]

    def steps(self, begin: float, end: float) -> slice:
        """The control steps that end after ``begin`` and not after ``end`` [s]."""
        return slice(round(begin / self.period), round(end / self.period))


def record(
    arena: Arena,
    episodes: Sequence[Episode],
    channels: Mapping[str, Channel],
    advance: Callable[[int], None] = lambda steps: None,
) -> Trace:
    """Run ``episodes``, all of the same duration, a batch at a time, and keep ``channels`` of them.

    ``advance`` is told how many control steps of a batch have passed, for a progress bar.
    """
    count, length = len(episodes), round(episodes[0].duration / arena.period)
    arrays = {name: np.full((count, length, *channel.shape), np.nan, np.float32) for name, channel in channels.items()}
    fell, failed = np.zeros((2, count, length), dtype=bool)
    for first in range(0, count, arena.batch):
        batch, steps = episodes[first : first + arena.batch], 0
        for moment in arena.run(batch):
            (rows,) = moment.active[: len(batch)].numpy().nonzero()
            for name, channel in channels.items():
                arrays[name][first + rows, moment.step] = channel.read(moment).numpy()[rows]
            fell[first + rows, moment.step] = moment.fell.numpy()[rows]
            failed[first + rows, moment.step] = moment.failed.numpy()[rows]
            steps += 1
            advance(1)
        advance(length - steps)
    return Trace(arena.period, arrays, fell, failed)


def time_mean(values: np.ndarray, axis: int = 1) -> np.ndarray:
    """Mean over ``axis``, leaving out NaN; NaN where there is nothing else."""
    counts = (~np.isnan(values)).sum(axis=axis)
    with np.errstate(invalid="ignore"):
        return np.nansum(values, axis=axis, dtype=float) / counts
