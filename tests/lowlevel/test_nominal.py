"""Nominal motion: reference filter, gait clock, march and balance."""

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import torch

from lowlevel.commands import (
    ARMS,
    HEIGHT,
    POSTURE,
    STANDING_SPEED,
    TORSO,
    VELOCITY,
    CommandSpace,
    command_space,
)
from lowlevel.nominal import NominalMotion
from lowlevel.nominal_config import NominalConfig
from lowlevel.nominal_state import NominalState
from robots.g1.constants import (
    ARM_JOINTS,
    DEFAULT_POSITION,
    FOOT_BODIES,
    GAINS,
    LOWER_JOINTS,
    WAIST_JOINTS,
    joint_index,
)
from robots.g1.kinematics import build_model
from robots.g1.mirror import JOINTS_MIRROR
from robots.g1.model import build_spec, joint_limits

LIMITS = joint_limits(build_spec().compile())
UPRIGHT = torch.tensor([[0.0, 0.0, -1.0]])
STILL = torch.zeros(1, 3)
DEFAULT = torch.tensor(DEFAULT_POSITION, dtype=torch.float32)[None]


@pytest.fixture(scope="module")
def space() -> CommandSpace:
    return command_space(LIMITS[:, 0].tolist(), LIMITS[:, 1].tolist())


def motion(**changes: object) -> NominalMotion:
    config = replace(NominalConfig(), **changes)  # type: ignore[arg-type]
    return NominalMotion(config, GAINS["stiff"], control_period=0.02)


def test_references_slew_at_their_rates_and_arrive(space: CommandSpace) -> None:
    nominal = motion()
    start = space.neutral()[None]
    command = start.clone()
    command[:, HEIGHT], command[:, TORSO.start + 1], command[:, ARMS.start] = 0.5, 0.6, 1.1
    state = NominalState.standing(start)
    state = nominal.advance(state, command)
    change = state.reference - start
    assert change[0, HEIGHT].item() == pytest.approx(-nominal.config.height_rate * 0.02, abs=1e-6)
    assert change[0, TORSO.start + 1].item() == pytest.approx(nominal.config.torso_rate[1] * 0.02)
    assert change[0, ARMS.start].item() == pytest.approx(nominal.config.arm_rate * 0.02)
    for _ in range(60):
        state = nominal.advance(state, command)
    assert torch.allclose(state.reference, command)


def test_clock_runs_while_walking_and_rests_while_standing(space: CommandSpace) -> None:
    nominal = motion(gait_frequency=2.0, velocity_rate=1.0, stopping_time=0.0)
    stand, walk = space.neutral()[None], space.neutral()[None].clone()
    walk[:, VELOCITY.start] = 0.5
    state = NominalState.standing(stand)
    for _ in range(50):
        state = nominal.advance(state, walk)
    assert state.walking.item() == 1.0
    assert np.cos(state.phase.item()) == pytest.approx(1.0, abs=1e-5)  # two whole periods in one second
    assert nominal.clock(state).norm().item() == pytest.approx(1.0)
    for _ in range(19):  # slowing down from 0.5 m/s at 1 m/s^2
        assert state.walking.item() == 1.0
        state = nominal.advance(state, stand)
    for _ in range(20):
        state = nominal.advance(state, stand)
    assert state.phase.item() == 0.0 and not nominal.clock(state).any()


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


def test_the_march_outlasts_a_stop(space: CommandSpace) -> None:
    stand, walk = space.neutral()[None], space.neutral()[None].clone()
    walk[:, VELOCITY.start] = 0.5

    def time_to_rest(nominal: NominalMotion) -> float:
        state = NominalState.standing(stand)
        for _ in range(50):
            state = nominal.advance(state, walk)
        steps = 0
        while state.walking.item() > 0.0:
            state = nominal.advance(state, stand)
            steps += 1
        return steps * 0.02

    outlasting, plain = motion(velocity_rate=1.0, stopping_time=1.8), motion(velocity_rate=1.0, stopping_time=0.0)
    longer = time_to_rest(outlasting) - time_to_rest(plain)
    assert longer == pytest.approx(0.8 * (0.5 - STANDING_SPEED), abs=0.05)


