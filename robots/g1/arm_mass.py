"""What it takes to hold up the arms in any posture, batched. They weigh 7 kg of the G1's 33."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from robots.g1.constants import ARM_JOINTS
from robots.turns import blend, turn_basis

_ARM_LENGTH = 7
"""Joints of one arm, from the shoulder outwards."""


class ArmMass:
    """Static torques of the joints of both arms.

    Links are summed from the hand inwards: a link's subtree has its moment in its own frame, which the joint's
    rotation and offset carry into the frame of the link before it. That step is affine in the moment of the links
    further out, and both parts of it are linear in sine and cosine of the joint's angle.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        # Here, so that what only needs the types of a controller loads without Pinocchio.
        from robots.g1.kinematics import build_model

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
        lever = (outboard[..., None] * offsets).transpose(1, 2, 0)[..., None]
        self._lever = torch.tensor(lever, dtype=torch.float32, device=device)
        """Mass of the links from a joint outwards times the joint's offset (7, 3, 2, 1) [kg m]."""
        axis = (rotations @ np.eye(3)[axes][..., None])[..., 0].transpose(1, 2, 0)[..., None]
        self._axis = torch.tensor(axis, dtype=torch.float32, device=device)
        """Joint axes (7, 3, 2, 1) in the frame of the link before."""

    def _steps(self, arms: Tensor) -> tuple[Tensor, ...]:
        """Steps (3, 4, 2, N) of the joints from the shoulder outwards."""
        angles = arms.T.unflatten(0, (2, 1, 1, _ARM_LENGTH)).transpose(0, 3).contiguous()
        return blend(self._basis, angles).unbind()

    def holding_torque(self, arms: Tensor, gravity: Tensor) -> Tensor:
        """Joint torques (N, 14) [N m] that hold up arms at ``arms`` (N, 14) [rad].

        ``gravity`` (N, 3) [m/s^2]: in the torso frame.
        """
        steps = self._steps(arms)
        moments = _carried_inwards(steps)
        pull = gravity.T[:, None].expand(-1, 2, -1)
        pulls = [pull]
        for step in steps[:-1]:
            pull = (step[:, :3] * pull[:, None]).sum(0)
            pulls.append(pull)
        about_joints = torch.stack(moments) - self._lever
        torque = -(self._axis * torch.linalg.cross(about_joints, torch.stack(pulls), dim=1)).sum(1)
        return torque.transpose(0, 1).flatten(0, 1).T


def _carried_inwards(steps: tuple[Tensor, ...]) -> list[Tensor]:
    """First moment (3, 2, N) of the links from each joint outwards, in the frame of the link before it."""
    moments = [steps[-1][:, 3]]
    for step in steps[-2::-1]:
        moments.append((step[:, :3] * moments[-1]).sum(1) + step[:, 3])
    return moments[::-1]
