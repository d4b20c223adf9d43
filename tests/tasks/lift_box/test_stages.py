"""Stages latch in order, contacts have hysteresis, and potentials saturate."""

from __future__ import annotations

import itertools
from dataclasses import replace

import torch

from tasks.lift_box.config import RewardConfig, StageConfig
from tasks.lift_box.geometry import Situation
from tasks.lift_box.reward import costs, grasp_posture, potential
from tasks.lift_box.stages import GRASP, HOLD, LIFT, STAGES, Progress, advance, failure_name

_PERIOD = 0.02
_SIZE, _SUPPORT = torch.full((1, 3), 0.3), torch.zeros(1)

_FAR = Situation(
    box_pose=torch.tensor([[0.0, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0]]),
    near_face=torch.tensor([[1.5, 0.4, -0.6]]),
    yaw_error=torch.tensor([0.6]),
    speed=torch.tensor([0.5]),
    palm_offset=torch.ones(1, 2, 3),
    palm_distance=torch.ones(1, 2),
    palm_force=torch.zeros(1, 2),
    bottom=torch.zeros(1),
    tilt=torch.zeros(1),
    torso_pitch=torch.zeros(1),
    base_height=torch.tensor([0.76]),
)
_NEAR = replace(_FAR, near_face=torch.tensor([[0.3, 0.0, -0.6]]), yaw_error=torch.zeros(1), speed=torch.zeros(1))
_REACHED = replace(_NEAR, palm_distance=torch.full((1, 2), 0.01))
_SQUEEZED = replace(_REACHED, palm_force=torch.tensor([[20.0, 25.0]]))
_LIFTED = replace(_SQUEEZED, bottom=torch.tensor([0.15]))
_UPRIGHT = replace(_SQUEEZED, bottom=torch.tensor([0.40]))


def _run(progress: Progress, situation: Situation, seconds: float) -> None:
    for _ in range(round(seconds / _PERIOD)):
        advance(progress, situation, _SUPPORT, StageConfig(), _PERIOD)


def test_a_whole_episode_passes_every_stage_in_order() -> None:
    progress = Progress.empty(1)
    seen = []
    for situation, seconds in (
        (_FAR, 1.0),
        (_NEAR, 0.1),
        (_REACHED, 0.1),
        (_SQUEEZED, 0.3),
        (_LIFTED, 0.1),
        (_UPRIGHT, 1.0),
        (_UPRIGHT, 0.6),
    ):
        _run(progress, situation, seconds)
        seen.append(progress.stage.item())
    assert seen == [0, 1, 2, 3, 4, 5, 6] and progress.stage.item() == HOLD == len(STAGES)


def test_stages_stay_passed_and_cannot_be_skipped() -> None:
    progress = Progress.empty(1)
    _run(progress, _UPRIGHT, 3.0)
    assert progress.stage.item() == HOLD, "an approached, reached, squeezed and lifted box passes all in turn"
    progress = Progress.empty(1)
    beside = replace(_UPRIGHT, near_face=torch.tensor([[0.9, 0.0, -0.6]]))
    _run(progress, beside, 3.0)
    assert progress.stage.item() == 0, "without the approach nothing counts"
    _run(progress, _NEAR, 0.1)
    _run(progress, _FAR, 1.0)
    assert progress.stage.item() == 1


def test_contact_needs_both_palms_for_a_while_and_has_hysteresis() -> None:
    progress = Progress.empty(1)
    _run(progress, _REACHED, 0.1)
    one = replace(_REACHED, palm_force=torch.tensor([[20.0, 1.0]]))
    _run(progress, one, 1.0)
    assert progress.touching.tolist() == [[True, False]] and progress.stage.item() < GRASP
    _run(progress, _SQUEEZED, 0.1)
    weak = replace(_REACHED, palm_force=torch.tensor([[3.0, 3.0]]))
    _run(progress, weak, 0.2)
    assert progress.stage.item() == GRASP, "3 N keep a contact that 20 N began"
    fresh = Progress.empty(1)
    _run(fresh, weak, 1.0)
    assert not fresh.touching.any(), "3 N do not begin one"


def test_times_are_counted_in_control_steps() -> None:
    config, progress = StageConfig(), Progress.empty(1)
    _run(progress, _REACHED, 0.1)
    _run(progress, _SQUEEZED, config.contact_time - _PERIOD)
    assert progress.stage.item() < GRASP
    _run(progress, _SQUEEZED, _PERIOD)
    assert progress.stage.item() == GRASP
    progress = Progress.empty(1)
    _run(progress, _LIFTED, 0.6)
    _run(progress, _UPRIGHT, config.hold_time - _PERIOD)
    assert progress.stage.item() < HOLD
    _run(progress, _UPRIGHT, _PERIOD)
    assert progress.stage.item() == HOLD


