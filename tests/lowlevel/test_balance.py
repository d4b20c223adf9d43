"""Nominal motion: filtered senses, balance, and steps that catch a fall."""

import math

import numpy as np
import pinocchio as pin
import pytest
import torch
from nominal_motion import DEFAULT, STILL, UPRIGHT, g1_command_space, motion

from lowlevel.commands import HEIGHT, POSTURE, TORSO, VELOCITY, CommandSpace
from lowlevel.nominal_state import NominalState
from robots.g1.constants import LOWER_JOINTS, WAIST_JOINTS, joint_index


@pytest.fixture(scope="module")
def space() -> CommandSpace:
    return g1_command_space()


def test_a_robot_that_tips_over_marches_for_a_while(space: CommandSpace) -> None:
    nominal = motion()
    stand = space.neutral()[None]
    spinning = torch.tensor([[0.0, 3.0, 0.0]])
    state = NominalState.standing(stand)
    for _ in range(8):
        state = nominal.joint_targets(state._replace(gravity=UPRIGHT), DEFAULT, UPRIGHT, spinning, STILL)[1]
    assert state.unbalance.item() == pytest.approx(3.0 * nominal.config.step_damping, abs=0.1)
    state = nominal.advance(state, stand)._replace(unbalance=torch.zeros(1))
    marched = 0
    while state.walking.item() > 0.0:
        marched += 1
        state = nominal.advance(state, stand)
    assert marched * 0.02 == pytest.approx(nominal.config.stepping_time + nominal.config.walking_ramp, abs=0.05)


def test_gravity_is_filtered_without_delay() -> None:
    """A turning pelvis under a noisy gravity sensor: less noise than measured, and no lag behind the truth."""
    nominal = motion(gravity_gain=0.1)
    generator = torch.Generator().manual_seed(0)
    state = NominalState.standing(torch.zeros(1000, 21))
    rate = torch.tensor([0.0, 1.0, 0.0]).expand(1000, 3)
    for step in range(50):
        angle = 0.02 * step
        truth = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])
        noise = 0.03 * (2.0 * torch.rand(1000, 3, generator=generator) - 1.0)
        state = nominal._sense(state, truth + noise, rate)
    error = state.gravity - truth
    assert error.mean(dim=0).abs().max() < 2e-3
    assert error[:, :2].std() < 0.4 * noise[:, :2].std()


def test_a_lasting_tilt_is_no_unbalance(space: CommandSpace) -> None:
    leaning = torch.tensor([[np.sin(0.2), 0.0, -np.cos(0.2)]], dtype=torch.float32)
    for steady_time, lowest, highest in ((2.0, 0.0, 0.1), (0.0, 0.15, 0.25)):
        nominal = motion(steady_time=steady_time)
        state = NominalState.standing(space.neutral()[None])
        first = nominal.joint_targets(state, DEFAULT, leaning, STILL, STILL)[1]
        for _ in range(250):
            state = nominal.joint_targets(state, DEFAULT, leaning, STILL, STILL)[1]
        assert first.unbalance.item() > 0.15
        assert lowest <= state.unbalance.item() < highest


def test_the_waist_takes_up_a_lasting_torso_error(space: CommandSpace) -> None:
    """The torso pitches 0.1 rad too far forwards and rolls 0.05 rad too far to the right."""
    nominal = motion(balance_stiffness=1e-9, balance_damping=0.0, step_stiffness=0.0, torso_trim_rate=0.5)
    state = NominalState.standing(space.neutral()[None])
    tilted = pin.rpy.rpyToMatrix(0.05, 0.1, 0.0).T @ np.array([0.0, 0.0, -1.0])
    gravity = torch.tensor(tilted, dtype=torch.float32)[None]
    straight = DEFAULT.clone()
    straight[:, WAIST_JOINTS] = 0.0
    before = nominal.joint_targets(state, straight, UPRIGHT, STILL, STILL)[0]
    for _ in range(50):
        targets, state = nominal.joint_targets(state, straight, gravity, STILL, STILL)
    moved = (targets - before)[0, WAIST_JOINTS]
    assert moved.tolist() == pytest.approx([0.0, -0.05 * 0.5, -0.1 * 0.5], abs=2e-3)
    for _ in range(500):
        targets, state = nominal.joint_targets(state, straight, gravity, STILL, STILL)
    assert state.torso_trim[0, 1].item() == pytest.approx(nominal.config.largest_torso_trim)


def test_a_robot_that_leans_into_a_turn_is_in_balance(space: CommandSpace) -> None:
    command = space.neutral()[None].clone()
    command[:, VELOCITY] = torch.tensor([1.0, 0.0, 0.6])
    ankle = joint_index("left_ankle_roll_joint")
    state = NominalState.standing(command)._replace(walking=torch.ones(1), acceleration=torch.tensor([[0.0, 0.6]]))
    # A pelvis that leans to the left sees gravity point to its left.
    angle = -0.6 / 9.81
    leaning = torch.tensor([[0.0, -math.sin(angle), -math.cos(angle)]])
    quiet = {"lean": (0.0, 0.0), "step_stiffness": 0.0, "step_damping": 0.0, "velocity_trim_rate": 0.0, "creep": 0.0}
    turning, upright = motion(**quiet), motion(acceleration_lean=0.0, **quiet)
    balanced = upright.joint_targets(state, DEFAULT, UPRIGHT, STILL, STILL)[0][0, ankle].item()
    leans = turning.joint_targets(state._replace(gravity=leaning), DEFAULT, leaning, STILL, STILL)[0][0, ankle].item()
    stands = turning.joint_targets(state, DEFAULT, UPRIGHT, STILL, STILL)[0][0, ankle].item()
    assert leans == pytest.approx(balanced, abs=2e-3)
    assert abs(stands - balanced) > 0.1


