"""Batched rotations on torch tensors. Quaternions are scalar-first (w, x, y, z), as in MuJoCo."""

from __future__ import annotations

import torch
from torch import Tensor


def yaw_of(quaternion: Tensor) -> Tensor:
    """Heading angle [rad] (...,) of a body with orientation ``quaternion`` (..., 4)."""
    w, x, y, z = quaternion.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def rotate_inverse(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Express a world ``vector`` (..., 3) in the body frame of ``quaternion`` (..., 4)."""
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    twice_cross = 2.0 * torch.linalg.cross(vector, xyz)
    return vector + w * twice_cross + torch.linalg.cross(twice_cross, xyz)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Express a body ``vector`` (..., 3) in the world frame, for a body with ``quaternion`` (..., 4)."""
    return rotate_inverse(conjugate(quaternion), vector)


def rotate_about_vertical(angle: Tensor, vector: Tensor) -> Tensor:
    """Rotate ``vector`` (..., 2 or 3) by ``angle`` (...,) [rad] about the world z axis."""
    cosine, sine = torch.cos(angle), torch.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    rotated = [cosine * x - sine * y, sine * x + cosine * y]
    return torch.stack([*rotated, *vector[..., 2:].unbind(-1)], dim=-1)


def conjugate(quaternion: Tensor) -> Tensor:
    """Inverse of a unit quaternion (..., 4)."""
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], dim=-1)


def multiply(first: Tensor, second: Tensor) -> Tensor:
    """Hamilton product of two quaternions (..., 4): apply ``second``, then ``first``."""
    w1, v1 = first[..., :1], first[..., 1:]
    w2, v2 = second[..., :1], second[..., 1:]
    scalar = w1 * w2 - (v1 * v2).sum(-1, keepdim=True)
    return torch.cat([scalar, w1 * v2 + w2 * v1 + torch.linalg.cross(v1, v2)], dim=-1)


def about_axis(axis: int, angle: Tensor) -> Tensor:
    """Quaternion (..., 4) of a turn by ``angle`` (...,) [rad] about coordinate ``axis``: 0 is x, 1 is y, 2 is z."""
    quaternion = angle.new_zeros(*angle.shape, 4)
    quaternion[..., 0], quaternion[..., 1 + axis] = torch.cos(0.5 * angle), torch.sin(0.5 * angle)
    return quaternion


def from_roll_pitch_yaw(angles: Tensor) -> Tensor:
    """Quaternion (..., 4) of R = Rz(yaw) Ry(pitch) Rx(roll) for ``angles`` (..., 3) = (roll, pitch, yaw) [rad]."""
    cr, cp, cy = torch.cos(0.5 * angles).unbind(-1)
    sr, sp, sy = torch.sin(0.5 * angles).unbind(-1)
    return torch.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        dim=-1,
    )


def rotation_vector(quaternion: Tensor) -> Tensor:
    """Rotation vector (..., 3) [rad], angle in [0, pi], of a unit ``quaternion`` (..., 4)."""
    vector = torch.where(quaternion[..., :1] < 0, -quaternion[..., 1:], quaternion[..., 1:])
    sine = vector.norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, quaternion[..., :1].abs())
    return vector * torch.where(sine > 1e-8, angle / sine.clamp_min(1e-8), torch.full_like(sine, 2.0))
