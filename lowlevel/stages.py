"""Stages of a training run as data: what each one changes, and what it waits for.

A policy that learns everything at once learns nothing: over the whole command space the gradient is nearly all noise.
Each stage draws few kinds of command, with as much exploration noise as what it teaches can bear.
"""

from __future__ import annotations

from dataclasses import dataclass

from lowlevel.task import TaskConfig
from lowlevel.world.randomization import RandomizationConfig


@dataclass(frozen=True)
class Stage(TaskConfig):
    """One part of a run: a task, and how it is learned.

    It ends when its figure is reached, after ``least_steps`` and before ``most_steps``. One without the gait prior of
    the stage before it begins with the policy absorbing that.
    """

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
    calibrates: bool = False
    """Whether the stage begins with a calibration of the told velocity and of the balance under loads
    (:mod:`lowlevel.imitation.calibration`)."""
    gait_noise: float = 0.8
    """Share of the exploration noise's variance that is a pattern over the gait clock, and constant at a stand: for a
    robot that improves its gait. One that learns to balance does it in white noise."""
    normalizes_by_kind: bool = True
    """Whether advantages are normalized within each kind of command: for kinds that are learned beside some that are
    mastered already. As long as most robots fall when they walk, that is what is to be learned."""
    advantage_limit: float = 2.0
    """Normalized advantages are clipped to +- this: half a percent of the samples, of robots that fall, would else
    outweigh all others, as they should where falls are what is to be unlearned."""
    rollout_doublings: int = 0
    """Rollouts are 2 to this power times as long as at first: the better the policy, the more samples it takes to see
    what would improve it."""
    harder: RandomizationConfig | None = None
    """What ``randomization`` becomes as far as falls allow (:attr:`lowlevel.curriculum.Curriculum.hardness`), if
    anything."""
