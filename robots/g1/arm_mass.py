"""Where the arms' mass is: its first moment for any arm posture, batched.

A G1's arms weigh 7 kg of 33: reaching out moves the centre of mass by centimetres, which the feet must follow.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from robots.g1.constants import ARM_JOINTS
from robots.g1.kinematics import build_model
from robots.g1.turns import blend, turn_basis

_ARM_LENGTH = 7
"""Joints of one arm, from the shoulder outwards."""


class ArmMass:
    """First moment of both arms' mass about the torso frame's origin.

    Links are summed from the hand inwards: a link's subtree has its moment in its own frame, which the joint's
    rotation and offset carry into the frame of the link before it. That step is affine in the moment of the links
    further out, and both parts of it are linear in sine and cosine of the joint's angle.
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
        axes = ["XYZ".index(model.joints[j].shortname()[-1]) for j in joints[0]]
        turned = rotations @ turn_basis(axes)[:, None]
        carried = turned @ moments[..., None]
        carried[0] += (outboard[..., None] * offsets)[..., None]
        step = np.concatenate([turned, carried], axis=-1)
        # Robots come last in all that follows: the small products then run along memory.
        self._basis = torch.tensor(step.transpose(0, 2, 3, 4, 1)[..., None], dtype=torch.float32, device=device)
        """Constant, sine and cosine parts (3, 7, 3, 4, 2, 1) of each joint's step, rotation | translation."""

    def first_moment(self, arms: Tensor) -> Tensor:
        """Sum of mass times position (N, 3) [kg m] in the torso frame, for 14 arm joints ``arms`` (N, 14) [rad]."""
        angles = arms.T.unflatten(0, (2, 1, 1, _ARM_LENGTH)).transpose(0, 3).contiguous()
        steps = blend(self._basis, angles).unbind()
        moment = steps[-1][:, 3]
        for step in steps[-2::-1]:
            moment = (step[:, :3] * moment).sum(1) + step[:, 3]
        return moment.sum(dim=1).T