def test_a_robot_told_to_stop_settles_before_it_changes_posture(space: CommandSpace) -> None:
    nominal = motion()
    walk, squat = space.neutral()[None].clone(), space.neutral()[None].clone()
    walk[:, VELOCITY.start] = 0.4
    squat[:, HEIGHT], squat[:, ARMS] = 0.5, squat[:, ARMS] + 0.3

    def steps_until_it_moves(state: NominalState) -> int:
        for step in range(200):
            state = nominal.advance(state, squat)
            tracked = nominal.tracked_command(state, squat)
            assert torch.equal(tracked[:, VELOCITY], state.reference[:, VELOCITY])
            if torch.equal(tracked, squat):
                return step
            assert torch.equal(tracked[:, POSTURE], walk[:, POSTURE])
            assert torch.equal(tracked[:, ARMS], squat[:, ARMS])
        raise AssertionError("it never moves")

    standing = NominalState.standing(space.neutral()[None])
    assert steps_until_it_moves(standing) == 0
    walking = standing
    for _ in range(50):
        walking = nominal.advance(walking, walk)
    assert torch.equal(nominal.tracked_command(walking, walk), walk)
    slowing_down = (0.4 - STANDING_SPEED) * nominal.config.stopping_time
    expected = slowing_down + nominal.config.walking_ramp + nominal.config.settling_time
    # Each of the three ends within a control step, and steps count from zero.
    assert steps_until_it_moves(walking) * 0.02 == pytest.approx(expected, abs=4 * 0.02)
    from_the_start = NominalState.standing(space.neutral()[None], nominal.config.settling_time)
    assert steps_until_it_moves(from_the_start) * 0.02 == pytest.approx(nominal.config.settling_time, abs=0.03)
    at_once = motion(settling_time=0.0)
    stopping = at_once.advance(at_once.advance(walking, walk), squat)
    tracked = at_once.tracked_command(stopping, squat)
    assert torch.equal(tracked[:, VELOCITY.stop :], squat[:, VELOCITY.stop :])


def test_torso_yaw_waits_for_the_end_of_the_march_alone(space: CommandSpace) -> None:
    nominal = motion()
    turned = space.neutral()[None].clone()
    turned[:, HEIGHT], turned[:, TORSO.stop - 1] = 0.5, 1.0
    state = NominalState.standing(space.neutral()[None], nominal.config.settling_time)
    for walking, yaw in ((0.0, 1.0), (1.0, 0.0)):
        tracked = nominal.tracked_command(state._replace(walking=torch.full((1,), walking)), turned)
        assert tracked[0, HEIGHT].item() == space.neutral()[HEIGHT].item()
        assert tracked[0, TORSO.stop - 1].item() == yaw


def test_the_march_takes_up_a_lasting_velocity_error_within_bounds(space: CommandSpace) -> None:
    nominal = motion(velocity_trim_rate=0.5, velocity_trim_share=(0.05, 0.4))
    command = space.neutral()[None].clone()
    command[:, VELOCITY] = torch.tensor([0.6, 0.0, 0.0])
    state = NominalState.standing(command)._replace(walking=torch.ones(1))
    turning = torch.tensor([[0.0, 0.0, 0.1]])
    for _ in range(20):
        state = nominal.joint_targets(state, DEFAULT, UPRIGHT, turning, torch.tensor([[0.4, 0.1, 9.0]]))[1]
    assert state.velocity_trim[0].tolist() == pytest.approx([0.5 * 0.2 * 0.4, -0.5 * 0.1 * 0.4, -0.5 * 0.1 * 0.4])
    for _ in range(500):
        state = nominal.joint_targets(state, DEFAULT, UPRIGHT, turning, torch.zeros(1, 3))[1]
    assert state.velocity_trim[0, 0].item() == pytest.approx(0.05 + 0.4 * 0.6)
    standing = nominal.joint_targets(state._replace(walking=torch.zeros(1)), DEFAULT, UPRIGHT, STILL, STILL)[1]
    assert not standing.velocity_trim.any()


