"""Adaptive command curriculum (paper III-B-5): ranges open in stages, driven by measured tracking."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

from lowlevel.commands import CommandRange


@dataclass(frozen=True)
class Stage:
    """One command group of the curriculum."""

    name: str
    """Field of :class:`CommandRange` that the stage opens."""
    reward: str
    """Reward term whose mean measures the stage's tracking."""
    threshold: float
    """Mean of that (unweighted) term above which the range may grow."""


STAGES: tuple[Stage, ...] = (
    Stage("velocity", "linear_velocity", 0.45),
    Stage("height", "base_height", 0.60),
    Stage("torso", "torso_orientation", 0.45),
    Stage("arms", "upper_body_position", 0.30),
)
"""In the paper's order: locomotion, then height, then torso attitude, then arms."""


@dataclass(frozen=True)
class CurriculumConfig:
    """Where the ranges start and how they grow."""

    start: CommandRange = field(default_factory=lambda: CommandRange(velocity=0.5, height=0.5, torso=0.5, arms=0.1))
    """Opening of each range at the start; small instead of zero, so that no input is constant."""
    growth: float = 0.008
    """Largest growth of a factor per update."""
    required_opening: float = 0.6
    """A stage grows only when the stage before it is open at least this far."""
    survival: float = 0.3
    """Mean episode length, as a share of the longest, below which nothing grows."""


class Curriculum:
    """Holds the opening of every command range and advances it from measured tracking."""

    def __init__(self, config: CurriculumConfig) -> None:
        self.config = config
        self.open_range = config.start

    def update(self, mean_terms: dict[str, float], survival: float) -> None:
        """Advance from the mean reward terms of an iteration and the share of an episode that robots survive."""
        if survival < self.config.survival:
            return
        opening = asdict(self.open_range)
        previous = 1.0
        for stage in STAGES:
            may_grow = previous >= self.config.required_opening
            if may_grow and mean_terms[stage.reward] > stage.threshold:
                opening[stage.name] = min(1.0, opening[stage.name] + self.config.growth)
            previous = opening[stage.name]
        self.open_range = CommandRange(**opening)

    def state_dict(self) -> dict[str, float]:
        return asdict(self.open_range)

    def load_state_dict(self, state: dict[str, float]) -> None:
        self.open_range = CommandRange(**state)
