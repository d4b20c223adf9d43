"""Stages of an episode: each is passed once, in order, and stays passed."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from tasks.lift_box.config import StageConfig
from tasks.lift_box.geometry import Situation

STAGES = ("approach", "reach", "grasp", "lift", "upright", "hold")
APPROACH, REACH, GRASP, LIFT, UPRIGHT, HOLD = range(1, 7)
"""Number of stages passed once the named one is."""


@dataclass
class Progress:
    """What lives across the control steps of an episode; one row per robot."""

    stage: Tensor
    """Stages passed (N,) integers."""
    touching: Tensor
    """Palms in contact, with hysteresis (N, 2) booleans."""
    contact_time: Tensor
    """How long both palms have touched (N,) [s]."""
    lost_time: Tensor
    """How long a palm has been missing since the box was lifted (N,) [s]."""
    hold_time: Tensor
    """How long the box has been held upright (N,) [s]."""
    best_potential: Tensor
    """Largest potential so far (N,)."""
    start_position: Tensor
    """Where the box stood (N, 2) [m]."""

    @classmethod
    def empty(cls, count: int) -> Progress:
        """Progress of ``count`` episodes that have not begun."""

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(count, *shape)

        return cls(
            stage=torch.zeros(count, dtype=torch.long),
            touching=torch.zeros(count, 2, dtype=torch.bool),
            contact_time=zeros(),
            lost_time=zeros(),
            hold_time=zeros(),
            best_potential=zeros(),
            start_position=zeros(2),
        )

    def clear(self, ids: Tensor) -> None:
        """Begin new episodes in rows ``ids``."""
        for item in fields(self):
            getattr(self, item.name)[ids] = 0


@dataclass(frozen=True)
class Conditions:
    """Which stage's condition holds at one instant (N,) booleans."""

    approached: Tensor
    reached: Tensor
    grasped: Tensor
    lifted: Tensor
    upright: Tensor
    held: Tensor


def advance(
    progress: Progress, situation: Situation, support_height: Tensor, config: StageConfig, period: float
) -> Conditions:
    """Update ``progress`` by one control step of ``period`` [s]; at most one stage is passed per step."""
    on, off = situation.palm_force > config.contact_on, situation.palm_force > config.contact_off
    progress.touching = on | (progress.touching & off)
    both = progress.touching.all(dim=1)
    progress.contact_time = torch.where(both, progress.contact_time + period, 0.0)
    clearance = situation.bottom - support_height

    upright = (
        both
        & (situation.base_height > config.upright_height)
        & (situation.torso_pitch.abs() < config.upright_pitch)
        & (clearance > config.carry_clearance)
    )
    still = upright & (situation.tilt < config.hold_tilt) & (situation.speed < config.hold_speed)
    progress.hold_time = torch.where(still, progress.hold_time + period, 0.0)
    conditions = Conditions(
        approached=(situation.near_face[:, 0] < config.approach_distance)
        & (situation.near_face[:, 1].abs() < config.approach_lateral)
        & (situation.yaw_error.abs() < config.approach_yaw)
        & (situation.speed < config.approach_speed),
        reached=(situation.palm_distance < config.reach_distance).all(dim=1),
        grasped=lasted(progress.contact_time, config.contact_time, period),
        lifted=both & (clearance > config.lift_clearance),
        upright=upright,
        held=lasted(progress.hold_time, config.hold_time, period),
    )
    passed = torch.stack([getattr(conditions, item.name) for item in fields(conditions)], dim=1)
    following = progress.stage.clamp(max=len(STAGES) - 1)
    progress.stage = progress.stage + (passed.gather(1, following[:, None])[:, 0] & (progress.stage < len(STAGES)))
    progress.lost_time = torch.where((progress.stage >= LIFT) & ~both, progress.lost_time + period, 0.0)
    return conditions


def lasted(time: Tensor, wanted: float, period: float) -> Tensor:
    """Whether ``time`` (N,) [s], a sum of control ``period`` s [s], has reached ``wanted`` [s] (N,).

    Half a period decides, because a float32 sum may end on either side of the number that it stands for.
    """
    return time > wanted - 0.5 * period


def failure_name(stage: int, fallen: bool, dropped: bool) -> str:
    """Why an episode failed that had passed ``stage`` stages."""
    if fallen:
        return "fall"
    if dropped:
        return "drop"
    return ("approach_timeout", "no_contact", "no_contact", "slip", "not_upright", "timeout")[min(stage, 5)]
