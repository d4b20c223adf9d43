"""The terms that observations of G1 policies are made of, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.commands import ARMS, HEIGHT, TORSO, VELOCITY, is_walking
from lowlevel.control.observation import Proprioception
from robots.g1.constants import ARM_JOINTS, joint_index


@dataclass(frozen=True)
class Seen:
    """What terms of N robots are read from."""

    measured: Proprioception
    command: Tensor
    """(N, 21)"""
    default_position: Tensor
    """(29,) [rad]"""
    last_action: Tensor
    """The policy's last output (N, actions)."""
    phase: Tensor
    """Of each foot (N, feet) [rad]."""


@dataclass(frozen=True)
class TermKind:
    """How a term is read."""

    read: Callable[[Seen], Tensor]
    """Gives (N, size), or (N, 29) if it is per joint."""
    size: int | None = None
    """Numbers that it has; None: as many as the policy has joints, actions or feet."""
    per_joint: bool = False
    """Whether a card may choose joints of it."""


def commanded_targets(command: Tensor, default_position: Tensor) -> Tensor:
    """Joints where a ``command`` (N, 21) has them (N, 29) [rad]: arms and waist yaw; the others at their default."""
    targets = default_position.repeat(len(command), 1)
    targets[:, ARM_JOINTS] = command[:, ARMS]
    targets[:, joint_index("waist_yaw_joint")] = command[:, TORSO.stop - 1]
    return targets


def upright_orientation(gravity: Tensor) -> Tensor:
    """Quaternion (N, 4), w first, of a base without yaw that measures the direction ``gravity`` (N, 3)."""
    up = -gravity / gravity.norm(dim=1, keepdim=True)
    # The shortest rotation from the base's up to the world's.
    turn = torch.stack([1.0 + up[:, 2], up[:, 1], -up[:, 0], torch.zeros(len(up))], dim=1)
    return turn / turn.norm(dim=1, keepdim=True).clamp_min(1e-9)


def _torso(axis: int) -> TermKind:
    return TermKind(lambda seen: seen.command[:, TORSO][:, axis : axis + 1], 1)


TERMS: dict[str, TermKind] = {
    "velocity_command": TermKind(lambda seen: seen.command[:, VELOCITY], 3),
    "linear_velocity_command": TermKind(lambda seen: seen.command[:, VELOCITY][:, :2], 2),
    "yaw_rate_command": TermKind(lambda seen: seen.command[:, VELOCITY][:, 2:], 1),
    "height_command": TermKind(lambda seen: seen.command[:, HEIGHT : HEIGHT + 1], 1),
    "torso_roll_command": _torso(0),
    "torso_pitch_command": _torso(1),
    "torso_yaw_command": _torso(2),
    "joint_command": TermKind(lambda seen: commanded_targets(seen.command, seen.default_position), per_joint=True),
    "walks": TermKind(lambda seen: is_walking(seen.command).float()[:, None], 1),
    "base_angular_velocity": TermKind(lambda seen: seen.measured.base_angular_velocity, 3),
    "projected_gravity": TermKind(lambda seen: seen.measured.projected_gravity, 3),
    "base_orientation": TermKind(lambda seen: upright_orientation(seen.measured.projected_gravity), 4),
    "joint_position": TermKind(lambda seen: seen.measured.joint_position - seen.default_position, per_joint=True),
    "joint_angle": TermKind(lambda seen: seen.measured.joint_position, per_joint=True),
    "joint_velocity": TermKind(lambda seen: seen.measured.joint_velocity, per_joint=True),
    "last_action": TermKind(lambda seen: seen.last_action),
    "sine_of_phase": TermKind(lambda seen: torch.sin(seen.phase)),
    "cosine_of_phase": TermKind(lambda seen: torch.cos(seen.phase)),
}
"""Positions are relative to the card's default position, angles are not. The orientation has no yaw: no policy here
may know where north is."""
