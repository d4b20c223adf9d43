"""Command curriculum (paper III-B-5): every kind of command opens as far as it is tracked, and is drawn by its error.

The paper opens its ranges one after the other. Here each kind of command (:data:`lowlevel.commands.KINDS`) has an
opening of its own, and kinds that are tracked badly are drawn more often, down to a floor for all others.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.commands import KINDS
from lowlevel.runs.distributed import sum_over_ranks

QUALITY_TERMS = ("linear_velocity", "angular_velocity", "base_height", "torso_orientation")
"""Reward terms in [0, 1] whose mean is the quality of tracking."""

FIRST_FALL_RATE = 0.05
"""What is assumed of a kind before it was seen [falls per control step]."""


@dataclass(frozen=True)
class CurriculumConfig:
    """How kinds open and how often they are drawn."""

    start: float = 0.3
    """Opening of every kind at the start; not zero, so that no input is constant."""
    growth: float = 0.006
    """Growth of an opening per update."""
    quality: float = 0.45
    """Quality of tracking above which a kind may grow, under the noise of exploration."""
    steps_between_falls: float = 300.0
    """Control steps of a kind per fall above which it may grow; below half as many it shrinks. Where every robot falls
    no action is better than another, and nothing is learned."""
    hard_steps_between_falls: float = 2500.0
    """Control steps per fall, of all kinds together, above which the conditions get harder; below half as many they
    ease. At a fall every 600 steps the robots learn not to fall and track no better."""
    smoothing: float = 0.1
    """Weight of the last update in the measured averages."""
    most_often: float = 2.0
    """Largest factor by which its error makes a kind more frequent than its share, or less."""


class Curriculum:
    """Measured tracking of each kind, and what follows from it. Tensors have one entry per kind."""

    def __init__(self, config: CurriculumConfig) -> None:
        self.config = config
        count = len(KINDS)
        self.opening = torch.full((count,), config.start)
        self.quality = torch.zeros(count)
        self.fall_rate = torch.full((count,), FIRST_FALL_RATE)
        """Falls per control step."""
        self.hardness = torch.zeros(())
        """How hard the conditions are, in [0, 1], in stages that make them harder."""
        self._sums = torch.zeros(3, count)

    def observe(self, kind: Tensor, terms: dict[str, Tensor], fallen: Tensor) -> None:
        """Count one step of N robots: their ``kind`` (N,), unweighted reward ``terms`` and falls (N,)."""
        quality = torch.stack([terms[name] for name in QUALITY_TERMS]).mean(dim=0)
        for row, values in zip(self._sums, (torch.ones_like(quality), quality, fallen.float()), strict=True):
            row.index_add_(0, kind.cpu(), values.cpu())

    def introduce(self, kinds: Tensor) -> None:
        """Open ``kinds`` (kinds,) bool anew, as at the start: robots that were not told them forget them."""
        self.opening[kinds] = self.config.start
        self.quality[kinds] = 0.0
        self.fall_rate[kinds] = FIRST_FALL_RATE

    def update(self, hardens: bool = False) -> None:
        """Take in what was observed since the last update, over all ranks, and open what is tracked.

        The hardness moves only if the stage ``hardens``.
        """
        config = self.config
        steps, quality, falls = sum_over_ranks(self._sums)
        seen = steps > 0
        weight = config.smoothing * seen
        self.quality += weight * (quality / steps.clamp_min(1.0) - self.quality)
        self.fall_rate += weight * (falls / steps.clamp_min(1.0) - self.fall_rate)
        falls_per_budget = self.fall_rate * config.steps_between_falls
        grows, shrinks = (falls_per_budget < 1.0).float(), (falls_per_budget > 2.0).float()
        change = config.growth * (grows * (self.quality > config.quality) - shrinks) * seen
        self.opening = (self.opening + change).clamp(config.start, 1.0)
        if hardens:
            falls_per_budget = (self.fall_rate * steps).sum() / steps.sum() * config.hard_steps_between_falls
            change = config.growth * ((falls_per_budget < 1.0).float() - (falls_per_budget > 2.0).float())
            self.hardness = (self.hardness + change).clamp(0.0, 1.0)
        self._sums = torch.zeros_like(self._sums)

    def probabilities(self, shares: Tensor) -> Tensor:
        """Chance of each kind: its share (kinds,), more often where tracking lacks more."""
        lack = (1.0 - self.quality).clamp_min(0.05)
        mean = (shares * lack).sum()
        factor = (lack / mean).clamp(1.0 / self.config.most_often, self.config.most_often)
        return shares * factor / (shares * factor).sum()

    def figures(self, shares: Tensor) -> dict[str, float]:
        """Hardness, and openings, qualities and falls of the kinds that are drawn, by name."""
        result = {"hardness": float(self.hardness)}
        for number, name in enumerate(KINDS):
            if shares[number] > 0.0:
                result[f"opening/{name}"] = float(self.opening[number])
                result[f"quality/{name}"] = float(self.quality[number])
                result[f"steps_between_falls/{name}"] = float(1.0 / self.fall_rate[number].clamp_min(1e-6))
        return result

    def state_dict(self) -> dict[str, Tensor]:
        names = ("opening", "quality", "fall_rate", "hardness")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        for name in self.state_dict():
            setattr(self, name, state[name].clone())
