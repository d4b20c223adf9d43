"""The whole-body command: 21 numbers, their bounds, and how training samples them (paper III-B-5, Eq. 2-3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from robots.errors import PilotError
from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, JOINT_NAMES
from robots.g1.mirror import ARMS_MIRROR, Mirror, concatenate, signs
from robots.g1.nominal_pose import NominalPose

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

    def scaled(self, command: Tensor) -> Tensor:
        """``command`` (N, 21) with each number's bounds at -1 and 1."""
        lower, upper = self.bounds(command.device)
        return (command - 0.5 * (upper + lower)) / (0.5 * (upper - lower))

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
class CommandKind:
    """Ranges that commands of one kind are drawn from; what is not said stays neutral."""

    velocity: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] = ((0.0, 0.0),) * 3
    """Ranges of vx, vy [m/s] and yaw rate [rad/s]."""
    height: tuple[float, float] = (0.76, 0.76)
    """[m]"""
    torso: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] = ((0.0, 0.0),) * 3
    """Ranges of roll, pitch and yaw [rad]."""
    arms: bool = False
    """Whether the arms move; they hang at their default otherwise."""
    left_arm: tuple[tuple[float, float], ...] | None = None
    """Ranges of the left arm's seven joints [rad], whose mirror image the right arm does; None: each of the 14 joints
    by itself, anywhere (Eq. 2-3)."""
    tracks: bool = False
    """The tracking flag I."""
    steering: float = 1.0
    """Chance that vy, and independently the yaw rate, is other than zero."""


_VELOCITY = ((-0.8, 1.2), (-0.5, 0.5), (-0.8, 0.8))
_WALKING_HEIGHT = (0.55, 0.76)
_WALKING_TORSO = ((-0.2, 0.2), (-0.2, 0.5), (-0.5, 0.5))
WALKING_POSTURE = (_WALKING_HEIGHT, *_WALKING_TORSO)
"""Ranges of height [m] and torso roll, pitch, yaw [rad] in which robots walk."""
_TORSO = ((-0.4, 0.4), (-0.3, 1.5), (-1.5, 1.5))
_BEFORE_THE_CHEST = ((-1.6, 0.0), (0.0, 0.5), (-0.3, 0.5), (-0.2, 1.2), (-0.6, 0.6), (-0.4, 0.8), (-0.4, 0.4))

KINDS: dict[str, CommandKind] = {
    "stand": CommandKind(),
    "forward": CommandKind(velocity=((0.4, 1.2), (0.0, 0.0), (0.0, 0.0))),
    "steer": CommandKind(velocity=_VELOCITY, steering=0.5),
    "slow": CommandKind(velocity=((-0.3, 0.4), (-0.2, 0.2), (-0.3, 0.3)), steering=0.5),
    "walk": CommandKind(velocity=_VELOCITY),
    "squat": CommandKind(height=(0.30, 0.76), torso=((0.0, 0.0), (-0.1, 0.9), (0.0, 0.0)), tracks=True),
    "walk_and_work": CommandKind(_VELOCITY, height=_WALKING_HEIGHT, torso=_WALKING_TORSO, arms=True, tracks=True),
    "stand_and_work": CommandKind(height=(0.30, 0.76), torso=_TORSO, arms=True, tracks=True),
    "walk_and_hold": CommandKind(
        _VELOCITY, _WALKING_HEIGHT, _WALKING_TORSO, arms=True, left_arm=_BEFORE_THE_CHEST, tracks=True
    ),
    "stand_and_hold": CommandKind(
        height=(0.30, 0.76), torso=_TORSO, arms=True, left_arm=_BEFORE_THE_CHEST, tracks=True
    ),
}
"""Kinds of command by name. Training draws few at a time: over the whole command space the policy gradient is nearly
all noise. Arms that are drawn one by one seldom both reach forwards, as those of a robot that holds a box do."""

Mixture = tuple[tuple[str, float], ...]
"""Kinds with their shares, which add up to 1."""

PROTOCOL: Mixture = (("walk_and_work", 0.4), ("stand_and_work", 0.4), ("walk", 0.2))
"""The evaluation's mixture."""


