"""Nominal motion: reference filter, gait clock, march and balance."""

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
from lowlevel.nominal import NominalConfig, NominalMotion, NominalState
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
BALANCED = torch.zeros(1)


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
    state = nominal.initial_state(start)
    state = nominal.advance(state, command, BALANCED)
    change = state.reference - start
    assert change[0, HEIGHT].item() == pytest.approx(-0.25 * 0.02)
    assert change[0, TORSO.start + 1].item() == pytest.approx(1.0 * 0.02)
    assert change[0, ARMS.start].item() == pytest.approx(4.0 * 0.02)
    for _ in range(60):
        state = nominal.advance(state, command, BALANCED)
    assert torch.allclose(state.reference, command)


def test_clock_runs_while_walking_and_rests_while_standing(space: CommandSpace) -> None:
    nominal = motion()
    stand, walk = space.neutral()[None], space.neutral()[None].clone()
    walk[:, VELOCITY.start] = 0.5
    state = nominal.initial_state(stand)
    for _ in range(50):
        state = nominal.advance(state, walk, BALANCED)
    assert state.walking.item() == 1.0
    assert np.cos(state.phase.item()) == pytest.approx(1.0, abs=1e-5)  # two whole periods in one second
    assert nominal.clock(state).norm().item() == pytest.approx(1.0)
    for _ in range(19):  # slowing down from 0.5 m/s at 1 m/s^2
        assert state.walking.item() == 1.0
        state = nominal.advance(state, stand, BALANCED)
    for _ in range(20):
        state = nominal.advance(state, stand, BALANCED)
    assert state.phase.item() == 0.0 and not nominal.clock(state).any()


def test_a_robot_that_tips_over_marches_for_a_while(space: CommandSpace) -> None:
    nominal = motion()
    stand = space.neutral()[None]
    spinning = torch.tensor([[0.0, 2.0, 0.0]])
    state = nominal.initial_state(stand)
    unbalance = nominal.joint_targets(state, UPRIGHT, spinning)[1]
    assert unbalance.item() == pytest.approx(2.0 * nominal.config.step_damping, abs=0.02)
    state = nominal.advance(state, stand, unbalance)
    marched = 0
    while state.walking.item() > 0.0:
        marched += 1
        state = nominal.advance(state, stand, BALANCED)
    assert marched * 0.02 == pytest.approx(nominal.config.stepping_time + nominal.config.walking_ramp, abs=0.05)


def test_a_robot_told_to_stop_settles_before_it_changes_posture(space: CommandSpace) -> None:
    nominal = motion()
    walk, squat = space.neutral()[None].clone(), space.neutral()[None].clone()
    walk[:, VELOCITY.start] = 0.4
    squat[:, HEIGHT], squat[:, ARMS] = 0.5, squat[:, ARMS] + 0.3

    def steps_until_it_moves(state: NominalState) -> int:
        for step in range(200):
            state = nominal.advance(state, squat, BALANCED)
            tracked = nominal.tracked_command(state, squat)
            assert torch.equal(tracked[:, VELOCITY], state.reference[:, VELOCITY])
            if torch.equal(tracked, squat):
                return step
            assert torch.equal(tracked[:, POSTURE], walk[:, POSTURE])
            assert torch.equal(tracked[:, ARMS], squat[:, ARMS])
        raise AssertionError("it never moves")

    standing = nominal.initial_state(space.neutral()[None])
    assert steps_until_it_moves(standing) == 0
    walking = standing
    for _ in range(50):
        walking = nominal.advance(walking, walk, BALANCED)
    assert torch.equal(nominal.tracked_command(walking, walk), walk)
    slowing_down = (0.4 - STANDING_SPEED) / nominal.config.velocity_rate
    expected = slowing_down + nominal.config.walking_ramp + nominal.config.settling_time
    # Each of the three ends within a control step, and steps count from zero.
    assert steps_until_it_moves(walking) * 0.02 == pytest.approx(expected, abs=4 * 0.02)
    at_once = motion(settling_time=0.0)
    stopping = at_once.advance(at_once.advance(walking, walk, BALANCED), squat, BALANCED)
    tracked = at_once.tracked_command(stopping, squat)
    assert torch.equal(tracked[:, VELOCITY.stop :], squat[:, VELOCITY.stop :])


