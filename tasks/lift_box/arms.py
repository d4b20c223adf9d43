"""Batched kinematics of waist and arms in torch: where the palms are, and which joints put them somewhere
else.

The constants come from Pinocchio's model, the algebra is here because Pinocchio handles one robot at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import torch
from torch import Tensor

from robots.g1.constants import ARM_JOINTS, JOINT_NAMES, PELVIS_BODY, SIDES, WAIST_JOINTS
from robots.g1.kinematics import PALM_FRAMES, build_model
from robots.rotations import rotation_vector
from robots.turns import blend, turn_basis

_WAIST_SIZE, _ARM_SIZE = 3, 7


@dataclass(frozen=True)
class PalmPose:
    """Palm centers of N robots, left then right, with the axes of the wrist-yaw links (fingers +x)."""

    position: Tensor
    """(N, 2, 3) [m]"""
    rotation: Tensor
    """(N, 2, 3, 3)"""
    jacobian: Tensor
    """By the 7 arm joints (N, 2, 6, 7): velocity of the center, then angular velocity, in the frame of
    ``position``."""
    shoulder: Tensor
    """First joint of each arm (N, 2, 3) [m]."""


@dataclass(frozen=True)
class InverseConfig:
    """Damped least squares for the arms; weights are per meter and per radian."""

    position_weight: float = 20.0
    normal_weight: float = 4.0
    """On turning about the finger and the thumb axis: the palm faces where it should."""
    finger_weight: float = 0.5
    """On turning about the palm normal, which a flat palm on a flat face leaves free."""
    rest_weight: float = 0.05
    """On leaving the rest posture: what the seventh joint does with its freedom."""
    iterations: int = 10
    largest_step: float = 0.2
    """Per iteration and joint [rad]."""
    limit_margin: float = 0.03
    """Kept from every joint limit [rad]."""


class ArmKinematics:
    """Both arms of N robots at once, in the pelvis frame."""

    def __init__(self, config: InverseConfig | None = None) -> None:
        self.config = InverseConfig() if config is None else config
        model = build_model()
        data = model.createData()
        pin.framesForwardKinematics(model, data, pin.neutral(model))
        pelvis = data.oMf[model.getFrameId(PELVIS_BODY)]
        offsets, axes, palms = [], [], []
        for side, palm in zip(SIDES, PALM_FRAMES, strict=True):
            names = (
                *JOINT_NAMES[WAIST_JOINTS],
                *(n for n in JOINT_NAMES[ARM_JOINTS] if n.startswith(side)),
            )
            joints = [model.getJointId(name) for name in names]
            parents = [pelvis, *(data.oMi[joint] for joint in joints[:-1])]
            offsets.append(
                [parent.actInv(data.oMi[joint]).homogeneous for parent, joint in zip(parents, joints, strict=True)]
            )
            axes.append(["XYZ".index(model.joints[joint].shortname()[-1]) for joint in joints])
            palms.append(data.oMi[joints[-1]].actInv(data.oMf[model.getFrameId(palm)]).translation)
        self._offsets = torch.tensor(np.array(offsets), dtype=torch.float32)
        self._axes = torch.tensor(np.eye(3)[axes], dtype=torch.float32)
        self._turns = torch.tensor(np.stack([turn_basis(row) for row in axes], axis=1), dtype=torch.float32)
        self._palms = torch.tensor(np.array(palms), dtype=torch.float32)
        limits = np.stack([model.lowerPositionLimit[7:][ARM_JOINTS], model.upperPositionLimit[7:][ARM_JOINTS]])
        margin = np.array([[self.config.limit_margin], [-self.config.limit_margin]])
        self.lower, self.upper = torch.tensor(limits + margin, dtype=torch.float32)

    def forward(self, waist: Tensor, arms: Tensor) -> PalmPose:
        """Palm poses in the pelvis frame for ``waist`` (N, 3) and ``arms`` (N, 14) joints [rad]."""
        count = len(arms)
        angles = torch.cat([waist[:, None].expand(-1, 2, -1), arms.reshape(count, 2, _ARM_SIZE)], dim=-1)
        turns = blend(self._turns, angles[..., None, None])
        rotation = torch.eye(3).expand(count, 2, 3, 3)
        position = torch.zeros(count, 2, 3)
        origins, directions = [], []
        for joint in range(_WAIST_SIZE + _ARM_SIZE):
            position = position + (rotation @ self._offsets[:, joint, :3, 3:])[..., 0]
            rotation = rotation @ self._offsets[:, joint, :3, :3] @ turns[:, :, joint]
            if joint >= _WAIST_SIZE:
                origins.append(position)
                directions.append((rotation @ self._axes[:, joint, :, None])[..., 0])
        palm = position + (rotation @ self._palms[:, :, None])[..., 0]
        axis, origin = torch.stack(directions, -1), torch.stack(origins, -1)
        linear = torch.linalg.cross(axis, palm[..., None] - origin, dim=-2)
        return PalmPose(palm, rotation, torch.cat([linear, axis], dim=-2), origins[0])

    def inverse(
        self, waist: Tensor, start: Tensor, rest: Tensor, position: Tensor, rotation: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Arm joints that bring the palms to ``position`` (N, 2, 3) and ``rotation`` (N, 2, 3, 3), pelvis
        frame.

        Args:
            waist: waist joints (N, 3) [rad], which stay.
            start: where the iteration starts (N, 14) [rad].
            rest: preferred posture (N, 14) or (14,) [rad].
            position: palm centers [m].
            rotation: palm axes.

        Returns:
            arm joints (N, 14) within the limits, and the distance of each palm from its target (N, 2) [m].
        """
        config, count = self.config, len(start)
        joints = start.clamp(self.lower, self.upper)
        local = torch.tensor([config.normal_weight, config.finger_weight, config.normal_weight])
        rest = rest.expand(count, 2 * _ARM_SIZE).reshape(count, 2, _ARM_SIZE)
        damping = (config.rest_weight**2) * torch.eye(_ARM_SIZE)
        for _ in range(config.iterations):
            pose = self.forward(waist, joints)
            inverse_rotation = pose.rotation.transpose(-1, -2)
            turn = rotation_vector(quaternion_of(inverse_rotation @ rotation))
            residual = torch.cat([config.position_weight * (position - pose.position), local * turn], dim=-1)
            rows = torch.cat(
                [
                    config.position_weight * pose.jacobian[..., :3, :],
                    local[:, None] * (inverse_rotation @ pose.jacobian[..., 3:, :]),
                ],
                dim=-2,
            )
            transposed = rows.transpose(-1, -2)
            current = joints.reshape(count, 2, _ARM_SIZE)
            gradient = (transposed @ residual[..., None])[..., 0] + config.rest_weight**2 * (rest - current)
            step = torch.linalg.solve(transposed @ rows + damping, gradient)
            step = step.clamp(-config.largest_step, config.largest_step)
            joints = (joints + step.flatten(1)).clamp(self.lower, self.upper)
        return joints, (self.forward(waist, joints).position - position).norm(dim=-1)


