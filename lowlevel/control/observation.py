"""Observation layout: what the policy and the critic see, stated once as tables of named blocks.

The policy's frame is the paper's o_t^n = [q, q_dot, omega, g, c, a_{t-1}] plus two additions: the slewed velocity and
posture, and the gait clock, without which the joint targets under the residual would be hidden from the policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile

import torch
from torch import Tensor

from lowlevel import commands
from lowlevel.commands import COMMAND_SIZE, CommandSpace
from lowlevel.control.elevation_map import MAP_MIRROR, MAP_SIZE
from lowlevel.control.reference import Reference, ReferenceState
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

_PAIR_VECTOR = Mirror(concatenate(VECTOR, VECTOR).index[[3, 4, 5, 0, 1, 2]], concatenate(VECTOR, VECTOR).sign)
_PAIR = Mirror(signs(1, 1).index[::-1].copy(), signs(1, 1).sign)
_SLEWED = slice(0, commands.ARMS.start)
"""Velocity and posture: what of the slewed command the policy sees beside the command."""
_SLEWED_MIRROR = Mirror(commands.MIRROR.index[_SLEWED], commands.MIRROR.sign[_SLEWED])


@dataclass(frozen=True)
class Block:
    """A named part of an observation vector: its mirror, and whether running statistics normalise it."""

    name: str
    mirror: Mirror
    normalised: bool = True

    @property
    def size(self) -> int:
        return len(self.mirror.index)


FRAME: tuple[Block, ...] = (
    Block("joint_position", JOINTS_MIRROR),
    Block("joint_velocity", JOINTS_MIRROR),
    Block("base_angular_velocity", AXIAL_VECTOR),
    Block("projected_gravity", VECTOR),
    Block("command", commands.MIRROR, normalised=False),
    Block("last_action", JOINTS_MIRROR),
    Block("slewed_command", _SLEWED_MIRROR, normalised=False),
    # Half a gait period later left and right have changed places, so both components change sign.
    Block("gait_clock", signs(-1, -1), normalised=False),
)
"""The policy's proprioceptive frame, in order."""
FRAME_SIZE = sum(block.size for block in FRAME)
FRAME_MIRROR = concatenate(*(block.mirror for block in FRAME))

PRIVILEGED: tuple[Block, ...] = (
    Block("base_linear_velocity", VECTOR),
    *FRAME,
    Block("base_height_error", signs(1)),
    Block("torso_error", AXIAL_VECTOR),
    Block("mean_velocity_error", signs(1, -1, -1)),
    Block("foot_contact", _PAIR, normalised=False),
    Block("foot_clearance", _PAIR),
    Block("foot_position", _PAIR_VECTOR),
    Block("foot_velocity", _PAIR_VECTOR),
    Block("foot_force", _PAIR_VECTOR),
    Block("hand_force", _PAIR_VECTOR),
    Block("friction", signs(1)),
    Block("added_mass", signs(1, 1)),
    Block("flag", signs(1), normalised=False),
    Block("elevation_map", MAP_MIRROR, normalised=False),
)
"""What the critic sees, noise-free; the true base velocity (heading frame) comes first."""
PRIVILEGED_SIZE = sum(block.size for block in PRIVILEGED)
PRIVILEGED_MIRROR = concatenate(*(block.mirror for block in PRIVILEGED))

MIRRORS: dict[str, Mirror] = {
    "history": FRAME_MIRROR.repeated(HISTORY_LENGTH + 1),
    "elevation_map": MAP_MIRROR,
    "privileged": PRIVILEGED_MIRROR,
    "action": JOINTS_MIRROR,
}


def normalised_columns(blocks: tuple[Block, ...]) -> Tensor:
    """Mask (D,) of the columns that running statistics normalise."""
    return torch.cat([torch.full((block.size,), block.normalised) for block in blocks])


@dataclass(frozen=True)
class Proprioception:
    """What the controller measures on N robots."""

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

    def frame_amplitude(self) -> Tensor:
        """Half-width of the noise on what is measured, the first M columns of a frame (M,)."""
        measured = takewhile(lambda block: hasattr(self, block.name), FRAME)
        return torch.cat([torch.full((block.size,), getattr(self, block.name)) for block in measured])


class FrameBuilder:
    """Assembles proprioceptive frames; shared by the environment and the frozen controller."""

    def __init__(self, space: CommandSpace, reference: Reference, device: torch.device | str = "cpu") -> None:
        self._reference = reference
        lower, upper = space.bounds(device)
        self._middle, self._half_range = 0.5 * (upper + lower), 0.5 * (upper - lower)
        self._default = torch.tensor(DEFAULT_POSITION, dtype=torch.float32, device=device)

    def __call__(
        self,
        joint_position: Tensor,
        joint_velocity: Tensor,
        base_angular_velocity: Tensor,
        projected_gravity: Tensor,
        command: Tensor,
        last_action: Tensor,
        reference: ReferenceState,
    ) -> Tensor:
        """Frame (N, FRAME_SIZE) from measurements, the clamped command (N, 21) and the reference."""
        slewed = (reference.command - self._middle) / self._half_range
        parts = (
            joint_position - self._default,
            joint_velocity,
            base_angular_velocity,
            projected_gravity,
            (command - self._middle) / self._half_range,
            last_action,
            slewed[:, _SLEWED],
            self._reference.clock(reference),
        )
        return torch.cat(parts, dim=-1)


def columns(blocks: Sequence[Block], name: str) -> slice:
    """Where the block called ``name`` stands among ``blocks``."""
    start = 0
    for block in blocks:
        if block.name == name:
            return slice(start, start + block.size)
        start += block.size
    raise LookupError(f"there is no block {name!r}")


def split_frame(frame: Tensor) -> dict[str, Tensor]:
    """The blocks of a frame (N, FRAME_SIZE) by name."""
    parts = frame.split([block.size for block in FRAME], dim=-1)
    return {block.name: part for block, part in zip(FRAME, parts, strict=True)}


def start_history(frame: Tensor) -> Tensor:
    """A history (N, 6, FRAME_SIZE) that repeats the first frame."""
    return frame[:, None].repeat(1, HISTORY_LENGTH + 1, 1)


def push_history(history: Tensor, frame: Tensor) -> Tensor:
    """Append ``frame`` (N, F) as the newest entry of ``history`` (N, 6, F), oldest first."""
    return torch.cat([history[:, 1:], frame[:, None]], dim=1)


def map_observation(elevation: Tensor) -> Tensor:
    """Elevation map as observed (N, 121), from vertical distances base - terrain [m]."""
    return (elevation - NOMINAL_MAP_DISTANCE).clamp(-1.0, 1.0)


assert FRAME_SIZE == 3 * NUM_JOINTS + 6 + COMMAND_SIZE + 9
assert MAP_MIRROR.index.size == MAP_SIZE