def test_a_robot_in_a_deep_squat_only_marches_when_it_falls_and_rises_for_that(space: CommandSpace) -> None:
    nominal = motion()
    config = nominal.config
    squat = space.neutral()[None].clone()
    squat[:, HEIGHT], squat[:, TORSO.start + 1] = 0.4, 1.0
    swaying = NominalState.standing(squat)._replace(unbalance=torch.full((1,), config.recovery_threshold - 0.01))
    assert nominal.advance(swaying, squat).walking.item() == 0.0
    state = NominalState.standing(squat)._replace(unbalance=torch.full((1,), config.recovery_threshold + 0.01))
    heights = []
    for _ in range(400):
        state = nominal.advance(state, squat)._replace(unbalance=torch.zeros(1))
        heights.append(state.reference[0, HEIGHT].item())
    rising_time = min(config.stepping_time, (config.recovery_height - 0.4) / config.height_rate)
    assert max(heights) == pytest.approx(min(0.4 + rising_time * config.height_rate, config.recovery_height), abs=0.01)
    back = 0.02 * (len(heights) - heights[::-1].index(max(heights)))
    assert back == pytest.approx(config.stepping_time + config.walking_ramp + config.settling_time, abs=0.1)
    assert torch.allclose(state.reference, squat)


def test_a_robot_whose_command_moves_slowly_does_not_step_for_swaying(space: CommandSpace) -> None:
    """A planner's command stays within the slew rates, so that the reference keeps up with it all the way."""
    nominal = motion()
    between = 0.5 * (nominal.config.stepping_threshold + nominal.config.recovery_threshold)
    rising = space.neutral()[None].clone()
    rising[:, HEIGHT] = 0.6
    state = NominalState.standing(rising.clone())
    for _ in range(20):
        rising[:, HEIGHT] += 0.5 * nominal.config.height_rate * 0.02
        state = nominal.advance(state._replace(unbalance=torch.full((1,), between)), rising)
        assert state.reference[0, HEIGHT].item() == pytest.approx(rising[0, HEIGHT].item())
        assert state.walking.item() == 0.0
    for _ in range(2):
        state = nominal.advance(state._replace(unbalance=torch.full((1,), between)), rising)
    assert state.walking.item() > 0.0, "at rest it does"


def test_a_pelvis_that_moves_as_it_should_is_not_out_of_balance(space: CommandSpace) -> None:
    """The gravity and the gyroscope of a pelvis that follows its nominal pitch with the lag that is reckoned with."""
    bend = space.neutral()[None].clone()
    bend[:, TORSO.start + 1] = 0.8

    def largest_unbalance(reckoned: float, lag: float = 0.08) -> float:
        nominal = motion(attitude_lag=reckoned, gravity_gain=1.0, rate_gain=1.0, carry_arms=False)
        state = NominalState.standing(space.neutral()[None])
        pitch, largest = None, 0.0
        for _ in range(60):
            state = nominal.advance(state, bend)
            waist = nominal.pose.lookup(state.reference[:, POSTURE]).position[0, WAIST_JOINTS]
            wanted = state.reference[0, TORSO.start + 1].item() - waist[2].item()
            before = wanted if pitch is None else pitch
            pitch = before + 0.02 / (lag + 0.02) * (wanted - before)
            gravity = torch.tensor([[np.sin(pitch), 0.0, -np.cos(pitch)]], dtype=torch.float32)
            spin = torch.tensor([[0.0, (pitch - before) / 0.02, 0.0]], dtype=torch.float32)
            state = nominal.joint_targets(state, DEFAULT, gravity, spin, STILL)[1]
            largest = max(largest, state.unbalance.item())
        return largest

    assert largest_unbalance(reckoned=0.08) < 0.01
    assert largest_unbalance(reckoned=0.0) > 0.03


def test_ankles_push_against_tilt_and_vanish_at_the_nominal_attitude(space: CommandSpace) -> None:
    nominal, without = motion(), motion(balance_stiffness=0.0)
    state = NominalState.standing(space.neutral()[None])
    stance = DEFAULT.clone()
    stance[:, LOWER_JOINTS] = nominal.pose.lookup(state.reference[:, POSTURE]).position
    attitude = nominal.pelvis_attitude(state.reference[:, TORSO], stance[:, WAIST_JOINTS])
    rotation = pin.Quaternion(*attitude[0].double().tolist()).toRotationMatrix()
    nominal_gravity = torch.tensor(rotation.T @ np.array([0, 0, -1.0]), dtype=torch.float32)[None]
    base = without.joint_targets(state, stance, nominal_gravity, STILL, STILL)[0]
    assert torch.allclose(nominal.joint_targets(state, stance, nominal_gravity, STILL, STILL)[0], base, atol=1e-6)
    forwards = torch.tensor([[np.sin(0.1), 0.0, -np.cos(0.1)]], dtype=torch.float32)
    leaning = nominal.joint_targets(state, stance, forwards, STILL, STILL)[0] - base
    assert leaning[0, joint_index("left_ankle_pitch_joint")] > 0.1  # toes down pushes the body back
