"""A bare gait that shows an untrained policy what stepping and standing are; it exists in training only.

Three motions: the swing leg lifts, the pelvis shifts over the stance foot, and the legs stride. Two answers: at a stand
the legs press against the capture point, because motors that hold a pose at their gains do not hold the robot; while it
walks the stance leg presses against a wrong speed. PPO finds such answers too, but takes tens of millions of steps.

The stride is fitted to the speed that is told while the robot learns: a prior that walks at half of it leaves a policy
that walks at half of it, long after the prior has gone, because the tracking rewards are flat far from their goal. When
the robot walks, policy and prior are cloned into the policy alone (:mod:`lowlevel.absorption`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.commands import VELOCITY
from lowlevel.control.reference import ReferenceState
from lowlevel.control.stepping import FARTHEST
from lowlevel.runs.distributed import sum_over_ranks
from robots.g1.constants import NUM_JOINTS, joint_index

_PRESS = {"ankle_pitch": 1.0, "knee": 0.25, "hip_pitch": 0.2}
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
    # Feet closer to each other, and level.
    {"left_hip_roll": -1.0, "right_hip_roll": 1.0, "left_ankle_roll": 1.0, "right_ankle_roll": -1.0},
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
    shift: float = 0.06
    """Amplitude of the hip roll that moves the pelvis over the stance foot [rad]."""
    narrowing: float = 0.04
    """Hip roll that brings the feet closer to each other than the hips are [rad]: the pelvis sways less."""
    stride: tuple[float, float, float] = (0.4, 0.4, 0.2)
    """First hip swing per told vx, vy [rad per m/s] and yaw rate [rad per rad/s]. Half a stride is v T / 4 and the leg
    0.7 m long, which makes 0.22; loaded hips follow short of it."""
    stride_lead: float = 0.8
    """Phase by which the stride leads the gait clock, because loaded hips follow late [rad]."""
    balance: float = 8.0
    """Ankle pitch at a stand per distance by which the capture point lies ahead of the feet [rad/m]."""
    braking: float = 0.3
    """Ankle pitch of the stance leg per m/s by which the robot walks too fast [rad]."""
    turning_back: float = 0.0
    """Hip yaw of the stance leg per rad/s by which the robot turns too fast [rad]."""
    fitting_rate: float = 0.06
    """Share of the stride's error that one update takes back."""


class GaitPrior:
    """The prior as a function of reference and motion, and the fit of its stride.

    ``stride`` (3, 4): amplitudes of the three strides per told (vx, vy, yaw rate, 1). The last column is a creep: what
    the robot walks when it is told to mark time.
    """

    def __init__(self, config: GaitPriorConfig, device: torch.device | str = "cpu") -> None:
        self.config = config
        rows = torch.zeros(len(_ROWS), NUM_JOINTS)
        for row, joints in zip(rows, _ROWS, strict=True):
            for joint, share in joints.items():
                row[joint_index(f"{joint}_joint")] = share
        self._rows = rows.to(device)
        self.stride = first_stride(config).to(device)
        self._told_told = torch.zeros(4, 4, device=device)
        self._told_walked = torch.zeros(4, 3, device=device)

    def __call__(self, state: ReferenceState, capture_point: Tensor, velocity_error: Tensor) -> Tensor:
        """Offsets of the joint targets (N, 29) [rad].

        ``capture_point`` (N, 2) [m], from the middle between the feet, and running mean of the ``velocity_error`` (N,
        3) [m/s, m/s, rad/s], heading frame.
        """
        config, sine = self.config, torch.sin(state.phase)
        # The square lets the foot come to rest as it lands.
        lift = config.lift * torch.stack([sine, -sine], dim=1).clamp_min(0.0).square()
        swing = torch.cos(state.phase + config.stride_lead)[:, None]
        stride = swing * (_with_one(state.command[:, VELOCITY]) @ self.stride.T)
        narrowing = torch.full_like(swing, config.narrowing)
        # Beyond FARTHEST the robot steps.
        balance = config.balance * capture_point[:, :1].clamp(-FARTHEST, FARTHEST) * ~state.walking[:, None]
        stance = torch.stack([sine < 0.0, sine > 0.0], dim=1)
        forwards, _, turning = velocity_error.clamp(-1.0, 1.0).split(1, dim=1)
        answers = [config.braking * forwards * stance, config.turning_back * turning * stance]
        gait = torch.cat([lift, config.shift * sine[:, None], stride, narrowing], dim=1) * state.walking[:, None]
        return torch.cat([gait, balance, *answers], dim=1) @ self._rows

    def observe(self, told: Tensor, walked: Tensor) -> None:
        """Take in the velocities that robots were told and walked at, each (n, 3) in the heading frame."""
        inputs = _with_one(told)
        self._told_told += inputs.T @ inputs
        self._told_walked += inputs.T @ walked

    def fit(self) -> None:
        """Move the stride towards one with which robots walk as told, by what was observed over all ranks.

        A linear fit says how they walk for what they are told. What it mixes of forwards with sideways and turning is
        chance, because the robot is symmetric. No amplitude moves by more than half of the first one.
        """
        told_told, told_walked = sum_over_ranks(torch.cat([self._told_told, self._told_walked], dim=1)).split((4, 3), 1)
        self._told_told.zero_(), self._told_walked.zero_()
        if told_told[3, 3] < 1000.0:
            return
        walks = torch.linalg.solve(told_told + torch.eye(4, device=told_told.device), told_walked).T
        error = torch.eye(3, 4, device=walks.device) - walks
        symmetric = torch.tensor([[1, 0, 0, 1], [0, 1, 1, 0], [0, 1, 1, 0]], device=walks.device)
        first = first_stride(self.config).to(walks.device)
        scale = first.sum(dim=1, keepdim=True)
        change = self.config.fitting_rate * scale * error.clamp(-1.0, 1.0) * symmetric
        self.stride = first + (self.stride + change - first).clamp(-0.5 * scale, 0.5 * scale)


def first_stride(config: GaitPriorConfig | None) -> Tensor:
    """The stride (3, 4) before any fit; zero without prior."""
    if config is None:
        return torch.zeros(3, 4)
    return torch.cat([torch.tensor(config.stride).diag(), torch.zeros(3, 1)], dim=1)


def _with_one(told: Tensor) -> Tensor:
    return torch.cat([told, torch.ones_like(told[:, :1])], dim=1)
