"""What robots of the low-level environment are to do, under which conditions, and what that earns."""

from __future__ import annotations

from dataclasses import dataclass, field

from lowlevel.commands import PROTOCOL, Mixture
from lowlevel.gait_prior import GaitPriorConfig
from lowlevel.rewards import RewardWeights
from lowlevel.world.randomization import RandomizationConfig
from lowlevel.world.terrain import TerrainConfig


@dataclass(frozen=True)
class TaskConfig:
    """The part of the environment that changes from stage to stage of a training (:mod:`lowlevel.stages`)."""

    mixture: Mixture = PROTOCOL
    """Kinds of command and their shares."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    rewards: RewardWeights = field(default_factory=RewardWeights)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    gait_frequency: float = 2.0
    """Steps of one foot per second [Hz]."""
    prior: GaitPriorConfig | None = None
    """What a gait prior adds to the policy's targets; nothing in everything that is evaluated or deployed."""
    arms_act: bool = False
    """Whether the policy corrects the arms, whose targets are the slewed command otherwise: fourteen more noisy outputs
    that share every update's KL divergence."""
