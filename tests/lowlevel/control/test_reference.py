"""The reference: slew rates, the gait clock, and joint targets that hold the robot up."""

import math

import mujoco
import numpy as np
import pytest
import torch

from lowlevel.commands import ARMS, HEIGHT, POSTURE, TORSO, VELOCITY, CommandSpace, command_space
from lowlevel.control.reference import Reference, ReferenceConfig, ReferenceState
from lowlevel.gait_prior import GaitPrior, GaitPriorConfig
from robots.g1.constants import GAINS, NUM_JOINTS, WAIST_JOINTS, joint_index
from robots.g1.mirror import JOINTS_MIRROR
from robots.g1.model import build_spec, joint_limits
from robots.g1.waist import pelvis_attitude

CONFIG = ReferenceConfig()


@pytest.fixture(scope="module")
def reference() -> Reference:
    return Reference(CONFIG, GAINS["stiff"], control_period=0.02)


@pytest.fixture(scope="module")
def space() -> CommandSpace:
    limits = joint_limits(build_spec().compile())
    return command_space(limits[:, 0].tolist(), limits[:, 1].tolist())


def test_nothing_moves_faster_than_its_slew_rate_and_all_of_it_arrives(
    reference: Reference, space: CommandSpace
) -> None:
    start = space.neutral()[None]
    command = reference.clamp(start + torch.tensor([0.8, 0.3, -0.6, -0.2, 0.1, 0.4, -0.5] + [0.4] * 14))
    state = ReferenceState.standing(start)
    largest = torch.zeros(1, 21)
    for _ in range(100):
        after = reference.advance(state, command)
        largest = torch.maximum(largest, (after.command - state.command).abs() / 0.02)
        state = after
    assert torch.allclose(state.command, command)
    assert largest[0, VELOCITY].tolist() == pytest.approx([CONFIG.velocity_rate] * 3, rel=1e-3)
    assert largest[0, HEIGHT].item() == pytest.approx(CONFIG.height_rate, rel=1e-3)
    assert largest[0, TORSO].tolist() == pytest.approx(CONFIG.torso_rate, rel=1e-3)
    assert largest[0, ARMS].tolist() == pytest.approx([CONFIG.arm_rate] * 14, rel=1e-3)


def test_the_robot_is_told_to_slow_down_more_gently_than_to_speed_up(reference: Reference, space: CommandSpace) -> None:
    fast = space.neutral()[None]
    fast[:, VELOCITY] = torch.tensor([0.9, -0.4, 0.6])
    changes = reference.advance(ReferenceState.standing(fast), space.neutral()[None]).command - fast
    expected = 0.02 * CONFIG.braking_rate * torch.tensor([-1.0, 1.0, -1.0])
    torch.testing.assert_close(changes[0, VELOCITY], expected)


def test_the_clock_runs_at_its_frequency(reference: Reference, space: CommandSpace) -> None:
    stand, walk = space.neutral()[None], space.neutral()[None]
    walk[:, 0] = 0.5
    state, phases = ReferenceState.standing(stand), []
    assert not reference.advance(state, stand).walking.any()
    for _ in range(50):
        state = reference.advance(state, walk)
        phases.append(state.phase.item())
    traveled = np.unwrap(phases)[-1]
    assert traveled == pytest.approx(2.0 * math.pi * CONFIG.gait_frequency, rel=1e-3)


@pytest.mark.parametrize("steps", [20, 30, 40, 47])
def test_a_robot_told_to_stop_lands_twice_and_may_walk_on_in_between(
    reference: Reference, space: CommandSpace, steps: int
) -> None:
    stand, walk = space.neutral()[None], space.neutral()[None]
    walk[:, 0] = 0.12  # two steps of the control loop below the speed that counts as walking
    state = ReferenceState.standing(stand)
    for _ in range(steps):
        state = reference.advance(state, walk)
    while (state.command[:, 0] >= 0.1).any():
        state = reference.advance(state, stand)
    begin, stopping = state, []
    while state.walking.any():
        stopping.append(state.clock[0])
        state = reference.advance(state, stand)
        assert len(stopping) < 50
    swings = torch.sign(torch.stack(stopping)[:, 0]).unique_consecutive()
    assert len(swings) == 2 and (state.clock == 0.0).all()
    continued = reference.advance(reference.advance(begin, stand), walk)
    uninterrupted = reference.advance(reference.advance(begin, walk), walk)
    torch.testing.assert_close(continued.clock, uninterrupted.clock)


