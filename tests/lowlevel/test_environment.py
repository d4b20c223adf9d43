"""The environment: finite, deterministic, honest about time limits, mirrored, and equal to the frozen controller."""

import inspect
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
from some_correction import fill

from lowlevel import rewards
from lowlevel.commands import HEIGHT, KINDS
from lowlevel.control.controller import Controller
from lowlevel.control.observation import (
    FRAME,
    FRAME_SIZE,
    HISTORY_LENGTH,
    MAP_REFRESH_STEPS,
    NoiseConfig,
    columns,
)
from lowlevel.environment import EnvironmentConfig, PilotEnvironment
from lowlevel.export import export_controller
from lowlevel.learning.ppo import PPOConfig
from lowlevel.networks.actor import CAPTURE_POINT, MOTION_SIZE
from lowlevel.rewards import REWARD_TERMS, RewardWeights
from lowlevel.stages import Stage
from lowlevel.task import TaskConfig
from lowlevel.trainer import Trainer, TrainingConfig
from lowlevel.world.measures import TRACKING_FIGURES
from lowlevel.world.privileged import MIRRORS, PRIVILEGED, PRIVILEGED_SIZE
from lowlevel.world.randomization import DRIFT_STEP, RandomizationConfig
from lowlevel.world.terrain import TerrainConfig
from robots.rotations import rotate_about_vertical

SMALL = EnvironmentConfig(num_robots=6, num_threads=1)
QUIET = replace(SMALL, start_in_posture=0.0, start_moving=0.0, noise=NoiseConfig(0.0, 0.0, 0.0, 0.0, 0.0))
CALM = RandomizationConfig.for_evaluation()


def small(seed: int = 0, **changes: Any) -> PilotEnvironment:
    """A few robots; ``changes`` are of the environment's configuration or of its task."""
    return _changed(SMALL, TaskConfig(arms_act=True), seed, changes)


def quiet(seed: int = 0, **changes: Any) -> PilotEnvironment:
    """A few robots that nothing disturbs."""
    return _changed(QUIET, TaskConfig(arms_act=True, randomization=CALM), seed, changes)


def _changed(config: EnvironmentConfig, task: TaskConfig, seed: int, changes: dict[str, Any]) -> PilotEnvironment:
    of_task = {field.name: changes.pop(field.name) for field in fields(TaskConfig) if field.name in changes}
    return PilotEnvironment(replace(config, **changes), replace(task, **of_task), seed)


def roll_out(environment: PilotEnvironment, steps: int, scale: float = 0.3) -> list[torch.Tensor]:
    """Observations and rewards of ``steps`` random actions."""
    generator = torch.Generator().manual_seed(1)
    environment.reset(spread_episodes=True)
    seen = []
    for _ in range(steps):
        result = environment.step(scale * torch.randn(environment.num_robots, 29, generator=generator))
        seen.append(torch.cat([*result.observation.values(), result.reward[:, None], result.next_privileged], dim=-1))
    return seen


def test_observations_have_the_announced_shapes_and_are_finite() -> None:
    environment = small(terrain=TerrainConfig(tiles=("flat", "slabs")))
    observation = environment.reset()
    shapes = {name: tuple(value.shape) for name, value in observation.items()}
    history = FRAME_SIZE * (HISTORY_LENGTH + 1)
    assert shapes == {
        "history": (6, history),
        "elevation_map": (6, 121),
        "flag": (6, 1),
        "privileged": (6, PRIVILEGED_SIZE),
    }
    assert all(torch.isfinite(values).all() for values in roll_out(environment, 30))


def test_same_seed_same_rollout_other_seed_other_rollout() -> None:
    first = roll_out(small(3), 20)
    again = roll_out(small(3, num_threads=2), 20)
    other = roll_out(small(4), 20)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[-1], other[-1])


def test_restored_state_continues_bit_exactly() -> None:
    environment = small(5, terrain=TerrainConfig(tiles=("slabs",)))
    roll_out(environment, 15)
    saved = environment.state_dict()
    saved = {
        key: ({k: v.clone() for k, v in value.items()} if isinstance(value, dict) else value)
        for key, value in saved.items()
    }
    actions = 0.3 * torch.randn(40, 6, 29)
    expected = [environment.step(action) for action in actions]
    other = small(99, terrain=TerrainConfig(tiles=("slabs",)))
    other.reset()
    other.load_state_dict(saved)
    for action, before in zip(actions, expected, strict=True):
        after = other.step(action)
        assert torch.equal(after.reward, before.reward)
        assert torch.equal(after.observation["history"], before.observation["history"])


def test_state_of_another_number_of_robots_is_refused() -> None:
    saved = small().state_dict()
    with pytest.raises(ValueError, match="number of robots"):
        small(num_robots=3).load_state_dict(saved)


