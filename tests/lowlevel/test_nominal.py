"""Nominal motion: reference filter, gait clock, march, and what bears the arms."""

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import torch
from nominal_motion import DEFAULT, STILL, UPRIGHT, g1_command_space, motion

from lowlevel.commands import ARMS, HEIGHT, POSTURE, STANDING_SPEED, TORSO, VELOCITY, CommandSpace
from lowlevel.nominal import NominalMotion
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


@pytest.fixture(scope="module")
def space() -> CommandSpace:
    return g1_command_space()


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


def test_a_negative_lag_is_refused() -> None:
    with pytest.raises(ValueError, match="attitude_lag must not be negative"):
        motion(attitude_lag=-0.02)


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