def test_a_robot_stops_before_it_squats_and_stands_up_before_it_walks(
    reference: Reference, space: CommandSpace
) -> None:
    walk, squat = space.neutral()[None], space.neutral()[None]
    walk[:, 0], squat[:, HEIGHT], squat[:, TORSO.start + 1] = 0.6, 0.4, 0.9
    state = ReferenceState.standing(space.neutral()[None])
    seen = []
    for command in (walk, squat, walk):
        for _ in range(200):
            state = reference.advance(state, command)
            deep = state.command[0, HEIGHT] < 0.549 or state.command[0, TORSO.start + 1] > 0.501
            seen.append((bool(state.walking), bool(deep)))
        expected = {"walk": (True, False), "squat": (False, True)}["squat" if command is squat else "walk"]
        assert seen[-1] == expected
        torch.testing.assert_close(state.command, command)
    assert (True, True) not in seen


def test_arm_targets_lead_by_what_gravity_would_make_them_sag(reference: Reference, space: CommandSpace) -> None:
    """Against MuJoCo's gravity torques in a bent posture."""
    model = build_spec().compile()
    data = mujoco.MjData(model)
    command = space.neutral()[None]
    command[0, HEIGHT], command[0, TORSO.start + 1] = 0.55, 0.8
    command[0, ARMS] += 0.3
    command = reference.clamp(command)
    lower = reference.pose.lookup(command[:, POSTURE]).position
    data.qpos[3:7] = pelvis_attitude(command[:, TORSO], lower[:, WAIST_JOINTS])[0].numpy()
    data.qpos[7:] = torch.cat([lower, command[:, ARMS]], dim=1)[0].numpy()
    mujoco.mj_forward(model, data)
    lead = reference.joint_targets(ReferenceState.standing(command))[0, 15:] - command[0, ARMS]
    torque = lead.numpy() * GAINS["stiff"].stiffness[15:]
    np.testing.assert_allclose(torque, data.qfrc_bias[6 + 15 :], atol=2e-3)


def test_the_priors_legs_take_turns_and_its_ankles_answer_at_a_stand(reference: Reference, space: CommandSpace) -> None:
    prior, centered, as_told = GaitPrior(GaitPriorConfig()), torch.zeros(2, 2), torch.zeros(2, 3)
    command = space.neutral().repeat(2, 1)
    command[:, VELOCITY] = torch.tensor([0.6, 0.0, 0.0])
    assert (prior(ReferenceState.standing(command), centered, as_told + 0.1) == 0.0).all()
    topples = prior(ReferenceState.standing(command), torch.tensor([[0.08, 0.0], [0.0, 0.08]]), as_told)
    ankles = [joint_index(f"{side}_ankle_pitch_joint") for side in ("left", "right")]
    assert topples[0, ankles].tolist() == pytest.approx([0.08 * GaitPriorConfig().balance] * 2)
    assert topples[0].count_nonzero() == 6 and topples[1].count_nonzero() == 0
    halves = prior(ReferenceState(command, torch.tensor([1.0, 1.0 + math.pi])), centered + 0.1, as_told)
    np.testing.assert_allclose(halves[1].numpy(), JOINTS_MIRROR(halves[0].numpy()), atol=1e-6)
    middle = prior(ReferenceState(command[:1], torch.tensor([math.pi / 2])), centered[:1], as_told[:1])[0]
    assert middle[joint_index("left_knee_joint")].item() == pytest.approx(GaitPriorConfig().lift)
    assert middle[joint_index("right_knee_joint")].item() == 0.0
    too_fast = prior(ReferenceState(command, torch.tensor([1.0, 1.0 + math.pi])), centered, as_told + 0.1) - halves
    assert too_fast.nonzero().tolist() == [[0, ankles[1]], [1, ankles[0]]] and (too_fast >= 0.0).all()
    assert halves.shape == (2, NUM_JOINTS)