def test_the_waist_learns_to_take_back_what_repeats_with_the_gait(space: CommandSpace) -> None:
    """A pelvis whose yaw rate is a disturbance in time with the gait plus five times the waist's last turn."""
    command = space.neutral()[None].clone()
    command[:, VELOCITY] = torch.tensor([0.4, 0.0, 0.2])
    waist = joint_index("waist_yaw_joint")

    def remaining(largest: float, steps: int) -> tuple[float, float]:
        nominal = motion(swing_trim_lead=(math.pi,) * 3, largest_swing_trim=largest)
        still = motion(swing_trim_rate=0.0)
        state, turn, errors, turns = NominalState.standing(command), 0.0, [], []
        for _ in range(steps):
            state = nominal.advance(state, command)
            phase = state.phase.item()
            error = 0.3 * math.cos(phase) - 0.2 * math.sin(2.0 * phase) + 0.1 * math.sin(3.0 * phase) + 5.0 * turn
            turning = torch.tensor([[0.0, 0.0, 0.2 + error]])
            forgetful = state._replace(swing_trim=torch.zeros(1, 6))
            untrimmed = still.joint_targets(forgetful, DEFAULT, UPRIGHT, turning, STILL)[0]
            targets, state = nominal.joint_targets(state, DEFAULT, UPRIGHT, turning, STILL)
            turn = (targets - untrimmed)[0, waist].item()
            errors.append(abs(error))
            turns.append(abs(turn))
        return max(errors[-50:]), max(turns)

    error, turn = remaining(largest=0.15, steps=500)
    assert error < 0.1
    assert turn < 0.15
    error, turn = remaining(largest=0.01, steps=150)
    assert error > 0.3
    assert turn < 6 * 0.01


def test_the_lean_is_that_of_a_pendulum_on_the_reference_path(space: CommandSpace) -> None:
    """The acceleration that the march leans into is the path's second derivative, by finite differences."""
    nominal = motion(acceleration_time=0.0, velocity_rate=1.0)
    command, start = space.neutral()[None].clone(), space.neutral()[None]
    command[:, VELOCITY] = torch.tensor([0.8, -0.3, 0.5])
    state, heading, velocities, accelerations = NominalState.standing(start), 0.0, [], []
    for _ in range(80):
        state = nominal.advance(state, command)
        vx, vy, yaw_rate = state.reference[0, VELOCITY].tolist()
        heading += 0.02 * yaw_rate
        to_world = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
        velocities.append(to_world @ [vx, vy])
        accelerations.append(to_world @ state.acceleration[0].double().numpy())
    path = np.diff(velocities, axis=0) / 0.02
    assert np.abs(path[10]).max() > 0.9  # starts
    assert np.linalg.norm(path[-1]) == pytest.approx(0.5 * math.hypot(0.8, 0.3), rel=0.02)  # turns
    assert np.allclose(path, np.array(accelerations)[1:], atol=0.05)


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


def test_arms_follow_the_reference_in_every_kind(space: CommandSpace) -> None:
    command = space.neutral()[None].clone()
    command[:, ARMS] += 0.1
    for kind in ("default", "pose", "march"):
        nominal = motion(kind=kind, bear_arms=False)
        targets = nominal.joint_targets(NominalState.standing(command), DEFAULT, UPRIGHT, STILL, STILL)[0]
        assert torch.allclose(targets[:, ARM_JOINTS], command[:, ARMS])
    default = motion(kind="default")
    legs = default.joint_targets(NominalState.standing(command), DEFAULT, UPRIGHT, STILL, STILL)[0][0, :15]
    assert torch.allclose(legs, torch.tensor(DEFAULT_POSITION[:15], dtype=torch.float32))


