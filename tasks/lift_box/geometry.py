"""Where box, palms and robot are relative to each other, for N robots at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.world.measures import Measurement
from robots.rotations import conjugate, multiply, rotate, rotate_about_vertical, rotate_inverse, yaw_of


def relative_pose(frame: Tensor, thing: Tensor) -> tuple[Tensor, Tensor]:
    """Position (N, 3) and quaternion (N, 4) of ``thing`` in ``frame``, both world poses (N, 7)."""
    position = rotate_inverse(frame[:, 3:], thing[:, :3] - frame[:, :3])
    return position, multiply(conjugate(frame[:, 3:]), thing[:, 3:])


def rotation_6d(quaternion: Tensor) -> Tensor:
    """First two columns of the rotation matrix (N, 6): a continuous attitude (Zhou et al., CVPR 2019)."""
    columns = []
    for axis in range(2):
        unit = torch.zeros(*quaternion.shape[:-1], 3)
        unit[..., axis] = 1.0
        columns.append(rotate(quaternion, unit))
    return torch.cat(columns, dim=-1)


@dataclass(frozen=True)
class Situation:
    """Robot and box at one instant; heading frame (yaw-only frame of the pelvis) unless named."""

    box_pose: Tensor
    """World (N, 7) [m], wxyz."""
    near_face: Tensor
    """Center of the box's -x face from the pelvis (N, 3) [m]."""
    yaw_error: Tensor
    """Yaw of the box relative to the robot (N,) [rad]."""
    speed: Tensor
    """Horizontal speed of the pelvis (N,) [m/s]."""
    palm_offset: Tensor
    """From each palm to the center of its own side face (N, 2, 3) [m]; left palm and +y face, right palm and
    -y face."""
    palm_distance: Tensor
    """From each palm to its own side face (N, 2) [m]."""
    palm_force: Tensor
    """Normal force of each palm on the box (N, 2) [N]."""
    bottom: Tensor
    """Lowest point of the box above the ground (N,) [m]."""
    tilt: Tensor
    """Angle of the box's z axis from the vertical (N,) [rad]."""
    torso_pitch: Tensor
    """(N,) [rad]"""
    base_height: Tensor
    """(N,) [m]"""


def observe_situation(measured: Measurement, box_pose: Tensor, size: Tensor, palm_force: Tensor) -> Situation:
    """Derive a :class:`Situation`.

    Args:
        measured: the robots.
        box_pose: world (N, 7).
        size: edges of the boxes (N, 3) [m].
        palm_force: net contact force of each palm on the box (N, 2, 3) [N], world frame.
    """
    robot, half = measured.robot, 0.5 * size
    position, quaternion = box_pose[:, :3], box_pose[:, 3:]
    side = torch.tensor([1.0, -1.0])
    zero = torch.zeros_like(half[:, 0])
    near_face = rotate(quaternion, torch.stack([-half[:, 0], zero, zero], -1)) + position
    face_centers = side[None, :, None] * torch.stack([zero, half[:, 1], zero], -1)[:, None]
    both = quaternion[:, None].expand(-1, 2, -1)
    to_face = rotate(both, face_centers) + position[:, None] - robot.palm_position
    local = rotate_inverse(both, robot.palm_position - position[:, None])
    beside = (local.abs() - half[:, None]).clamp_min(0.0)
    distance = torch.stack([beside[..., 0], local[..., 1] - side * half[:, 1:2], beside[..., 2]], -1).norm(dim=-1)
    # The palm's normal points at the other hand: -y on the left, +y on the right.
    inwards = torch.zeros_like(robot.palm_position)
    inwards[..., 1] = -side
    normal = (palm_force * rotate(robot.palm_quaternion, inwards)).sum(-1).clamp_min(0.0)
    axes_z = rotation_rows_z(quaternion)
    heading = measured.heading
    qw, qx, qy, qz = measured.torso_orientation.unbind(-1)
    yaw_error = yaw_of(quaternion) - heading
    return Situation(
        box_pose=box_pose,
        near_face=rotate_about_vertical(-heading, near_face - robot.base_position),
        yaw_error=torch.atan2(torch.sin(yaw_error), torch.cos(yaw_error)),
        speed=measured.linear_velocity[:, :2].norm(dim=-1),
        palm_offset=rotate_about_vertical(-heading[:, None], to_face),
        palm_distance=distance,
        palm_force=normal,
        bottom=position[:, 2] - (axes_z.abs() * half).sum(-1),
        tilt=torch.acos(axes_z[:, 2].clamp(-1.0, 1.0)),
        torso_pitch=torch.asin((2.0 * (qw * qy - qz * qx)).clamp(-1.0, 1.0)),
        base_height=measured.base_height,
    )


def rotation_rows_z(quaternion: Tensor) -> Tensor:
    """World z components of the body axes (N, 3): the last row of the rotation matrix."""
    up = torch.zeros(*quaternion.shape[:-1], 3)
    up[..., 2] = 1.0
    return rotate_inverse(quaternion, up)
