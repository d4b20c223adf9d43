"""Stages of a training run as data: what each one changes, and what it waits for.

A policy that learns everything at once learns nothing: over the whole command space the gradient is nearly all noise.
Each stage draws few kinds of command, with as much exploration noise as what it teaches can bear.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from lowlevel.commands import PROTOCOL, Mixture
from lowlevel.environment import EnvironmentConfig
from lowlevel.gait_prior import GaitPriorConfig
from lowlevel.rewards import RewardWeights
from lowlevel.world.randomization import RandomizationConfig
from lowlevel.world.terrain import TerrainConfig


@dataclass(frozen=True)
class Stage:
    """One part of a run. It ends when its figure is reached, after ``least_steps`` and before ``most_steps``."""

    name: str = "train"
    waits_for: str = ""
    """Logged figure that ends the stage; "" for none."""
    above: float = 0.0
    """Value that the figure, averaged over some 10 updates, must exceed."""
    least_steps: int = 500_000
    """Environment steps that the stage takes at least: the first robots have not had the time to fall."""
    most_steps: int = 1_000_000_000
    """Environment steps after which the next stage begins all the same."""
    std: tuple[float, float] = (0.05, 0.3)
    """Bounds of the exploration noise [action units]."""
    noise_at_rest: float = 1.0
    """Noise of a robot whose gait clock rests, as a share of that of one that walks. Noise at which a robot learns to
    walk fells one that bends deeply, and it learns to bend less."""
    gait_frequency: float = 2.0
    """Steps of one foot per second [Hz]."""
    prior: GaitPriorConfig | None = None
    """What a gait prior adds to the policy's targets. When a stage without one follows, the policy absorbs it first."""
    calibrates: bool = False
    """Whether the stage begins with a calibration of the told velocity (:mod:`lowlevel.imitation.calibration`)."""
    gait_noise: float = 0.8
    """Share of the exploration noise's variance that is a pattern over the gait clock, and constant at a stand: for a
    robot that improves its gait. One that learns to balance does it in white noise."""
    normalizes_by_kind: bool = True
    """Whether advantages are normalized within each kind of command: for kinds that are learned beside some that are
    mastered already. As long as most robots fall when they walk, that is what is to be learned."""
    rollout_doublings: int = 0
    """Rollouts are 2 to this power times as long as at first: the better the policy, the more samples it takes to see
    what would improve it."""
    arms_act: bool = False
    """Whether the policy corrects the arms: fourteen more noisy outputs that share every update's KL divergence."""
    mixture: Mixture = PROTOCOL
    """Kinds of command and their shares."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    rewards: RewardWeights = field(default_factory=RewardWeights)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    harder: RandomizationConfig | None = None
    """What ``randomization`` becomes as far as falls allow (:attr:`lowlevel.curriculum.Curriculum.hardness`), if
    anything."""

    def environment(self, base: EnvironmentConfig) -> EnvironmentConfig:
        """The task in this stage."""
        return replace(
            base,
            reference=replace(base.reference, gait_frequency=self.gait_frequency),
            prior=self.prior,
            arms_act=self.arms_act,
            mixture=self.mixture,
            terrain=self.terrain,
            rewards=self.rewards,
            randomization=self.randomization,
        )