def palm_rotation(forward: Tensor, finger_pitch: Tensor, toe_in: Tensor) -> Tensor:
    """Axes (N, 2, 3, 3) of palms that face each other, with the fingers along ``forward`` (N, 3).

    ``forward`` is a horizontal unit vector; ``finger_pitch`` (N,) [rad] turns the fingers down, and ``toe_in``
    (N,) [rad] turns each hand about its thumb axis so that the fingers point at each other.
    """
    up = torch.zeros_like(forward)
    up[:, 2] = 1.0
    left = torch.linalg.cross(up, forward)
    cosine, sine = torch.cos(finger_pitch)[:, None], torch.sin(finger_pitch)[:, None]
    fingers, thumb = cosine * forward - sine * up, sine * forward + cosine * up
    cosine, sine = torch.cos(toe_in)[:, None], torch.sin(toe_in)[:, None]
    hands = [
        torch.stack([cosine * fingers + side * sine * left, cosine * left - side * sine * fingers, thumb], dim=-1)
        for side in (-1.0, 1.0)
    ]
    return torch.stack(hands, dim=1)


def quaternion_of(rotation: Tensor) -> Tensor:
    """Unit quaternion (..., 4) wxyz of a rotation matrix (..., 3, 3), numerically safe at any angle."""
    m = rotation
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    # Rows of 4 q q^T; the one with the largest diagonal is the best conditioned multiple of q.
    diagonal = torch.stack(
        [
            1.0 + trace,
            1.0 + 2.0 * m[..., 0, 0] - trace,
            1.0 + 2.0 * m[..., 1, 1] - trace,
            1.0 + 2.0 * m[..., 2, 2] - trace,
        ],
        dim=-1,
    )
    x, y, z = (m[..., i, j] - m[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    xy, xz, yz = (m[..., i, j] + m[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    rows = torch.stack(
        [
            torch.stack([diagonal[..., 0], x, y, z], -1),
            torch.stack([x, diagonal[..., 1], xy, xz], -1),
            torch.stack([y, xy, diagonal[..., 2], yz], -1),
            torch.stack([z, xz, yz, diagonal[..., 3]], -1),
        ],
        dim=-2,
    )
    best = diagonal.argmax(dim=-1, keepdim=True)[..., None].expand(*diagonal.shape[:-1], 1, 4)
    row = rows.gather(-2, best)[..., 0, :]
    return row / row.norm(dim=-1, keepdim=True)
