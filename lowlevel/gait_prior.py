"""A bare gait that shows an untrained policy what stepping is; it exists in training only.

No feedback, three motions: the swing leg lifts, the pelvis shifts over the stance foot, and the legs stride. The
stride fits the speed that is told: a prior that walks at half of it leaves a policy that walks at half of it, long
after the prior has gone, because the tracking rewards are flat far from their goal. When the robot walks, policy and
prior are cloned into the policy alone (:mod:`lowlevel.absorption`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.commands import VELOCITY
from lowlevel.reference import ReferenceState
from robots.g1.constants import NUM_JOINTS, joint_index

_ROWS: tuple[dict[str, float], ...] = (
    # Lift of the left foot, of the right foot: the knee flexes, hip and ankle take half of it back.
    {"left_hip_pitch": -0.5, "left_knee": 1.0, "left_ankle_pitch": -0.5},
    {"right_hip_pitch": -0.5, "right_knee": 1.0, "right_ankle_pitch": -0.5},
    # Shift of the pelvis over the stance foot.
    {"left_hip_roll": 1.0, "right_hip_roll": 1.0, "left_ankle_roll": -1.0, "right_ankle_roll": -1.0},
    # Stride forwards, sideways and around: the legs swing against each other and the feet stay level.
    {"left_hip_pitch": 1.0, "right_hip_pitch": -1.0, "left_ankle_pitch": -1.0, "right_ankle_pitch": 1.0},
    {"left_hip_roll": -1.0, "right_hip_roll": 1.0, "left_ankle_roll": 1.0, "right_ankle_roll": -1.0},
    {"left_hip_yaw": -1.0, "right_hip_yaw": 1.0},
)


@dataclass(frozen=True)
class GaitPriorConfig:
    """Size of the prior's rows."""

    lift: float = 0.9
    """Knee flexion at mid-swing [rad]."""
    shift: float = 0.10
    """Amplitude of the hip roll that moves the pelvis over the stance foot [rad]."""
    stride: tuple[float, float, float] = (0.35, 0.3, 0.35)
    """Hip swing per told vx, vy [rad per m/s] and yaw rate [rad per rad/s]. Half a stride is v T / 4 and the leg
    0.7 m long, which makes 0.25; loaded hips follow short of it."""
    stride_lead: float = 0.7
    """Phase by which the stride leads the gait clock, because loaded hips follow late [rad]."""


class GaitPrior:
    """The prior as a function of the reference alone."""

    def __init__(self, config: GaitPriorConfig, device: torch.device | str = "cpu") -> None:
        self.config = config
        rows = torch.zeros(len(_ROWS), NUM_JOINTS)
        for row, joints in zip(rows, _ROWS, strict=True):
            for joint, share in joints.items():
                row[joint_index(f"{joint}_joint")] = share
        self._rows = rows.to(device)
        self._stride = torch.tensor(config.stride, device=device)

    def __call__(self, state: ReferenceState) -> Tensor:
        """Offsets of the joint targets (N, 29) [rad]; zero while standing."""
        config, sine = self.config, torch.sin(state.phase)
        # The square lets the foot come to rest as it lands.
        lift = config.lift * torch.stack([sine, -sine], dim=1).clamp_min(0.0).square()
        swing = torch.cos(state.phase + config.stride_lead)[:, None]
        stride = swing * state.command[:, VELOCITY] * self._stride
        amounts = torch.cat([lift, config.shift * sine[:, None], stride], dim=1)
        return (amounts * state.walking[:, None]) @ self._rows
