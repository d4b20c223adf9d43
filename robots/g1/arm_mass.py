"""Where the arms' mass is: its first moment for any arm posture, batched.

A G1's arms weigh 7 kg of 33: reaching out moves the centre of mass by centimetres, which the feet must follow.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from robots.g1.constants import ARM_JOINTS
from robots.g1.kinematics import build_model

_ARM_LENGTH = 7
"""Joints of one arm, from the shoulder outwards."""


class ArmMass:
    """First moment of both arms' mass about the torso frame's origin.

    Links are summed from the hand inwards: a link's subtree has its moment in its own frame, which the joint's
    rotation and offset carry into the frame of the link before it.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        model = build_model()
        first = 2 + ARM_JOINTS.start  # Pinocchio counts the universe and the floating base as joints
        joints = [range(start, start + _ARM_LENGTH) for start in (first, first + _ARM_LENGTH)]
        masses = np.array([[model.inertias[j].mass for j in arm] for arm in joints])
        moments = np.array([[model.inertias[j].mass * model.inertias[j].lever for j in arm] for arm in joints])
        rotations = np.array([[model.jointPlacements[j].rotation for j in arm] for arm in joints])
        offsets = np.array([[model.jointPlacements[j].translation for j in arm] for arm in joints])
        outboard = np.cumsum(masses[:, ::-1], axis=1)[:, ::-1]
        # Pinocchio names a joint model after the axis it turns about: JointModelRX, RY or RZ.
        self._axes = ["XYZ".index(model.joints[j].shortname()[-1]) for j in joints[0]]

        def tensor(array: np.ndarray) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self._moments, self._rotations = tensor(moments), tensor(rotations)
        self._carried = tensor(outboard[..., None] * offsets)

    def first_moment(self, arms: Tensor) -> Tensor:
        """Sum of mass times position (N, 3) [kg m] in the torso frame, for 14 arm joints ``arms`` (N, 14) [rad]."""
        angles = arms.unflatten(1, (2, _ARM_LENGTH))
        sine, cosine = torch.sin(angles), torch.cos(angles)
        moment = torch.zeros(len(arms), 2, 3, device=arms.device)
        for k in reversed(range(_ARM_LENGTH)):
            moment = _rotate(moment + self._moments[:, k], self._axes[k], sine[..., k], cosine[..., k])
            moment = torch.einsum("aij,naj->nai", self._rotations[:, k], moment) + self._carried[:, k]
        return moment.sum(dim=1)


def _rotate(vectors: Tensor, axis: int, sine: Tensor, cosine: Tensor) -> Tensor:
    """Turn ``vectors`` (..., 3) about a coordinate ``axis``."""
    parts = list(vectors.unbind(-1))
    second, third = (axis + 1) % 3, (axis + 2) % 3
    parts[second], parts[third] = (
        cosine * parts[second] - sine * parts[third],
        sine * parts[second] + cosine * parts[third],
    )
    return torch.stack(parts, dim=-1)
