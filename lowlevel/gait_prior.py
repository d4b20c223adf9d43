"""A bare gait that shows an untrained policy what stepping and standing are; it exists in training only.

Three motions: the swing leg lifts, the pelvis shifts over the stance foot, and the legs stride. Two answers: at a stand
the legs press against the capture point, because motors that hold a pose at their gains do not hold the robot; while it
walks the stance leg presses against a wrong speed. PPO finds such answers too, but takes tens of millions of steps.

The stride must fit the speed that is told: a prior that walks at half of it leaves a policy that walks at half of it,
long after the prior has gone, because the tracking rewards are flat far from their goal. When the robot walks, policy
and prior are cloned into the policy alone (:mod:`lowlevel.imitation.cloning`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.commands import VELOCITY
from lowlevel.control.reference import ReferenceState
from lowlevel.control.stepping import FARTHEST
from robots.g1.constants import NUM_JOINTS, joint_index

_PRESS = {"ankle_pitch": 1.0, "knee": 0.25, "hip_pitch": 0.2}
"""What each joint of a leg adds to a press on the toes, as a share of what the ankle does."""
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
    # Both legs press the weight back from the toes; each ankle alone; each hip turns the pelvis back.
    {f"{side}_{joint}": share for side in ("left", "right") for joint, share in _PRESS.items()},
    {"left_ankle_pitch": 1.0},
    {"right_ankle_pitch": 1.0},
    {"left_hip_yaw": 1.0},
    {"right_hip_yaw": 1.0},
)


@dataclass(frozen=True)
class GaitPriorConfig:
    """Size of the prior's motions and answers."""

    lift: float = 0.9
    """Knee flexion at mid-swing [rad]."""
    shift: float = 0.1
    """Amplitude of the hip roll that moves the pelvis over the stance foot [rad]."""
    stride: tuple[float, float, float] = (0.35, 0.25, 0.25)
    """Hip swing per told vx, vy [rad per m/s] and yaw rate [rad per rad/s]. Half a stride is v T / 4 and the leg
    0.7 m long, which makes 0.25 at 1.43 Hz; loaded hips follow short of it."""
    stride_lead: float = 0.7
    """Phase by which the stride leads the gait clock, because loaded hips follow late [rad]."""
    balance: float = 8.0
    """Ankle pitch at a stand per distance by which the capture point lies ahead of the feet [rad/m]; knees and hips do
    their shares of it."""
    braking: float = 0.3
    """Ankle pitch of the stance leg per m/s by which the robot walks too fast [rad]."""
    turning_back: float = 0.0
    """Hip yaw of the stance leg per rad/s by which the robot turns too fast [rad]."""


class GaitPrior:
    """The prior as a function of reference and motion."""

    def __init__(self, config: GaitPriorConfig, device: torch.device | str = "cpu") -> None:
        self.config = config
        rows = torch.zeros(len(_ROWS), NUM_JOINTS)
        for row, joints in zip(rows, _ROWS, strict=True):
            for joint, share in joints.items():
                row[joint_index(f"{joint}_joint")] = share
        self._rows = rows.to(device)
        self._stride = torch.tensor(config.stride, device=device)

    def __call__(self, state: ReferenceState, capture_point: Tensor, velocity_error: Tensor) -> Tensor:
        """Offsets of the joint targets (N, 29) [rad].

        ``capture_point`` (N, 2) [m], from the middle between the feet, and running mean of the ``velocity_error`` (N,
        3) [m/s, m/s, rad/s], heading frame.
        """
        config, sine = self.config, torch.sin(state.phase)
        # The square lets the foot come to rest as it lands.
        lift = config.lift * torch.stack([sine, -sine], dim=1).clamp_min(0.0).square()
        swing = torch.cos(state.phase + config.stride_lead)[:, None]
        stride = swing * state.command[:, VELOCITY] * self._stride
        # Beyond FARTHEST the robot steps.
        balance = config.balance * capture_point[:, :1].clamp(-FARTHEST, FARTHEST) * ~state.walking[:, None]
        stance = torch.stack([sine < 0.0, sine > 0.0], dim=1)
        # What is faster than 1 m/s or 1 rad/s is a fall.
        forwards, _, turning = velocity_error.clamp(-1.0, 1.0).split(1, dim=1)
        answers = [config.braking * forwards * stance, config.turning_back * turning * stance]
        gait = torch.cat([lift, config.shift * sine[:, None], stride], dim=1) * state.walking[:, None]
        return torch.cat([gait, balance, *answers], dim=1) @ self._rows