def test_losing_a_lifted_box_is_noticed_and_holding_starts_over() -> None:
    progress = Progress.empty(1)
    _run(progress, _LIFTED, 0.6)
    assert progress.stage.item() == LIFT
    _run(progress, _UPRIGHT, 1.0)
    gone = replace(_UPRIGHT, palm_force=torch.zeros(1, 2))
    _run(progress, gone, 0.2)
    assert progress.hold_time.item() == 0.0 and 0.15 < progress.lost_time.item() < 0.25
    _run(progress, _UPRIGHT, 0.1)
    assert progress.lost_time.item() == 0.0
    _run(progress, replace(_UPRIGHT, tilt=torch.tensor([0.6])), 2.0)
    assert progress.hold_time.item() == 0.0


def _value(situation: Situation, progress: Progress) -> float:
    return potential(situation, progress, _SIZE, _SUPPORT, RewardConfig(), StageConfig()).item()


def test_the_potential_grows_along_the_way_to_the_sum_of_the_weights() -> None:
    progress, values = Progress.empty(1), []
    for situation in (_FAR, _NEAR, _REACHED, _SQUEEZED, _LIFTED, _UPRIGHT):
        _run(progress, situation, 0.3)
        values.append(_value(situation, progress))
    assert all(after > before + 0.1 for before, after in itertools.pairwise(values)), values
    assert abs(values[-1] - 12.5) < 1e-5


def test_lifting_pays_only_with_both_palms() -> None:
    progress = Progress.empty(1)
    _run(progress, _LIFTED, 0.6)
    held = _value(_LIFTED, progress)
    dropped = replace(_LIFTED, palm_force=torch.tensor([[20.0, 0.0]]))
    _run(progress, dropped, 0.1)
    assert _value(dropped, progress) < held - 1.0


def test_a_box_held_with_a_margin_is_worth_more_than_one_on_the_threshold() -> None:
    progress, rewards, stages = Progress.empty(1), RewardConfig(), StageConfig()
    _run(progress, _UPRIGHT, 1.0)
    on_threshold = replace(_UPRIGHT, bottom=torch.tensor([stages.carry_clearance]))
    with_margin = replace(_UPRIGHT, bottom=torch.tensor([stages.carry_clearance + rewards.lift_margin]))
    share = rewards.lift_margin / (stages.carry_clearance + rewards.lift_margin)
    gained = _value(with_margin, progress) - _value(on_threshold, progress)
    assert abs(gained - share * (rewards.lift + rewards.upright)) < 1e-5


def test_the_success_bonus_exceeds_the_stream_of_never_finishing() -> None:
    rewards = RewardConfig()
    best = rewards.approach + rewards.posture + rewards.reach + rewards.grasp + rewards.lift + rewards.upright
    assert rewards.success > rewards.stream * best / (1.0 - 0.98)


def test_costs_count_what_they_say() -> None:
    progress, rewards = Progress.empty(1), RewardConfig()
    still = torch.zeros(1, 21)
    assert costs(_NEAR, progress, still, rewards).item() == 0.0
    assert abs(costs(_NEAR, progress, torch.ones(1, 21), rewards).item() + 0.42) < 1e-6
    crushed = replace(_NEAR, palm_force=torch.tensor([[70.0, 65.0]]))
    assert abs(costs(crushed, progress, still, rewards).item() + 0.3) < 1e-6
    pushed = replace(_NEAR, box_pose=torch.tensor([[0.15, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0]]))
    assert abs(costs(pushed, progress, still, rewards).item() + 0.1) < 1e-6
    progress.stage[:] = GRASP
    assert costs(pushed, progress, still, rewards).item() == 0.0


def test_the_grasp_posture_bends_deeper_for_lower_boxes() -> None:
    height, pitch = grasp_posture(torch.tensor([0.18, 0.4, 0.6]))
    assert (height.diff() > 0).all() and (pitch.diff() < 0).all()
    assert height[0] == 0.42 and abs(pitch[0].item() - 1.15) < 1e-6


def test_failures_are_named_by_what_was_missing() -> None:
    assert failure_name(4, fallen=True, dropped=True) == "fall"
    assert failure_name(4, fallen=False, dropped=True) == "drop"
    names = [failure_name(stage, False, False) for stage in range(6)]
    assert names == ["approach_timeout", "no_contact", "no_contact", "slip", "not_upright", "timeout"]
