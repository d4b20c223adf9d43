"""Reward terms against hand-computed values, and the error that names a bad term."""

from dataclasses import replace

import pytest
import torch

from lowlevel.environment import EnvironmentConfig, PilotEnvironment
from lowlevel.rewards import REWARD_TERMS, RewardWeights, Transition, compute_rewards, tracking_quality
from lowlevel.runs.checks import NonFiniteError
from lowlevel.world.measures import Measurement, has_fallen, is_lost, stumbles, torso_error
from robots.rotations import from_roll_pitch_yaw


@pytest.fixture(scope="module")
def standing() -> Transition:
    """Four robots that have just been reset, upright, at zero velocity command."""
    environment = PilotEnvironment(EnvironmentConfig(num_robots=4, num_threads=1, start_in_posture=0.0))
    environment.reset()
    command = environment.command_space.neutral().repeat(4, 1)
    zeros = torch.zeros(4, 29)
    return Transition(
        measured=environment.world.measure(),
        command=command,
        flag=torch.ones(4, 1),
        action=zeros,
        previous_action=zeros,
        nominal_target=zeros,
        phase=torch.zeros(4),
        walking=torch.zeros(4, dtype=torch.bool),
        gait_frequency=1.25,
        foot_air_time=torch.zeros(4, 2),
        foot_contact_time=torch.zeros(4, 2),
        mean_velocity_error=torch.zeros(4, 3),
        fallen=torch.zeros(4, dtype=torch.bool),
    )


def moved(transition: Transition, **changes: torch.Tensor) -> Transition:
    """The transition with some measured quantities replaced."""
    derived = {name: value for name, value in changes.items() if hasattr(transition.measured, name)}
    robot = {name: value for name, value in changes.items() if name not in derived}
    measured: Measurement = replace(transition.measured, robot=replace(transition.measured.robot, **robot), **derived)
    return replace(transition, measured=measured)


def term(name: str, transition: Transition) -> list[float]:
    return REWARD_TERMS[name](transition).tolist()


def test_tracking_kernels(standing: Transition) -> None:
    velocity = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.36, 0.48, 9.0], [0.0, 0.0, 0.0]])
    still = moved(standing, linear_velocity=velocity, yaw_rate=torch.tensor([0.0, 0.5, -1.0, 0.0]))
    assert term("linear_velocity", still) == pytest.approx([1.0, 0.3679, 0.1353, 1.0], abs=1e-4)
    assert term("angular_velocity", still) == pytest.approx([1.0, 0.3679, 0.1353, 1.0], abs=1e-4)
    heights = moved(standing, base_height=torch.tensor([0.76, 0.71, 0.81, 0.66]))
    assert term("base_height", heights) == pytest.approx([1.0, 0.3679, 0.3679, 0.1353], abs=1e-4)


def test_capture_point_counts_unless_it_is_told_to_walk(standing: Transition) -> None:
    point = torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.0, -0.2], [0.3, 0.4]])
    command = standing.command.clone()
    command[3, 0] = 0.5
    catches_itself = torch.tensor([False, False, True, True])
    seen = replace(moved(standing, capture_point=point), command=command, walking=catches_itself)
    assert term("capture_point", seen) == pytest.approx([1.0, 0.3679, 0.1353, 1.0], abs=1e-4)


def test_torso_error_is_the_rotation_between_the_attitudes(standing: Transition) -> None:
    command = standing.command.clone()
    command[:, 4:7] = torch.tensor([0.1, 1.4, -0.5])
    exact = moved(standing, torso_orientation=from_roll_pitch_yaw(command[:, 4:7]))
    assert torso_error(exact.measured, command).abs().max() < 1e-6
    pitched = moved(standing, torso_orientation=from_roll_pitch_yaw(torch.tensor([[0.0, 0.3, 0.0]]).repeat(4, 1)))
    assert torch.allclose(
        torso_error(pitched.measured, standing.command), torch.tensor([0.0, 0.3, 0.0]).expand(4, 3), atol=1e-6
    )


def test_contact_terms(standing: Transition) -> None:
    contact = torch.tensor([[True, True], [True, False], [False, False], [True, True]])
    velocity = torch.zeros(4, 2, 3)
    velocity[:, 0, 0], velocity[:, 1, 1] = 0.3, 0.4
    feet = moved(standing, foot_contact=contact, foot_velocity=velocity)
    assert term("no_fly", feet) == [1.0, 0.0, 0.0, 1.0]
    marching = replace(feet, walking=torch.ones(4, dtype=torch.bool))
    assert term("no_fly", marching) == [0.0, 1.0, 0.0, 0.0]
    assert term("feet_slippage", feet) == pytest.approx([0.7, 0.3, 0.0, 0.7])


def test_air_time_counts_the_shorter_role_up_to_its_limit(standing: Transition) -> None:
    walking = replace(
        moved(standing, foot_contact=torch.tensor([[True, False]] * 4)),
        command=standing.command.index_fill(1, torch.tensor([0]), 0.5),
        foot_contact_time=torch.tensor([[0.1, 0.0], [0.3, 0.0], [0.9, 0.0], [0.2, 0.0]]),
        foot_air_time=torch.tensor([[0.0, 0.2], [0.0, 0.2], [0.0, 0.9], [0.0, 0.2]]),
    )
    assert term("feet_air_time", walking) == pytest.approx([0.1, 0.2, 0.4, 0.2])
    assert term("feet_air_time", replace(walking, command=standing.command)) == [0.0] * 4


