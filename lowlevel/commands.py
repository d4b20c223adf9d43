"""The whole-body command: 21 numbers, their bounds, and how training samples them (paper III-B-5, Eq. 2-3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, JOINT_NAMES
from robots.g1.mirror import ARMS_MIRROR, Mirror, concatenate, signs

VELOCITY = slice(0, 3)
"""vx, vy [m/s] and yaw rate [rad/s] in the heading frame (the yaw-only frame of the pelvis)."""
HEIGHT = 3
"""Pelvis height [m] above the ground under the lowest foot."""
TORSO = slice(4, 7)
"""Roll, pitch, yaw [rad] of ``torso_link`` relative to the heading frame."""
POSTURE = slice(3, 7)
"""Height and torso attitude together: the coordinates of the nominal-pose table."""
ARMS = slice(7, 21)
"""14 arm joint targets [rad]."""
COMMAND_SIZE = 21

MIRROR: Mirror = concatenate(signs(1, -1, -1), signs(1, -1, 1, -1), ARMS_MIRROR)

STANDING_SPEED = 0.1
"""Velocity commands shorter than this (norm of vx, vy, yaw rate) mean: stand still."""


@dataclass(frozen=True)
class CommandSpace:
    """Names, units and bounds of the command; the only place that knows them."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def bounds(self, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
        """Lower and upper bounds, each (21,)."""
        return torch.tensor(self.lower, device=device), torch.tensor(self.upper, device=device)

    def neutral(self, device: torch.device | str = "cpu") -> Tensor:
        """Stand upright at full height with the arms at the default pose (21,)."""
        command = torch.zeros(COMMAND_SIZE, device=device)
        command[HEIGHT] = self.upper[HEIGHT]
        command[ARMS] = torch.tensor(DEFAULT_POSITION[ARM_JOINTS], dtype=torch.float32, device=device)
        return command


def command_space(joint_lower: list[float], joint_upper: list[float]) -> CommandSpace:
    """The command space for a robot with these joint limits (29,) [rad].

    Posture ranges are the paper's (IV-A); velocity ranges are HOMIE's, as the paper gives none.
    """
    arms = JOINT_NAMES[ARM_JOINTS]
    return CommandSpace(
        names=("vx", "vy", "yaw_rate", "base_height", "torso_roll", "torso_pitch", "torso_yaw", *arms),
        units=("m/s", "m/s", "rad/s", "m", "rad", "rad", "rad", *("rad",) * len(arms)),
        lower=(-0.8, -0.5, -0.8, 0.30, -0.4, -0.3, -1.5, *joint_lower[ARM_JOINTS]),
        upper=(1.2, 0.5, 0.8, 0.76, 0.4, 1.5, 1.5, *joint_upper[ARM_JOINTS]),
    )


@dataclass(frozen=True)
class CommandMixture:
    """Shares of the command groups and their ranges; the defaults are those of the evaluation protocol."""

    walk_and_work: float = 0.4
    """Share of commands that walk with a posture and moving arms (I = 1)."""
    stand_and_work: float = 0.4
    """Share of commands that stand still with the full posture range and moving arms (I = 1)."""
    stand: float = 0.0
    """Share of commands that stand still in the neutral posture (I = 0); what is left walks in it (I = 0)."""
    slow: float = 0.0
    """Share of the walking commands whose velocity is scaled down by ``slow_scale``: a planner walks slowly."""
    slow_scale: float = 0.35
    """Factor on the velocity of slow commands."""
    walking_min_height: float = 0.55
    """Lowest base height while walking [m]."""
    walking_max_roll: float = 0.2
    """Largest torso roll while walking [rad]."""
    walking_pitch: tuple[float, float] = (-0.2, 0.5)
    """Torso pitch range while walking [rad]."""
    walking_max_yaw: float = 0.5
    """Largest torso yaw while walking [rad]."""


@dataclass(frozen=True)
class CommandRange:
    """How much of the command space is open, each factor in [0, 1] (set by the curriculum)."""

    velocity: float = 1.0
    height: float = 1.0
    torso: float = 1.0
    arms: float = 1.0


class CommandSampler:
    """Draws commands of the mixture, restricted to the open part of the ranges."""

    def __init__(self, space: CommandSpace, mixture: CommandMixture, device: torch.device | str = "cpu") -> None:
        self.space = space
        self.mixture = mixture
        self.lower, self.upper = space.bounds(device)
        self.neutral = space.neutral(device)

    def sample(self, count: int, open_range: CommandRange, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw ``count`` commands.

        Returns:
            command (count, 21) and tracking flag I (count, 1); not yet clamped to the feasible region.
        """
        mixture = self.mixture

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=self.lower.device)

        group = uniform(count)
        working = mixture.walk_and_work + mixture.stand_and_work
        walks = (group < mixture.walk_and_work) | (group >= working + mixture.stand)
        works = group < working
        command = self.neutral.repeat(count, 1)

        velocity = self.lower[VELOCITY] + uniform(count, 3) * (self.upper[VELOCITY] - self.lower[VELOCITY])
        if mixture.slow > 0.0:
            velocity = torch.where(uniform(count, 1) < mixture.slow, mixture.slow_scale * velocity, velocity)
        command[:, VELOCITY] = open_range.velocity * velocity * walks[:, None]

        lowest = torch.where(walks, mixture.walking_min_height, self.lower[HEIGHT].item())
        highest = self.upper[HEIGHT]
        command[:, HEIGHT] = highest - open_range.height * (highest - lowest) * uniform(count)

        walking = torch.tensor(
            [
                [-mixture.walking_max_roll, mixture.walking_pitch[0], -mixture.walking_max_yaw],
                [mixture.walking_max_roll, mixture.walking_pitch[1], mixture.walking_max_yaw],
            ],
            device=self.lower.device,
        )
        low = torch.where(walks[:, None], walking[0], self.lower[TORSO])
        high = torch.where(walks[:, None], walking[1], self.upper[TORSO])
        command[:, TORSO] = open_range.torso * (low + uniform(count, 3) * (high - low))

        command[:, ARMS] = self._sample_arms(count, open_range.arms, generator)
        command[:, HEIGHT : ARMS.stop] = torch.where(
            works[:, None], command[:, HEIGHT : ARMS.stop], self.neutral[HEIGHT : ARMS.stop]
        )
        stands = command[:, VELOCITY].norm(dim=-1) < STANDING_SPEED
        command[stands, VELOCITY] = 0.0
        return command, works[:, None].float()

    def _sample_arms(self, count: int, openness: float, generator: torch.Generator) -> Tensor:
        """Equations 2 and 3: exponentially distributed radius, random direction, per joint (count, 14)."""
        shape = (count, ARMS.stop - ARMS.start)
        device = self.lower.device
        rate = 20.0 * (1.0 - 0.99 * openness)
        uniform = torch.rand(shape, generator=generator, device=device)
        radius = -torch.log1p(-uniform * (1.0 - torch.exp(torch.tensor(-rate)))) / rate
        distance = torch.rand(shape, generator=generator, device=device) * radius
        towards_upper = torch.randn(shape, generator=generator, device=device) > 0
        bound = torch.where(towards_upper, self.upper[ARMS], self.lower[ARMS])
        return self.neutral[ARMS] + (bound - self.neutral[ARMS]) * distance


def is_walking(command: Tensor) -> Tensor:
    """Whether ``command`` (..., 21) asks for locomotion (...,)."""
    return command[..., VELOCITY].norm(dim=-1) >= STANDING_SPEED