def test_march_half_a_period_later_is_the_mirror_image(space: CommandSpace) -> None:
    nominal = motion()
    command = space.neutral()[None].clone()
    command[:, 0] = 0.8
    state = NominalState.standing(command)
    state.walking[:] = 1.0
    for phase in (0.4, 1.3, 2.9):
        state.phase[:] = phase
        now = nominal.joint_targets(state, DEFAULT, UPRIGHT, STILL, STILL)[0]
        state.phase[:] = phase + np.pi
        later = nominal.joint_targets(state, DEFAULT, UPRIGHT, STILL, STILL)[0]
        assert np.allclose(JOINTS_MIRROR(now.numpy()), later.numpy(), atol=2e-3)


def test_the_stride_leads_the_clock(space: CommandSpace) -> None:
    command = space.neutral()[None].clone()
    command[:, 0] = 0.8
    state = NominalState.standing(command)._replace(walking=torch.ones(1))
    hip = joint_index("left_hip_pitch_joint")

    def stride(nominal: NominalMotion, phase: float) -> float:
        moving = nominal.joint_targets(state._replace(phase=torch.tensor([phase])), DEFAULT, UPRIGHT, STILL, STILL)[0]
        return moving[0, hip].item()

    quiet = {"knee_lift": 0.0, "velocity_trim_rate": 0.0, "step_stiffness": 0.0, "step_damping": 0.0}
    late, early = motion(stride_lead=0.0, **quiet), motion(stride_lead=0.5, **quiet)
    assert stride(early, 0.3) == pytest.approx(stride(late, 0.8), abs=1e-5)
    assert stride(early, 0.3) != pytest.approx(stride(late, 0.3), abs=1e-2)


def test_march_lifts_the_swing_leg_only(space: CommandSpace) -> None:
    nominal = motion(lift_lead=0.0)
    state = NominalState.standing(space.neutral()[None])
    rest = nominal.joint_targets(state, DEFAULT, UPRIGHT, STILL, STILL)[0]
    state.walking[:], state.phase[:] = 1.0, np.pi / 2
    lifted = nominal.joint_targets(state, DEFAULT, UPRIGHT, STILL, STILL)[0] - rest
    assert lifted[0, joint_index("left_knee_joint")].item() == pytest.approx(nominal.config.knee_lift, abs=1e-5)
    assert lifted[0, joint_index("right_knee_joint")].item() == pytest.approx(0.0, abs=1e-6)


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


def test_the_pelvis_gives_way_to_outstretched_arms(space: CommandSpace) -> None:
    """The centre of mass stays nearly where it is with hanging arms, by Pinocchio's account."""
    model = build_model()
    data = model.createData()
    command = space.neutral()[None].clone()
    command[:, HEIGHT] = 0.6
    reaching = command.clone()
    left, right = (ARMS.start + joint_index(f"{side}_shoulder_pitch_joint") - 15 for side in ("left", "right"))
    reaching[:, left], reaching[:, right] = -1.2, -0.4
    reaching[:, ARMS.start + 1] = 0.8

    def center_over_feet(nominal: NominalMotion, posture: torch.Tensor) -> np.ndarray:
        state = NominalState.standing(posture)
        torque_free = replace(GAINS["stiff"], stiffness=np.full(29, np.inf))
        nominal = NominalMotion(nominal.config, torque_free, control_period=0.02)
        q = pin.neutral(model)
        q[7:] = nominal.joint_targets(state, DEFAULT, UPRIGHT, STILL, STILL)[0][0].double().numpy()
        pin.framesForwardKinematics(model, data, q)
        feet = [data.oMf[model.getFrameId(name)].translation for name in FOOT_BODIES]
        return pin.centerOfMass(model, data, q)[:2] - np.mean(feet, axis=0)[:2]

    still, carrying = motion(balance_stiffness=0.0, carry_arms=False), motion(balance_stiffness=0.0)
    at_rest = center_over_feet(still, command)
    moved = np.abs(center_over_feet(still, reaching) - at_rest).max()
    assert moved > 0.015
    # The legs' own mass moves less than the pelvis, so that a part remains.
    assert np.abs(center_over_feet(carrying, reaching) - at_rest).max() < 0.25 * moved
    np.testing.assert_allclose(center_over_feet(carrying, command), at_rest, atol=1e-6)


