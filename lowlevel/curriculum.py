"""Command curriculum (paper III-B-5): every kind of command opens as far as it is tracked, and is drawn by its error.

The paper opens its ranges one after the other. Here each kind of command (:data:`lowlevel.commands.KINDS`) has an
opening of its own, and kinds that are tracked badly are drawn more often, down to a floor for all others. So are kinds
of tile (:data:`lowlevel.world.terrain.TILES`), whose levels robots climb by themselves (:mod:`lowlevel.world.levels`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.commands import KINDS
from lowlevel.runs.distributed import sum_over_ranks
from lowlevel.world.terrain import TILES

FIRST_FALL_RATE = 0.05
"""What is assumed of a kind before it was seen [falls per control step]."""


@dataclass(frozen=True)
class CurriculumConfig:
    """How kinds open and how often they are drawn."""

    start: float = 0.3
    """Opening of every kind at the start; not zero, so that no input is constant."""
    growth: float = 0.006
    """Growth of an opening per update."""
    quality: float = 0.35
    """Quality of tracking (:func:`lowlevel.rewards.tracking_quality`) above which a kind may grow, under the noise of
    exploration."""
    steps_between_falls: float = 300.0
    """Control steps of a kind per fall above which it may grow; below half as many it shrinks. Where every robot falls
    no action is better than another, and nothing is learned."""
    hard_steps_between_falls: float = 2000.0
    """Control steps per fall, of all kinds together, above which the conditions get harder; below half as many they
    ease. At a fall every 600 steps the robots learn not to fall and track no better."""
    smoothing: float = 0.1
    """Weight of the last update in the measured averages."""
    most_often: float = 2.0
    """Largest factor by which its error makes a kind more frequent than its share, or less."""


class Tally:
    """How well each of several classes of control steps is tracked, and how often robots fall in it.

    Tensors have one entry per class.
    """

    def __init__(self, classes: int) -> None:
        self.quality = torch.zeros(classes)
        self.fall_rate = torch.full((classes,), FIRST_FALL_RATE)
        """Falls per control step."""
        self._sums = torch.zeros(3, classes)

    def observe(self, number: Tensor, quality: Tensor, fallen: Tensor) -> None:
        """Count one step of N robots: its class (N,), its quality (N,), and whether the robot fell (N,)."""
        for row, values in zip(self._sums, (torch.ones_like(quality), quality, fallen.float()), strict=True):
            row.index_add_(0, number.cpu(), values.cpu())

    def forget(self, classes: Tensor) -> None:
        """Begin anew with ``classes`` (classes,) bool."""
        self.quality[classes] = 0.0
        self.fall_rate[classes] = FIRST_FALL_RATE

    def update(self, smoothing: float) -> Tensor:
        """Take in what was observed since the last update, over all ranks; returns the steps of each class."""
        steps, quality, falls = sum_over_ranks(self._sums)
        weight = smoothing * (steps > 0)
        self.quality += weight * (quality / steps.clamp_min(1.0) - self.quality)
        self.fall_rate += weight * (falls / steps.clamp_min(1.0) - self.fall_rate)
        self._sums = torch.zeros_like(self._sums)
        return steps

    def chances(self, shares: Tensor, most_often: float) -> Tensor:
        """Chance of each class: its share, times a factor of at most ``most_often`` where tracking lacks more."""
        lack = (1.0 - self.quality).clamp_min(0.05)
        factor = (lack / (shares * lack).sum()).clamp(1.0 / most_often, most_often)
        return shares * factor / (shares * factor).sum()

    def figures(self, names: Iterable[str], shares: Tensor) -> dict[str, float]:
        """Quality and control steps between falls of the classes that are drawn, by name."""
        result = {}
        for number, name in enumerate(names):
            if shares[number] > 0.0:
                result[f"quality/{name}"] = float(self.quality[number])
                result[f"steps_between_falls/{name}"] = float(1.0 / self.fall_rate[number].clamp_min(1e-6))
        return result


class Curriculum:
    """Measured tracking of each kind of command and of tile, and what follows from it."""

    def __init__(self, config: CurriculumConfig) -> None:
        self.config = config
        self.kinds, self.tiles = Tally(len(KINDS)), Tally(len(TILES))
        self.opening = torch.full((len(KINDS),), config.start)
        """Of each kind of command."""
        self.hardness = torch.zeros(())
        """How hard the conditions are, in [0, 1], in stages that make them harder."""

    def observe(self, kind: Tensor, tile: Tensor, quality: Tensor, fallen: Tensor) -> None:
        """Count one step of N robots: kinds of command and tile, quality of tracking, and who fell, (N,) each."""
        self.kinds.observe(kind, quality, fallen)
        self.tiles.observe(tile, quality, fallen)

    def introduce(self, kinds: Tensor) -> None:
        """Open ``kinds`` (kinds,) bool anew, as at the start: a policy forgets commands that it no longer sees."""
        self.opening[kinds] = self.config.start
        self.kinds.forget(kinds)

    def update(self, hardens: bool = False) -> None:
        """Take in what was observed since the last update, and open what is tracked.

        The hardness moves only if the stage ``hardens``.
        """
        config = self.config
        self.tiles.update(config.smoothing)
        steps = self.kinds.update(config.smoothing)
        falls_per_budget = self.kinds.fall_rate * config.steps_between_falls
        grows, shrinks = (falls_per_budget < 1.0).float(), (falls_per_budget > 2.0).float()
        change = config.growth * (grows * (self.kinds.quality > config.quality) - shrinks) * (steps > 0)
        self.opening = (self.opening + change).clamp(config.start, 1.0)
        if hardens:
            falls_per_budget = (self.kinds.fall_rate * steps).sum() / steps.sum() * config.hard_steps_between_falls
            change = config.growth * ((falls_per_budget < 1.0).float() - (falls_per_budget > 2.0).float())
            self.hardness = (self.hardness + change).clamp(0.0, 1.0)

    def kind_chances(self, shares: Tensor) -> Tensor:
        """Chance of each kind of command: its share (kinds,), more often where tracking lacks more."""
        return self.kinds.chances(shares, self.config.most_often)

    def tile_chances(self, shares: Tensor) -> Tensor:
        """Chance of each kind of tile, alike."""
        return self.tiles.chances(shares, self.config.most_often)

    def figures(self, kind_shares: Tensor, tile_shares: Tensor) -> dict[str, float]:
        """Hardness, and openings, qualities and falls of the kinds that are drawn, by name."""
        falls = (self.kind_chances(kind_shares) * self.kinds.fall_rate).sum().clamp_min(1e-6)
        result = {"hardness": float(self.hardness), "steps_between_falls": float(1.0 / falls)}
        opened = zip(KINDS, self.opening.tolist(), kind_shares.tolist(), strict=True)
        result |= {f"opening/{name}": opening for name, opening, share in opened if share > 0.0}
        return result | self.kinds.figures(KINDS, kind_shares) | self.tiles.figures(TILES, tile_shares)

    def state_dict(self) -> dict[str, Tensor]:
        return {name: getattr(holder, attribute) for name, (holder, attribute) in self._saved.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        for name, (holder, attribute) in self._saved.items():
            setattr(holder, attribute, state[name].clone())

    @property
    def _saved(self) -> dict[str, tuple[object, str]]:
        """Name in a saved state to whose attribute it is."""
        return {
            "opening": (self, "opening"),
            "hardness": (self, "hardness"),
            "quality": (self.kinds, "quality"),
            "fall_rate": (self.kinds, "fall_rate"),
            "tile_quality": (self.tiles, "quality"),
            "tile_fall_rate": (self.tiles, "fall_rate"),
        }