def test_zero_action_stands_for_a_second_from_any_height_where_feet_do_not_slip() -> None:
    grip = replace(RandomizationConfig.for_evaluation(), friction=(1.0, 1.0))
    environment = quiet(2, num_robots=16, start_in_posture=1.0, randomization=grip, mixture=(("squat", 1.0),))
    environment.reset()
    believed = torch.zeros(16, 2)  # a reference that corrects nothing lets some lean so far that they would step
    results = [environment.step(torch.zeros(16, 29), believed) for _ in range(50)]
    assert not torch.stack([result.terminated for result in results]).any()
    error = results[-1].measured.base_height - results[-1].command[:, HEIGHT]
    assert error.abs().max() < 0.06


def test_friction_of_the_feet_is_the_one_that_was_drawn() -> None:
    slippery = replace(CALM, friction=(0.4, 0.5))
    environment = quiet(randomization=slippery, mixture=(("stand", 1.0),))
    environment.reset()
    for _ in range(10):  # until the feet have landed
        environment.step(torch.zeros(6, 29))
    for robot in range(6):
        model, data = environment.simulation.robot_model(robot), environment.simulation.robot_data(robot)
        mujoco.mj_forward(model, data)
        drawn = environment.randomizer.state.friction[robot].item()
        assert data.ncon > 0
        assert [contact.friction[0] for contact in data.contact] == pytest.approx([drawn] * data.ncon)


def test_targets_reach_the_motors_as_late_as_drawn() -> None:
    environment = small()
    environment.reset()
    environment.randomizer.state.delay = torch.tensor([0, 1, 2, 0, 1, 2])
    sent = [torch.full((6, 29), float(number)) for number in range(4)]
    arrived = [environment.randomizer.delayed(target)[:, 0].tolist() for target in sent]
    assert arrived[2:] == [[2.0, 1.0, 0.0, 2.0, 1.0, 0.0], [3.0, 2.0, 1.0, 3.0, 2.0, 1.0]]


def test_maps_are_refreshed_at_10_hz_and_arrive_as_late_and_as_wrong_as_drawn() -> None:
    stairs = TerrainConfig(tiles=("stairs",), levels=(1.0,))
    environment = quiet(terrain=stairs)
    environment.reset()
    drawn = environment.randomizer.state
    drawn.map_delay = torch.tensor([0, 0, 1, 1, 2, 2])
    drawn.map_error = torch.zeros(6, 3)
    drawn.map_error[1:, 2] = 0.03
    taken, seen = [], []
    for _ in range(4 * MAP_REFRESH_STEPS):
        result = environment.step(torch.zeros(6, 29))
        taken.append(environment._seen_ground(result.measured))
        seen.append(result.observation["elevation_map"])
    for step in range(3 * MAP_REFRESH_STEPS, 4 * MAP_REFRESH_STEPS):
        # The map is taken with every fifth observation after the first, which the reset returned.
        newest = (step + 1) // MAP_REFRESH_STEPS * MAP_REFRESH_STEPS - 1
        for robot in range(6):
            when = newest - MAP_REFRESH_STEPS * int(drawn.map_delay[robot])
            expected = taken[when][robot] + drawn.map_error[robot, 2]
            assert torch.allclose(seen[step][robot], expected.clamp(-1.0, 1.0), atol=1e-5), (step, robot)


def test_the_error_of_a_map_wanders_within_its_bounds() -> None:
    environment = small()
    environment.reset()
    randomizer, limit = environment.randomizer, environment.randomizer.config.map_drift
    first = randomizer.state.map_error.clone()
    steps = []
    for _ in range(300):
        before = randomizer.state.map_error.clone()
        randomizer.wander()
        steps.append((randomizer.state.map_error - before).abs())
    last = randomizer.state.map_error
    assert torch.equal(last[:, 2], first[:, 2]) and not torch.allclose(last[:, :2], first[:, :2])
    assert 0.0 < float(torch.stack(steps).max()) <= DRIFT_STEP + 1e-6 and float(last[:, :2].abs().max()) <= limit + 1e-6


def test_waist_motors_are_as_strong_as_drawn() -> None:
    environment = small(randomization=RandomizationConfig(waist_effort=(35.0, 36.0)))
    environment.reset()
    model = environment.simulation.robot_model(3)
    limits = {
        name: model.actuator(f"{name}_joint").forcerange[1] for name in ("waist_pitch", "waist_roll", "left_knee")
    }
    assert 35.0 <= limits["waist_pitch"] <= 36.0 and 35.0 <= limits["waist_roll"] <= 36.0
    assert limits["left_knee"] == 139.0


def test_arms_that_do_not_act_follow_the_command_alone() -> None:
    environment = quiet(arms_act=False)
    environment.reset()
    environment.step(torch.ones(6, 29))
    assert (environment.buffers.action[:, 15:] == 0.0).all() and (environment.buffers.action[:, :15] == 1.0).all()


