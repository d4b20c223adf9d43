"""Staged reward: progress of a potential in which every passed stage is saturated, plus costs.

The form is that of MuJoCo Playground's AlohaHandOver: max(potential - best so far, 0) plus a small stream of
the potential itself. The success bonus exceeds what the stream would pay for never finishing.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tasks.lift_box.config import RewardConfig, StageConfig
from tasks.lift_box.geometry import Situation
from tasks.lift_box.stages import APPROACH, GRASP, REACH, Progress

STAND_OFF = 0.30
"""Distance of the near face ahead of the pelvis that the approach aims at [m]."""
PALM_BELOW_TOP = 0.07
"""Where the palms go, below the top edge [m]: any lower and the forearms touch the faces before the palms
do."""


def grasp_posture(palm_height: Tensor) -> tuple[Tensor, Tensor]:
    """Base height [m] and torso pitch [rad] (N,) from which the palms reach ``palm_height`` (N,) [m].

    A line through the postures at which inverse kinematics finds both side faces of a box.
    """
    above = palm_height - 0.18
    height = (0.42 + 0.60 * above).clamp(0.38, 0.72)
    pitch = (1.15 - 1.30 * above).clamp(0.15, 1.25)
    return height, pitch


def potential(
    situation: Situation,
    progress: Progress,
    size: Tensor,
    support_height: Tensor,
    rewards: RewardConfig,
    stages: StageConfig,
) -> Tensor:
    """How far the episode has come (N,), from zero to the sum of the weights."""
    stage = progress.stage
    ahead = (situation.near_face[:, 0] - STAND_OFF).clamp_min(0.0)
    away = torch.stack([ahead, situation.near_face[:, 1]], -1).norm(dim=-1)
    approach = torch.exp(-2.0 * away) * torch.exp(-situation.yaw_error.abs())
    approach = torch.where(stage >= APPROACH, 1.0, approach)

    height, pitch = grasp_posture(support_height + size[:, 2] - PALM_BELOW_TOP)
    posture = torch.exp(
        -(((situation.base_height - height) / 0.15) ** 2) - ((situation.torso_pitch - pitch) / 0.5) ** 2
    )
    closeness = torch.exp(-8.0 * situation.palm_distance)
    both_close = 2.0 * closeness.prod(dim=1) / closeness.sum(dim=1).clamp_min(1e-6)
    near = (stage >= APPROACH).float()
    posture = torch.where(stage >= REACH, 1.0, near * posture)
    reach = torch.where(stage >= REACH, 1.0, near * both_close)

    squeeze = (situation.palm_force.amin(dim=1) / rewards.grasp_force).clamp(max=1.0)
    grasp = torch.where(stage >= GRASP, 1.0, (stage >= REACH).float() * both_close * squeeze)

    held = (progress.touching.all(dim=1) & (stage >= GRASP)).float()
    clearance = (situation.bottom - support_height) / (stages.carry_clearance + rewards.lift_margin)
    lift = held * clearance.clamp(0.0, 1.0)
    straight = torch.exp(-((situation.torso_pitch / 0.5) ** 2))
    risen = ((situation.base_height - 0.45) / (stages.upright_height - 0.45)).clamp(0.0, 1.0)
    return (
        rewards.approach * approach
        + rewards.posture * posture
        + rewards.reach * reach
        + rewards.grasp * grasp
        + rewards.lift * lift
        + rewards.upright * lift * straight * risen
    )


def costs(situation: Situation, progress: Progress, change: Tensor, rewards: RewardConfig) -> Tensor:
    """Costs of one decision (N,), not positive; ``change`` (N, 21) is the command's change over the largest
    change."""
    moved = (situation.box_pose[:, :2] - progress.start_position).norm(dim=-1)
    excess = (situation.palm_force - rewards.force_limit).clamp_min(0.0).sum(dim=1)
    before_grasp = (progress.stage < GRASP).float()
    return (
        rewards.command_rate * change.square().sum(dim=-1)
        + rewards.over_force * excess
        + rewards.box_moved * before_grasp * (moved - 0.05).clamp(0.0, 1.0)
        + rewards.box_tilt * (situation.tilt - 0.5).clamp_min(0.0)
    )