def test_a_robot_in_a_deep_squat_does_not_march(space: CommandSpace) -> None:
    nominal = motion()
    squat = space.neutral()[None].clone()
    squat[:, HEIGHT] = 0.4
    assert nominal.advance(nominal.initial_state(squat), squat, torch.ones(1)).walking.item() == 0.0


def test_arms_follow_the_reference_in_every_kind(space: CommandSpace) -> None:
    command = space.neutral()[None].clone()
    command[:, ARMS] += 0.1
    for kind in ("default", "pose", "march"):
        nominal = motion(kind=kind)
        targets = nominal.joint_targets(nominal.initial_state(command), UPRIGHT, STILL)[0]
        assert torch.allclose(targets[:, ARM_JOINTS], command[:, ARMS])
    default = motion(kind="default")
    legs = default.joint_targets(default.initial_state(command), UPRIGHT, STILL)[0][0, :15]
    assert torch.allclose(legs, torch.tensor(DEFAULT_POSITION[:15], dtype=torch.float32))


def test_march_half_a_period_later_is_the_mirror_image(space: CommandSpace) -> None:
    nominal = motion()
    command = space.neutral()[None].clone()
    command[:, 0] = 0.8
    state = nominal.initial_state(command)
    state.walking[:] = 1.0
    for phase in (0.4, 1.3, 2.9):
        state.phase[:] = phase
        now = nominal.joint_targets(state, UPRIGHT, STILL)[0]
        state.phase[:] = phase + np.pi
        later = nominal.joint_targets(state, UPRIGHT, STILL)[0]
        assert np.allclose(JOINTS_MIRROR(now.numpy()), later.numpy(), atol=2e-3)


def test_march_lifts_the_swing_leg_only(space: CommandSpace) -> None:
    nominal = motion()
    state = nominal.initial_state(space.neutral()[None])
    rest = nominal.joint_targets(state, UPRIGHT, STILL)[0]
    state.walking[:], state.phase[:] = 1.0, np.pi / 2
    lifted = nominal.joint_targets(state, UPRIGHT, STILL)[0] - rest
    assert lifted[0, joint_index("left_knee_joint")].item() == pytest.approx(nominal.config.knee_lift, abs=1e-5)
    assert lifted[0, joint_index("right_knee_joint")].item() == pytest.approx(0.0, abs=1e-6)


def test_ankles_push_against_tilt_and_vanish_at_the_nominal_attitude(space: CommandSpace) -> None:
    nominal, without = motion(), motion(balance_stiffness=0.0)
    state = nominal.initial_state(space.neutral()[None])
    attitude = nominal.pelvis_attitude(
        state.reference[:, TORSO], nominal.pose.lookup(state.reference[:, 3:7])[0][:, WAIST_JOINTS]
    )
    rotation = pin.Quaternion(*attitude[0].double().tolist()).toRotationMatrix()
    nominal_gravity = torch.tensor(rotation.T @ np.array([0, 0, -1.0]), dtype=torch.float32)[None]
    base = without.joint_targets(state, nominal_gravity, STILL)[0]
    assert torch.allclose(nominal.joint_targets(state, nominal_gravity, STILL)[0], base, atol=1e-6)
    forwards = torch.tensor([[np.sin(0.1), 0.0, -np.cos(0.1)]], dtype=torch.float32)
    leaning = nominal.joint_targets(state, forwards, STILL)[0] - base
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
        state = nominal.initial_state(posture)
        torque_free = replace(GAINS["stiff"], stiffness=np.full(29, np.inf))
        nominal = NominalMotion(nominal.config, torque_free, control_period=0.02)
        q = pin.neutral(model)
        q[7:] = nominal.joint_targets(state, UPRIGHT, STILL)[0][0].double().numpy()
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
    loaded = nominal._carry_arms(command[:, ARMS], stance, nominal._attitude(command, position))
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