def test_a_share_of_the_episodes_starts_at_the_told_velocity() -> None:
    environment = quiet(num_robots=64, mixture=(("walk", 1.0),), start_moving=1.0)
    environment.reset()
    measured = environment.world.measure()
    torch.testing.assert_close(measured.linear_velocity[:, :2], environment.buffers.command[:, :2], atol=1e-4, rtol=0.0)


def test_falls_terminate_and_time_limits_truncate() -> None:
    environment = quiet(episode_length=0.2)
    environment.reset()
    for _ in range(9):
        result = environment.step(torch.zeros(6, 29))
    assert not (result.terminated | result.truncated).any()
    result = environment.step(torch.zeros(6, 29))
    assert result.truncated.all() and not result.terminated.any()
    assert (environment.buffers.episode_step == 0).all()
    toppled = quiet()
    toppled.reset()
    everything = [toppled.step(torch.full((6, 29), 8.0)) for _ in range(60)]
    assert torch.stack([result.terminated for result in everything]).any(dim=0).all()


def test_a_step_says_whether_another_command_follows() -> None:
    environment = quiet(num_robots=64, command_interval=(0.1, 0.4))
    environment.reset()
    for _ in range(10):
        before = environment.buffers.command
        result = environment.step(torch.zeros(64, 29))
        assert torch.equal(result.command, before)
        changed = (environment.buffers.command != before).any(dim=1)
        assert torch.equal(result.surprised, changed)
    assert result.surprised.any() and not result.surprised.all()


def test_a_step_says_whether_a_push_follows() -> None:
    pushes = replace(CALM, push_velocity=0.5, standing_push_velocity=0.5, push_interval=(0.04, 0.1))
    environment = quiet(num_robots=16, command_interval=(9.0, 9.1), randomization=pushes)
    environment.reset()
    surprised = torch.zeros(16, dtype=torch.bool)
    for _ in range(5):
        result = environment.step(torch.zeros(16, 29))
        # The velocity that was measured at the end of the step, against the one that the next step begins with
        jump = (environment.simulation.read().base_linear_velocity - result.measured.robot.base_linear_velocity).norm(
            dim=1
        )
        assert torch.equal(result.surprised, jump > 1e-3)
        surprised |= result.surprised
    assert surprised.all()


def test_a_standing_robot_that_is_pushed_steps() -> None:
    environment = quiet(command_interval=(9.0, 9.1), mixture=(("stand", 1.0),))
    environment.reset()
    assert not environment.buffers.reference.walking.any()
    push = torch.tensor([[0.1, 0, 0], [0.6, 0, 0], [-0.6, 0, 0], [0, 0.6, 0], [0, -0.6, 0], [0, 0, 0]])
    turned = rotate_about_vertical(environment.world.measure().heading, push)
    environment.simulation.push(turned)
    for _ in range(5):
        environment.step(torch.zeros(6, 29))
    walking, clock = environment.buffers.reference.walking, environment.buffers.reference.clock
    assert walking.tolist() == [False, True, True, True, True, False]
    assert clock[3, 0] < 0.0 < clock[4, 0], "pushed to the left it swings the right foot, and the other way round"


def test_robots_start_just_above_the_ground_as_fast_as_configured() -> None:
    slabs = TerrainConfig(tiles=("slabs",))
    for fastest in (0.0, 0.3):
        started = replace(CALM, start_velocity=fastest)
        environment = quiet(num_robots=64, terrain=slabs, randomization=started)
        environment.reset()
        state = environment.simulation.read()
        soles = state.foot_position
        gaps = soles[..., 2] - environment.world.terrain.height(soles[..., :2])
        assert (gaps > 0.0).all() and gaps.mean() < 0.035
        assert state.base_linear_velocity[:, :2].abs().max().item() == pytest.approx(fastest, abs=0.02)


def test_successor_state_is_the_one_before_the_reset() -> None:
    environment = quiet(episode_length=0.1)
    environment.reset()
    for _ in range(5):
        result = environment.step(0.5 * torch.ones(6, 29))
    assert result.truncated.all()
    speed = result.next_privileged[:, :3]
    assert torch.allclose(speed, result.measured.linear_velocity)
    assert not torch.allclose(speed, result.observation["privileged"][:, :3])


def test_no_part_of_an_observation_is_constant() -> None:
    """Blocks that never change would be dead inputs; the ones that may are named."""
    environment = small(num_robots=32)
    frames = torch.stack(
        [values[:, : FRAME_SIZE * (HISTORY_LENGTH + 1)][:, -FRAME_SIZE:] for values in roll_out(environment, 60)]
    )
    deviation = frames.flatten(0, 1).std(dim=0)
    for block in FRAME:
        assert (deviation[columns(FRAME, block.name)] > 0).all(), block.name