class CommandSampler:
    """Draws commands by kind."""

    def __init__(self, space: CommandSpace, device: torch.device | str = "cpu") -> None:
        self.space = space
        self.lower, self.upper = space.bounds(device)
        self.neutral = space.neutral(device)

        def column(read: Callable[[CommandKind], object]) -> Tensor:
            return torch.tensor([read(kind) for kind in KINDS.values()], dtype=torch.float32, device=device)

        boxes = column(lambda kind: (*kind.velocity, kind.height, *kind.torso))
        self._low, self._high = boxes.unbind(-1)
        self._arms, self._tracks = column(lambda kind: kind.arms), column(lambda kind: kind.tracks)
        self._holds = column(lambda kind: kind.left_arm is not None) > 0.0
        nowhere = ((0.0, 0.0),) * len(_BEFORE_THE_CHEST)
        self._left_low, self._left_high = column(lambda kind: kind.left_arm or nowhere).unbind(-1)
        self._right_sign = torch.tensor(ARMS_MIRROR.sign[len(nowhere) :], dtype=torch.float32, device=device)
        self._steering = column(lambda kind: kind.steering)

    def draw_kinds(self, count: int, probabilities: Tensor, generator: torch.Generator) -> Tensor:
        """Numbers of ``count`` kinds (count,), drawn with ``probabilities`` (kinds,)."""
        return torch.multinomial(probabilities, count, replacement=True, generator=generator)

    def sample(self, kinds: Tensor, opening: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw one command of each of ``kinds`` (n,).

        ``opening`` (kinds,) in [0, 1]: the share of the way from the neutral command that each kind may go.

        Returns:
            command (n, 21) and tracking flag I (n, 1); not yet clamped to the feasible region.
        """
        count, open_to = len(kinds), opening[kinds, None]

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=self.lower.device)

        low, high = self._low[kinds], self._high[kinds]
        wanted = low + uniform(count, ARMS.start) * (high - low)
        wanted[:, 1:3] *= uniform(count, 2) < self._steering[kinds, None]
        neutral = self.neutral[: ARMS.start]
        arms = self._sample_arms(count, (open_to * self._arms[kinds, None]), generator)
        holds = self._holds[kinds]
        left_low, left_high = self._left_low[kinds[holds]], self._left_high[kinds[holds]]
        left = left_low + uniform(*left_low.shape) * (left_high - left_low)
        both = torch.cat([left, left * self._right_sign], dim=1)
        arms[holds] = self.neutral[ARMS] + open_to[holds] * (both - self.neutral[ARMS])
        command = torch.cat([neutral + open_to * (wanted - neutral), arms], dim=1)
        stands = command[:, VELOCITY].norm(dim=-1) < STANDING_SPEED
        command[stands, VELOCITY] = 0.0
        return command, self._tracks[kinds, None]

    def _sample_arms(self, count: int, openness: Tensor, generator: torch.Generator) -> Tensor:
        """Equations 2 and 3: exponentially distributed radius, random direction, per joint (count, 14).

        ``openness`` (count, 1) is the paper's alpha; 0 leaves the arms at their default.
        """
        shape = (count, ARMS.stop - ARMS.start)
        device = self.lower.device
        rate = 20.0 * (1.0 - 0.99 * openness)
        uniform = torch.rand(shape, generator=generator, device=device)
        radius = -torch.log1p(-uniform * (1.0 - torch.exp(-rate))) / rate
        distance = torch.rand(shape, generator=generator, device=device) * radius * (openness > 0.0)
        towards_upper = torch.randn(shape, generator=generator, device=device) > 0
        bound = torch.where(towards_upper, self.upper[ARMS], self.lower[ARMS])
        return self.neutral[ARMS] + (bound - self.neutral[ARMS]) * distance


def shares(mixture: Mixture, device: torch.device | str = "cpu") -> Tensor:
    """Share of every kind (kinds,) in ``mixture``.

    Raises:
        PilotError: naming a kind that is unknown, or if the shares do not add up to 1.
    """
    total = torch.zeros(len(KINDS), device=device)
    for name, share in mixture:
        if name not in KINDS:
            raise PilotError(f"unknown kind of command {name!r}; choose from {', '.join(KINDS)}")
        total[list(KINDS).index(name)] += share
    if abs(float(total.sum()) - 1.0) > 1e-6:
        raise PilotError(f"the shares of the kinds of command add up to {float(total.sum()):.3f}, not to 1")
    return total


def clamp_posture(command: Tensor, pose: NominalPose) -> Tensor:
    """Move the posture of ``command`` (N, 21) into the region that the robot can hold; the rest is unchanged.

    The region is the robot's and the same for every controller: ``pose`` is its nominal-pose table.
    """
    return torch.cat([command[:, VELOCITY], pose.clamp(command[:, POSTURE]), command[:, ARMS]], dim=1)


def is_walking(command: Tensor) -> Tensor:
    """Whether ``command`` (..., 21) asks for locomotion (...,)."""
    return command[..., VELOCITY].norm(dim=-1) >= STANDING_SPEED
