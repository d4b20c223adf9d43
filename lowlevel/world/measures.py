"""What happened in one control step: tracking errors and contact quantities that rewards and figures share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from lowlevel.commands import ARMS, HEIGHT, TORSO, VELOCITY
from lowlevel.control.observation import Proprioception
from lowlevel.world.simulation import RobotState
from lowlevel.world.terrain import Terrain
from robots.g1.constants import ARM_JOINTS, BODY_POINTS, GRAVITY
from robots.rotations import (
    about_axis,
    conjugate,
    from_roll_pitch_yaw,
    multiply,
    rotate,
    rotate_about_vertical,
    rotation_vector,
    yaw_of,
)

LOADED_FOOT_FORCE = 5.0
"""A foot with more contact force than this is on the ground [N]."""


@dataclass(frozen=True)
class Measurement:
    """Derived quantities of N robots; frames are the heading frame (yaw-only frame of the pelvis) unless named."""

    robot: RobotState
    heading: Tensor
    """Yaw of the pelvis (N,) [rad]."""
    linear_velocity: Tensor
    """Pelvis velocity (N, 3) [m/s]."""
    yaw_rate: Tensor
    """About the vertical (N,) [rad/s]."""
    projected_gravity: Tensor
    """Unit gravity in the pelvis frame (N, 3)."""
    base_height: Tensor
    """Pelvis above the ground under the lowest foot (N,) [m]."""
    torso_orientation: Tensor
    """Torso quaternion relative to the heading frame (N, 4)."""
    capture_point: Tensor
    """Where the robot would have to put a foot to come to rest, from the middle between its soles (N, 2) [m] (Pratt et
    al., Humanoids 2006): the center of mass, and its velocity times the time constant of its fall."""
    foot_position: Tensor
    """Center of each sole from the pelvis (N, 2, 3) [m]."""
    foot_velocity: Tensor
    """(N, 2, 3) [m/s]."""
    foot_force: Tensor
    """Net contact force on each foot (N, 2, 3) [N]."""
    foot_clearance: Tensor
    """Sole above the ground below it (N, 2) [m]."""
    foot_contact: Tensor
    """Loaded feet (N, 2), boolean."""
    body_clearance: Tensor
    """Centers of the robot's body points above the ground below them (N, 7) [m]."""

    @property
    def proprioception(self) -> Proprioception:
        """What the robot's own sensors would measure, without noise."""
        robot = self.robot
        return Proprioception(
            robot.joint_position, robot.joint_velocity, robot.base_angular_velocity, self.projected_gravity
        )


def measure(robot: RobotState, terrain: Terrain) -> Measurement:
    """Derive a :class:`Measurement` from the raw state."""
    heading = yaw_of(robot.base_quaternion)
    down = torch.zeros_like(robot.base_position)
    down[:, 2] = -1.0
    ground = terrain.height(robot.foot_position[..., :2])
    lowest = robot.foot_position[..., 2].argmin(dim=1, keepdim=True)
    from_pelvis = robot.foot_position - robot.base_position[:, None]
    middle = robot.foot_position.mean(dim=1)
    fall_time = ((robot.center_of_mass[:, 2] - middle[:, 2]).clamp_min(0.1) / GRAVITY).sqrt()
    capture_point = (
        robot.center_of_mass[:, :2] + fall_time[:, None] * robot.center_of_mass_velocity[:, :2] - middle[:, :2]
    )
    feet = torch.cat([from_pelvis, robot.foot_velocity, robot.foot_force], dim=1)
    position, velocity, force = rotate_about_vertical(-heading[:, None], feet).split(2, dim=1)
    return Measurement(
        robot=robot,
        heading=heading,
        linear_velocity=rotate_about_vertical(-heading, robot.base_linear_velocity),
        yaw_rate=rotate(robot.base_quaternion, robot.base_angular_velocity)[:, 2],
        projected_gravity=rotate(conjugate(robot.base_quaternion), down),
        base_height=robot.base_position[:, 2] - ground.gather(1, lowest)[:, 0],
        torso_orientation=multiply(about_axis(2, -heading), robot.torso_quaternion),
        capture_point=rotate_about_vertical(-heading, capture_point),
        foot_position=position,
        foot_velocity=velocity,
        foot_force=force,
        foot_clearance=robot.foot_position[..., 2] - ground,
        foot_contact=robot.foot_force.norm(dim=-1) > LOADED_FOOT_FORCE,
        body_clearance=robot.body_points[..., 2] - terrain.height(robot.body_points[..., :2]),
    )


Rows = TypeVar("Rows", Measurement, RobotState)