def test_arms_bear_their_own_weight(space: CommandSpace) -> None:
    """Lead of the arm targets times stiffness against Pinocchio's gravity torques, torso tilted."""
    model = build_model()
    data = model.createData()
    command = space.neutral()[None].clone()
    command[:, TORSO] = torch.tensor([0.2, 0.6, -0.4])
    command[:, HEIGHT] = 0.6
    command[:, ARMS] += 0.5 * torch.linspace(-1.0, 1.0, 14)
    state = NominalState.standing(command)
    leading = motion().joint_targets(state, DEFAULT, UPRIGHT, STILL, STILL)[0]
    lead = (leading[0, ARM_JOINTS] - command[0, ARMS]).double().numpy()
    waist = motion().pose.lookup(command[:, POSTURE]).position[:, WAIST_JOINTS]
    q = pin.neutral(model)
    q[3:7] = motion().pelvis_attitude(command[:, TORSO], waist)[0][[1, 2, 3, 0]].double().numpy()
    q[7:][WAIST_JOINTS], q[7:][ARM_JOINTS] = waist[0].double().numpy(), command[0, ARMS].double().numpy()
    expected = pin.computeGeneralizedGravity(model, data, q)[6:][ARM_JOINTS]
    assert np.abs(expected).max() > 2.0
    np.testing.assert_allclose(lead * GAINS["stiff"].stiffness[ARM_JOINTS], expected, atol=1e-3)


def test_waist_and_hips_bear_the_moment_of_the_arms(space: CommandSpace) -> None:
    """Waist torques against the change of Pinocchio's gravity torques, pelvis held."""
    model = build_model()
    data = model.createData()
    nominal = motion(balance_stiffness=0.0)
    command = space.neutral()[None].clone()
    command[:, TORSO] = torch.tensor([0.1, 0.5, 0.3])
    command[:, HEIGHT] = 0.6
    command[:, ARMS] += 0.4 * torch.linspace(-1.0, 1.0, 14)
    stance = nominal.pose.lookup(command[:, POSTURE])
    position = stance.position
    attitude = nominal._attitude(command, position, DEFAULT)
    loaded = nominal._carry_arms(nominal.arm_mass.first_moment(command[:, ARMS]), stance, attitude)
    added = (loaded.torque - stance.torque)[0, WAIST_JOINTS].double().numpy()

    def gravity(arms: np.ndarray) -> np.ndarray:
        q = pin.neutral(model)
        attitude = nominal.pelvis_attitude(command[:, TORSO], position[:, WAIST_JOINTS])[0].double()
        q[3:7] = attitude[[1, 2, 3, 0]].numpy()
        q[7:][LOWER_JOINTS], q[7:][ARM_JOINTS] = position[0].numpy(), arms
        return pin.computeGeneralizedGravity(model, data, q)[6:][WAIST_JOINTS]

    expected = gravity(command[0, ARMS].double().numpy()) - gravity(DEFAULT_POSITION[ARM_JOINTS])
    np.testing.assert_allclose(added, expected, atol=0.05)


def test_pelvis_attitude_puts_the_torso_where_it_should_be() -> None:
    torso, waist = torch.tensor([[0.2, 0.9, -0.6]]), torch.tensor([[-0.5, 0.1, 0.4]])
    pelvis = motion().pelvis_attitude(torso, waist)[0].double().tolist()
    rotation = pin.Quaternion(*pelvis).toRotationMatrix()
    yaw, roll, pitch = waist[0].tolist()
    chain = pin.utils.rotate("z", yaw) @ pin.utils.rotate("x", roll) @ pin.utils.rotate("y", pitch)
    np.testing.assert_allclose(rotation @ chain, pin.rpy.rpyToMatrix(*torso[0].tolist()), atol=1e-5)