def test_mirrors_cover_their_vectors() -> None:
    environment = small()
    observation = environment.reset()
    for key in ("history", "elevation_map", "privileged"):
        values = observation[key].numpy()
        assert (MIRRORS[key](MIRRORS[key](values)) == values).all()
    assert sum(block.size for block in FRAME) == FRAME_SIZE


def test_a_robot_that_diverges_falls_and_the_others_do_not_notice() -> None:
    environment, undisturbed = quiet(2), quiet(2)
    environment.reset(), undisturbed.reset()
    environment.simulation._qvel[3, 10] = float("nan")
    for step in range(3):
        result = environment.step(torch.zeros(6, 29))
        expected = undisturbed.step(torch.zeros(6, 29))
        assert result.terminated.tolist() == [robot == 3 and step == 0 for robot in range(6)]
        for values in (*result.observation.values(), result.reward, result.next_privileged):
            assert bool(torch.isfinite(values).all())
        others = torch.tensor([0, 1, 2, 4, 5])
        torch.testing.assert_close(result.next_privileged[others], expected.next_privileged[others])


def test_every_reward_weight_has_a_term_and_every_term_a_weight() -> None:
    terms = {
        name
        for name, function in vars(rewards).items()
        if inspect.isfunction(function)
        and not name.startswith("_")
        and next(iter(inspect.signature(function).parameters.values())).annotation == "Transition"
        and name not in ("compute_rewards", "tracking_quality")
    }
    assert {field.name for field in fields(RewardWeights)} == set(REWARD_TERMS) == terms


def test_frozen_controller_repeats_the_training_policy(tmp_path: Path) -> None:
    """Controller.act on noise-free measurements gives the targets that the environment applies, and steps when it does.

    An untrained policy's estimate of its capture point says nothing, so that it steps where it need not.
    """
    stage = Stage(arms_act=True, randomization=CALM)
    config = TrainingConfig(environment=QUIET, ppo=PPOConfig(steps_per_update=8, minibatches=2), stages=(stage,))
    trainer = Trainer(config, tmp_path)
    generator = torch.Generator().manual_seed(0)
    weight = trainer.ppo.actor.head.output_weight
    weight.data += 0.02 * torch.randn(weight.shape, generator=generator)
    environment = trainer.environment
    fill(environment.correction)
    export_controller(trainer, tmp_path / "controller")
    controller = Controller.load(tmp_path / "controller")
    controller.reset(6)
    observation = environment.reset()
    for _ in range(25):
        targets = controller.act(
            environment.world.measure().proprioception,
            environment.buffers.maps[:, 0] + 0.75,
            environment.buffers.command,
            environment.buffers.flag,
        )
        reference = environment.buffers.reference.command.clone()
        with torch.no_grad():
            output = trainer.ppo.learner.policy(observation)
        observation = environment.step(output.mean, output.motion[:, CAPTURE_POINT]).observation
        assert torch.allclose(targets, environment.randomizer.state.past_targets[:, 0], atol=2e-5)
        assert torch.allclose(controller.reference, reference, atol=1e-5)


def test_tracking_figures_vanish_for_a_robot_that_does_as_told() -> None:
    environment = quiet()
    environment.opening = torch.zeros(len(KINDS))
    environment.reset()
    measured = environment.world.measure()
    command = environment.buffers.command.clone()
    command[:, :2] = measured.linear_velocity[:, :2]
    command[:, 2] = measured.yaw_rate
    command[:, HEIGHT] = measured.base_height
    command[:, 7:] = measured.robot.joint_position[:, 15:]
    for name in ("E_v", "E_omega", "E_h", "E_arm", "E_stumble"):
        assert TRACKING_FIGURES[name][1](measured, command).abs().max() < 1e-5, name


def test_the_history_encoder_estimates_what_the_critics_view_begins_with() -> None:
    assert columns(PRIVILEGED, "base_linear_velocity") == slice(0, CAPTURE_POINT.start)
    assert columns(PRIVILEGED, "capture_point") == CAPTURE_POINT and CAPTURE_POINT.stop == MOTION_SIZE


def test_a_load_ends_with_its_episode_when_conditions_get_easier_again() -> None:
    loaded = replace(CALM, hand_load_probability=1.0, hand_payload=(10.0, 10.0))
    environment = quiet(randomization=loaded, episode_length=0.1)
    environment.reset()
    environment.step(torch.zeros(6, 29))
    environment.randomizer.config = CALM
    environment.step(torch.zeros(6, 29))
    assert (environment.buffers.hand_force.norm(dim=-1) > 1.0).all(), "until the episode is over it is still there"
    for _ in range(5):
        environment.step(torch.zeros(6, 29))
    assert not environment.buffers.hand_force.any()