def with_rows(whole: Rows, ids: Tensor, part: Rows) -> Rows:
    """A copy of ``whole`` in which rows ``ids`` (n,) are the n rows of ``part``."""
    changed: dict[str, Any] = {}
    for field in fields(whole):
        old, new = getattr(whole, field.name), getattr(part, field.name)
        changed[field.name] = old.index_copy(0, ids, new) if isinstance(old, Tensor) else with_rows(old, ids, new)
    return replace(whole, **changed)


def velocity_error(measured: Measurement, command: Tensor) -> Tensor:
    """(vx, vy, yaw rate) measured - commanded (N, 3) [m/s, m/s, rad/s]."""
    actual = torch.cat([measured.linear_velocity[:, :2], measured.yaw_rate[:, None]], dim=-1)
    return actual - command[:, VELOCITY]


def height_error(measured: Measurement, command: Tensor) -> Tensor:
    """Base height measured - commanded (N,) [m]."""
    return measured.base_height - command[:, HEIGHT]


def torso_error(measured: Measurement, command: Tensor) -> Tensor:
    """Rotation vector (N, 3) [rad] from the commanded to the measured torso attitude, in the torso frame.

    Its components are the roll, pitch and yaw errors for small errors; unlike differences of Euler angles they stay
    meaningful near a torso pitch of 90 degrees.
    """
    commanded = from_roll_pitch_yaw(command[:, TORSO])
    return rotation_vector(multiply(conjugate(commanded), measured.torso_orientation))


def arm_error(measured: Measurement, command: Tensor) -> Tensor:
    """Arm joints measured - commanded (N, 14) [rad]."""
    return measured.robot.joint_position[:, ARM_JOINTS] - command[:, ARMS]


def stumbles(measured: Measurement) -> Tensor:
    """Whether a loaded foot is pushed sideways at least as hard as upwards (N,) (paper, IV-A-2)."""
    force = measured.foot_force
    sideways = force[..., :2].norm(dim=-1) >= force[..., 2].abs()
    return (sideways & measured.foot_contact).any(dim=-1)


TRACKING_FIGURES: dict[str, tuple[str, Callable[[Measurement, Tensor], Tensor]]] = {
    "E_v": ("m/s", lambda measured, command: velocity_error(measured, command)[:, :2].abs().sum(-1)),
    "E_omega": ("rad/s", lambda measured, command: velocity_error(measured, command)[:, 2].abs()),
    "E_h": ("m", lambda measured, command: height_error(measured, command).abs()),
    "E_r": ("rad", lambda measured, command: torso_error(measured, command)[:, 0].abs()),
    "E_p": ("rad", lambda measured, command: torso_error(measured, command)[:, 1].abs()),
    "E_y": ("rad", lambda measured, command: torso_error(measured, command)[:, 2].abs()),
    "E_arm": ("rad", lambda measured, command: arm_error(measured, command).abs().sum(-1)),
    "E_stumble": ("1", lambda measured, command: stumbles(measured).float()),
}
"""The paper's figures: name -> (unit, function of measurement and clamped command giving (N,))."""


def has_fallen(measured: Measurement) -> Tensor:
    """Whether pelvis, torso, head, a knee or an elbow reaches the ground under it (N,).

    A fall is what a robot does, whatever it was told, whoever controls it, and on any terrain.
    """
    radius = torch.tensor([point.radius for point in BODY_POINTS], device=measured.heading.device)
    return (measured.body_clearance < radius).any(dim=1)


LOST_TILT = 0.9
"""Angle between the torso's axis and where its reference has it, beyond which training gives a robot up [rad]."""
LOST_DROP = 0.25
"""Distance of the pelvis below its reference height beyond which it does [m]."""
LOST_HEIGHT = 0.18
"""Base height below which it always does [m]."""


def is_lost(measured: Measurement, reference: Tensor) -> Tensor:
    """Whether a robot is beyond saving (N,): torso far off its reference attitude, or pelvis far too low.

    Training need not wait for the fall. ``reference`` (N, 21) is the slewed command, so that a step of the command is
    not mistaken for the beginning of a fall.
    """
    wanted = from_roll_pitch_yaw(reference[:, TORSO])
    _, x, y, _ = multiply(conjugate(wanted), measured.torso_orientation).unbind(-1)
    # The cosine of the angle between the two vertical axes.
    tilt = torch.acos((1.0 - 2.0 * (x * x + y * y)).clamp(-1.0, 1.0))
    too_low = measured.base_height < (reference[:, HEIGHT] - LOST_DROP).clamp_min(LOST_HEIGHT)
    return (tilt > LOST_TILT) | too_low
