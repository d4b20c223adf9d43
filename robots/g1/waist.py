"""The waist: three joints between pelvis and torso, in the order yaw, roll, pitch."""

from __future__ import annotations

from torch import Tensor

from robots.rotations import about_axis, conjugate, from_roll_pitch_yaw, multiply


def pelvis_attitude(torso: Tensor, waist: Tensor) -> Tensor:
    """Pelvis quaternion (N, 4) in the heading frame that puts the torso at ``torso`` (N, 3; roll, pitch, yaw).

    ``waist`` (N, 3): joint positions [rad].
    """
    yaw, roll, pitch = waist.unbind(-1)
    tilted = multiply(about_axis(0, roll), about_axis(1, pitch))
    return multiply(from_roll_pitch_yaw(torso), conjugate(multiply(about_axis(2, yaw), tilted)))
