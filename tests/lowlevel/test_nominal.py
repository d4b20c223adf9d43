"""Nominal motion: reference filter, gait clock, march and balance."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import torch

from lowlevel.commands import ARMS, HEIGHT, TORSO, VELOCITY, CommandSpace, command_space
from lowlevel.nominal import NominalConfig, NominalMotion
from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, GAINS, WAIST_JOINTS, joint_index
from robots.g1.mirror import JOINTS_MIRROR
from robots.g1.model import build_spec, joint_limits

LIMITS = joint_limits(build_spec().compile())
UPRIGHT = torch.tensor([[0.0, 0.0, -1.0]])
STILL = torch.zeros(1, 3)


@pytest.fixture(scope="module")
def space() -> CommandSpace:
    return command_space(LIMITS[:, 0].tolist(), LIMITS[:, 1].tolist())


def motion(**changes: object) -> NominalMotion:
    config = replace(NominalConfig(), **changes)  # type: ignore[arg-type]
    lower, upper = torch.tensor(LIMITS, dtype=torch.float32).unbind(1)
    return NominalMotion(config, GAINS["stiff"], lower, upper, control_period=0.02)


def test_references_slew_at_their_rates_and_arrive(space: CommandSpace) -> None:
    nominal = motion()
    start = space.neutral()[None]
    command = start.clone()
    command[:, HEIGHT], command[:, TORSO.start + 1], command[:, ARMS.start] = 0.5, 0.6, 1.1
    state = nominal.initial_state(start)
    state = nominal.advance(state, command)
    change = state.reference - start
    assert change[0, HEIGHT].item() == pytest.approx(-0.5 * 0.02)
    assert change[0, TORSO.start + 1].item() == pytest.approx(1.5 * 0.02)
    assert change[0, ARMS.start].item() == pytest.approx(4.0 * 0.02)
    for _ in range(60):
        state = nominal.advance(state, command)
    assert torch.allclose(state.reference, command)


def test_clock_runs_while_walking_and_rests_while_standing(space: CommandSpace) -> None:
    nominal = motion()
    stand, walk = space.neutral()[None], space.neutral()[None].clone()
    walk[:, VELOCITY.start] = 0.5
    state = nominal.initial_state(stand)
    for _ in range(50):
        state = nominal.advance(state, walk)
    assert state.walking.item() == 1.0
    assert np.cos(state.phase.item()) == pytest.approx(1.0, abs=1e-5)  # two whole periods in one second
    assert nominal.clock(state).norm().item() == pytest.approx(1.0)
    for _ in range(20):
        state = nominal.advance(state, stand)
    assert state.phase.item() == 0.0 and not nominal.clock(state).any()


def test_arms_follow_the_reference_in_every_kind(space: CommandSpace) -> None:
    command = space.neutral()[None].clone()
    command[:, ARMS] += 0.1
    for kind in ("default", "pose", "march"):
        nominal = motion(kind=kind)
        targets = nominal.joint_targets(nominal.initial_state(command), UPRIGHT, STILL)
        assert torch.allclose(targets[:, ARM_JOINTS], command[:, ARMS])
    default = motion(kind="default")
    legs = default.joint_targets(default.initial_state(command), UPRIGHT, STILL)[0, :15]
    assert torch.allclose(legs, torch.tensor(DEFAULT_POSITION[:15], dtype=torch.float32))


def test_march_half_a_period_later_is_the_mirror_image(space: CommandSpace) -> None:
    nominal = motion()
    command = space.neutral()[None].clone()
    command[:, 0] = 0.8
    state = nominal.initial_state(command)
    state.walking[:] = 1.0
    for phase in (0.4, 1.3, 2.9):
        state.phase[:] = phase
        now = nominal.joint_targets(state, UPRIGHT, STILL)
        state.phase[:] = phase + np.pi
        later = nominal.joint_targets(state, UPRIGHT, STILL)
        assert np.allclose(JOINTS_MIRROR(now.numpy()), later.numpy(), atol=2e-3)


def test_march_lifts_the_swing_leg_only(space: CommandSpace) -> None:
    nominal = motion()
    state = nominal.initial_state(space.neutral()[None])
    rest = nominal.joint_targets(state, UPRIGHT, STILL)
    state.walking[:], state.phase[:] = 1.0, np.pi / 2
    lifted = nominal.joint_targets(state, UPRIGHT, STILL) - rest
    assert lifted[0, joint_index("left_knee_joint")].item() == pytest.approx(0.8, abs=1e-5)
    assert lifted[0, joint_index("right_knee_joint")].item() == pytest.approx(0.0, abs=1e-6)


def test_ankles_push_against_tilt_and_vanish_at_the_nominal_attitude(space: CommandSpace) -> None:
    nominal, without = motion(), motion(balance_stiffness=0.0)
    state = nominal.initial_state(space.neutral()[None])
    attitude = nominal.pelvis_attitude(
        state.reference[:, TORSO], nominal.pose.lookup(state.reference[:, 3:7])[0][:, WAIST_JOINTS]
    )
    rotation = pin.Quaternion(*attitude[0].double().tolist()).toRotationMatrix()
    nominal_gravity = torch.tensor(rotation.T @ np.array([0, 0, -1.0]), dtype=torch.float32)[None]
    base = without.joint_targets(state, nominal_gravity, STILL)
    assert torch.allclose(nominal.joint_targets(state, nominal_gravity, STILL), base, atol=1e-6)
    forwards = torch.tensor([[np.sin(0.1), 0.0, -np.cos(0.1)]], dtype=torch.float32)
    leaning = nominal.joint_targets(state, forwards, STILL) - base
    assert leaning[0, joint_index("left_ankle_pitch_joint")] > 0.1  # toes down pushes the body back


def test_pelvis_attitude_puts_the_torso_where_it_should_be() -> None:
    torso, waist = torch.tensor([[0.2, 0.9, -0.6]]), torch.tensor([[-0.5, 0.1, 0.4]])
    pelvis = motion().pelvis_attitude(torso, waist)[0].double().tolist()
    rotation = pin.Quaternion(*pelvis).toRotationMatrix()
    yaw, roll, pitch = waist[0].tolist()
    chain = pin.utils.rotate("z", yaw) @ pin.utils.rotate("x", roll) @ pin.utils.rotate("y", pitch)
    np.testing.assert_allclose(rotation @ chain, pin.rpy.rpyToMatrix(*torso[0].tolist()), atol=1e-5)