def test_gait_terms_follow_the_clock(standing: Transition) -> None:
    """At a quarter of the cycle the left foot is at mid-swing and the right one bears the robot."""
    walking = replace(standing, phase=torch.full((4,), torch.pi / 2), walking=torch.ones(4, dtype=torch.bool))
    clearance = torch.tensor([[0.06, 0.0], [0.04, 0.0], [0.0, 0.0], [0.0, 0.06]])
    contact = torch.tensor([[False, True], [True, True], [False, False], [True, False]])
    feet = moved(walking, foot_clearance=clearance, foot_contact=contact)
    assert term("contact_schedule", feet) == [1.0, 0.5, 0.5, 0.0]
    assert term("swing_height", feet) == pytest.approx([0.75, 0.5, 0.0, 0.0])
    errors = [0.02**2, 0.04**2, 0.08**2, 0.08**2 + 0.06**2]
    assert term("foot_phase", feet) == pytest.approx([2.718281828 ** (-error / 0.005) for error in errors])
    still = replace(feet, walking=torch.zeros(4, dtype=torch.bool))
    assert term("swing_height", still) == [0.0] * 4


def test_a_swing_is_low_where_a_fast_foot_lacks_height(standing: Transition) -> None:
    velocity = torch.zeros(4, 2, 3)
    velocity[:, 0, 0], velocity[:3, 1, 1] = 1.0, 0.5
    velocity[:, 0, 2] = 3.0  # upwards is no fault
    clearance = torch.tensor([[0.08, 0.1], [0.02, 0.08], [0.04, 0.04], [-0.01, 0.0]])
    feet = moved(standing, foot_velocity=velocity, foot_clearance=clearance)
    assert term("low_swing", feet) == pytest.approx([0.0, 0.5625, 0.25 * 1.5, 1.0])


def test_feet_are_to_be_where_the_told_velocity_needs_them(standing: Transition) -> None:
    """At 0.5 m/s and 1.25 Hz the robot goes 0.4 m per cycle, so that landing feet are 0.2 m apart along the heading."""
    command = standing.command.index_fill(1, torch.tensor([0]), 0.5)
    walking = torch.ones(4, dtype=torch.bool)
    landing = replace(standing, command=command, phase=torch.full((4,), torch.pi), walking=walking)
    right = torch.tensor([[1.0, 1.0, 0.0]]).repeat(4, 1)
    left = right + torch.tensor([[0.2, 0.18, 0.0], [0.1, 0.18, 0.0], [0.2, 0.28, 0.0], [-0.2, 0.18, 0.0]])
    placed = moved(landing, foot_position=torch.stack([left, right], dim=1))
    squares = [0.0, 0.01, 0.01, 0.16]
    assert term("foot_placement", placed) == pytest.approx([2.718281828 ** (-s / 0.02) for s in squares], rel=1e-4)


def test_torques_near_the_motors_limits_cost(standing: Transition) -> None:
    torque = torch.zeros(4, 29)
    torque[1, 3], torque[2, 3], torque[3, 14] = 0.8 * 139.0, -139.0, 45.0
    assert term("torque_limits", moved(standing, joint_torque=torque)) == pytest.approx([0.0, 0.0, 0.2, 0.1], abs=1e-5)


def test_stumbling_compares_sideways_with_vertical_force(standing: Transition) -> None:
    force = torch.zeros(4, 2, 3)
    force[0, 0] = torch.tensor([60.0, 0.0, 50.0])
    force[1, 0] = torch.tensor([40.0, 0.0, 50.0])
    force[2, 1] = torch.tensor([3.0, 0.0, 1.0])
    contact = force.norm(dim=-1) > 5.0
    assert stumbles(moved(standing, foot_force=force, foot_contact=contact).measured).tolist() == [
        True,
        False,
        False,
        False,
    ]


def test_a_step_of_the_command_is_not_a_fall_but_a_tilt_is(standing: Transition) -> None:
    assert not is_lost(standing.measured, standing.command).any()
    tilted = moved(standing, torso_orientation=from_roll_pitch_yaw(torch.tensor([[1.0, 0.0, 0.0]]).repeat(4, 1)))
    assert is_lost(tilted.measured, standing.command).all()
    sunk = moved(standing, base_height=torch.full((4,), 0.45))
    assert is_lost(sunk.measured, standing.command).all()


def test_a_fall_is_a_part_of_the_body_on_the_ground(standing: Transition) -> None:
    assert not has_fallen(standing.measured).any()
    clearance = standing.measured.body_clearance.clone()
    assert clearance[0].tolist() == pytest.approx([0.76, 1.0, 1.2, 0.4, 0.4, 0.9, 0.9], abs=0.15)
    clearance[1, 3], clearance[2, 0], clearance[3, 2] = 0.05, 0.11, 0.09  # a knee, the pelvis, nearly the head
    assert has_fallen(moved(standing, body_clearance=clearance).measured).tolist() == [False, True, True, False]


def test_total_is_the_weighted_sum_per_second(standing: Transition) -> None:
    weights = RewardWeights()
    total, terms = compute_rewards(standing, weights, 0.02)
    expected = sum(0.02 * getattr(weights, name) * value for name, value in terms.items())
    assert torch.allclose(total, expected)


def test_the_quality_of_tracking_does_not_depend_on_what_it_weighs(standing: Transition) -> None:
    _, terms = compute_rewards(standing, RewardWeights(), 0.02)
    tracked = ("linear_velocity", "angular_velocity", "base_height", "torso_orientation")
    mean = torch.stack([terms[name] for name in tracked]).mean(dim=0)
    assert torch.allclose(tracking_quality(standing), mean) and float(mean.max()) <= 1.0


def test_a_term_that_is_not_finite_is_named(standing: Transition) -> None:
    broken = moved(standing, base_height=torch.tensor([0.7, float("nan"), 0.7, 0.7]))
    with pytest.raises(NonFiniteError, match="'base_height' is not finite for robot 1"):
        compute_rewards(broken, RewardWeights(), 0.02)
