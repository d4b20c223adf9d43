"""What the policy sees, stated once as a table of named blocks, each with its mirror and what it is read from.

The policy's frame is the paper's o_t^n = [q, q_dot, omega, g, c, a_{t-1}] plus two additions: the slewed velocity and
posture, and the gait clock, without which the joint targets under the residual would be hidden from the policy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from lowlevel import commands
from lowlevel.commands import CommandSpace
from lowlevel.control.reference import ReferenceState
from robots.g1.constants import DEFAULT_POSITION, NUM_JOINTS
from robots.g1.mirror import AXIAL_VECTOR, JOINTS_MIRROR, VECTOR, Mirror, concatenate, signs

CONTROL_PERIOD = 0.02
"""Time between two observations, and between the actions that they lead to [s]: 50 Hz (paper IV-B)."""
MAP_REFRESH_STEPS = 5
"""Control steps between refreshes of the elevation map: 10 Hz (paper IV-B)."""
HISTORY_LENGTH = 5
"""Past frames beside the current one (paper: H = 5)."""
NOMINAL_MAP_DISTANCE = 0.75
"""Vertical distance base - terrain [m] that the policy sees as zero."""


@dataclass(frozen=True)
class Proprioception:
    """What the sensors of N robots measure."""

    joint_position: Tensor
    """(N, 29) [rad], Unitree's order."""
    joint_velocity: Tensor
    """(N, 29) [rad/s]."""
    base_angular_velocity: Tensor
    """(N, 3) [rad/s], pelvis frame."""
    projected_gravity: Tensor
    """Unit gravity direction in the pelvis frame (N, 3); (0, 0, -1) when upright."""

    def with_noise(self, noise: Tensor) -> Proprioception:
        """Measurements with ``noise`` (N, 64) added, in the order of the fields."""
        joints, velocities, turning, gravity = noise.split([NUM_JOINTS, NUM_JOINTS, 3, 3], dim=-1)
        return Proprioception(
            self.joint_position + joints,
            self.joint_velocity + velocities,
            self.base_angular_velocity + turning,
            self.projected_gravity + gravity,
        )


@dataclass(frozen=True)
class NoiseConfig:
    """Half-widths of the uniform observation noise."""

    joint_position: float = 0.01
    """[rad]"""
    joint_velocity: float = 0.5
    """[rad/s]"""
    base_angular_velocity: float = 0.2
    """[rad/s]"""
    projected_gravity: float = 0.03
    """[1]"""
    elevation: float = 0.02
    """[m]"""

    def proprioception(self) -> Tensor:
        """Half-width of the noise on each number of a :class:`Proprioception` (64,), in the order of its fields."""
        joints = [self.joint_position] * NUM_JOINTS + [self.joint_velocity] * NUM_JOINTS
        return torch.tensor([*joints, *[self.base_angular_velocity] * 3, *[self.projected_gravity] * 3])


View = TypeVar("View", contravariant=True)


@dataclass(frozen=True)
class Block(Generic[View]):
    """A named part of an observation vector."""

    name: str
    mirror: Mirror
    read: Callable[[View], Tensor]
    """The block (N, size) of what is seen."""
    normalized: bool = True
    """Whether running statistics normalize it."""

    @property
    def size(self) -> int:
        return len(self.mirror.index)


@dataclass(frozen=True)
class FrameView:
    """What a frame of N robots is read from."""

    proprioception: Proprioception
    command: Tensor
    """Clamped command (N, 21)."""
    last_action: Tensor
    """(N, 29), in action scales."""
    reference: ReferenceState
    space: CommandSpace


_SLEWED = slice(0, commands.ARMS.start)
"""Velocity and posture: what of the slewed command the policy sees beside the command."""
_SLEWED_MIRROR = Mirror(commands.MIRROR.index[_SLEWED], commands.MIRROR.sign[_SLEWED])


def _from_default(joint_position: Tensor) -> Tensor:
    return joint_position - torch.tensor(DEFAULT_POSITION, dtype=torch.float32, device=joint_position.device)


FRAME: tuple[Block[FrameView], ...] = (
    Block("joint_position", JOINTS_MIRROR, lambda v: _from_default(v.proprioception.joint_position)),
    Block("joint_velocity", JOINTS_MIRROR, lambda v: v.proprioception.joint_velocity),
    Block("base_angular_velocity", AXIAL_VECTOR, lambda v: v.proprioception.base_angular_velocity),
    Block("projected_gravity", VECTOR, lambda v: v.proprioception.projected_gravity),
    Block("command", commands.MIRROR, lambda v: v.space.scaled(v.command), normalized=False),
    Block("last_action", JOINTS_MIRROR, lambda v: v.last_action),
    Block(
        "slewed_command",
        _SLEWED_MIRROR,
        lambda v: v.space.scaled(v.reference.command)[:, _SLEWED],
        normalized=False,
    ),
    # Half a gait period later left and right have changed places, so both components change sign.
    Block("gait_clock", signs(-1, -1), lambda v: v.reference.clock, normalized=False),
)
"""The policy's proprioceptive frame, in order."""
FRAME_SIZE = sum(block.size for block in FRAME)
FRAME_MIRROR = concatenate(*(block.mirror for block in FRAME))


def build(blocks: Sequence[Block[View]], view: View) -> Tensor:
    """The observation vector (N, D) that ``blocks`` read from ``view``."""
    return torch.cat([block.read(view) for block in blocks], dim=-1)


def normalized_columns(blocks: Sequence[Block[View]]) -> Tensor:
    """Mask (D,) of the columns that running statistics normalize."""
    return torch.cat([torch.full((block.size,), block.normalized) for block in blocks])


def columns(blocks: Sequence[Block[View]], name: str) -> slice:
    """Where the block called ``name`` stands among ``blocks``."""
    start = 0
    for block in blocks:
        if block.name == name:
            return slice(start, start + block.size)
        start += block.size
    raise LookupError(f"there is no block {name!r}")


def start_history(frame: Tensor) -> Tensor:
    """A history (N, 6, FRAME_SIZE) that repeats the first frame."""
    return frame[:, None].repeat(1, HISTORY_LENGTH + 1, 1)


def push_history(history: Tensor, frame: Tensor) -> Tensor:
    """Append ``frame`` (N, F) as the newest entry of ``history`` (N, 6, F), oldest first."""
    return torch.cat([history[:, 1:], frame[:, None]], dim=1)


def map_observation(elevation: Tensor) -> Tensor:
    """Elevation map as observed (N, 121), from vertical distances base - terrain [m]."""
    return (elevation - NOMINAL_MAP_DISTANCE).clamp(-1.0, 1.0)
