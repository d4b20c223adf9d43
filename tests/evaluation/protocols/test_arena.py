from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from evaluation.protocols.arena import (
    Arena,
    Episode,
    HandLoad,
    Push,
    batch_steps,
    constant,
    episode_seeds,
)
from evaluation.protocols.trace import Channel, record
from lowlevel.commands import ARMS, HEIGHT, VELOCITY, command_space
from lowlevel.control.controller import Controller
from lowlevel.control.observation import NoiseConfig
from lowlevel.control.whole_body import Bounds, Supports
from lowlevel.world.randomization import RandomizationConfig, hand_forces
from lowlevel.world.terrain import TerrainConfig
from robots.g1.constants import FOOT_BODIES, HAND_BODIES, NUM_JOINTS, gain_set
from robots.g1.model import build_spec, joint_limits
from robots.g1.nominal_pose import NominalPose

FLAT = TerrainConfig(tile_size=16.0)
QUIET = NoiseConfig(0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def controller(untrained_controller: Path) -> Controller:
    return Controller.load(untrained_controller)


@pytest.fixture(scope="module")
def arena(controller: Controller) -> Arena:
    return Arena(controller, FLAT, num_threads=1, batch=4)


def standing(controller: Controller, count: int, duration: float = 0.2) -> list[Episode]:
    command = controller.command_space.neutral()
    return [constant(episode_seeds(0, index)[1], duration, command, flag=1.0) for index in range(count)]


def joints(arena: Arena, episodes: Sequence[Episode]) -> torch.Tensor:
    """Joint positions over time (T, episodes, 29)."""
    count = len(episodes)
    return torch.stack([moment.measured.robot.joint_position[:count] for moment in arena.run(episodes)])


def test_robots_start_standing_at_the_commanded_height(arena: Arena, controller: Controller) -> None:
    first = next(arena.run(standing(controller, 4)))
    np.testing.assert_allclose(first.measured.base_height, 0.765, atol=0.01)
    assert (first.measured.projected_gravity[:, 2] < -0.9).all()
    upright = first.measured.torso_orientation[:, 0].abs()
    assert (upright > 0.999).all()


def test_an_episode_repeats_exactly_and_does_not_depend_on_its_company(arena: Arena, controller: Controller) -> None:
    episodes = standing(controller, 4)
    together = joints(arena, episodes)
    assert torch.equal(together, joints(arena, episodes))
    assert torch.equal(together[:, :2], joints(arena, episodes[:2]))
    longer = [replace(episode, duration=0.3) for episode in episodes]
    assert torch.equal(together, joints(arena, longer)[: len(together)])
    assert not torch.equal(together[:, 0], together[:, 1])


def test_batch_size_changes_no_more_than_rounding(controller: Controller) -> None:
    episodes = standing(controller, 5, duration=0.1)
    results = []
    for batch in (2, 5):
        arena = Arena(controller, FLAT, num_threads=1, batch=batch)
        joints = Channel(lambda moment: moment.measured.robot.joint_position, (29,))
        results.append(record(arena, episodes, {"joints": joints})["joints"][:, -1])
    np.testing.assert_allclose(results[0], results[1], atol=1e-4)


def test_friction_is_drawn_per_episode_and_decided_by_the_feet(arena: Arena, controller: Controller) -> None:
    episodes = standing(controller, 4)
    for _ in arena.run(episodes):
        pass
    drawn = arena.friction
    assert ((drawn >= 0.6) & (drawn <= 1.0)).all() and len(drawn.unique()) == 4
    model, data = arena.simulation.robot_model(2), arena.simulation.robot_data(2)
    mujoco.mj_forward(model, data)
    feet = {model.body(name).id for name in FOOT_BODIES}
    touching = [c for c in data.contact if {model.geom_bodyid[g] for g in c.geom} & feet]
    assert touching
    for contact in touching:
        assert contact.friction[0] == pytest.approx(drawn[2].item(), abs=1e-6)


def test_commands_switch_on_time_and_are_clamped(arena: Arena, controller: Controller) -> None:
    neutral = controller.command_space.neutral()
    impossible = neutral.clone()
    impossible[HEIGHT], impossible[5] = 0.30, 1.5
    episode = Episode(1, 0.2, (0.0, 0.1), torch.stack([neutral, impossible]), torch.tensor([1.0, 0.0]))
    moments = list(arena.run([episode]))
    assert len(moments) == 10
    switched = [moment.command[0, HEIGHT].item() < 0.5 for moment in moments]
    assert switched == [False] * 5 + [True] * 5
    assert [moment.flag[0, 0].item() for moment in moments] == [1.0] * 5 + [0.0] * 5
    clamped = controller.clamp_command(impossible[None])[0]
    assert clamped[5] < 1.4
    torch.testing.assert_close(moments[-1].command[0], clamped)


def test_a_push_changes_the_velocity_of_its_robot_only(controller: Controller) -> None:
    arena = Arena(controller, FLAT, noise=QUIET, num_threads=1, batch=4)
    pushed, left_alone = standing(controller, 2)
    pushed = replace(pushed, pushes=(Push(0.1, (0.8, 0.0, 0.0)),))
    before, after = (
        list(arena.run([episode, left_alone]))[5].measured.robot.base_linear_velocity
        for episode in (replace(pushed, pushes=()), pushed)
    )
    change = after - before
    assert 0.3 < change[0, 0] < 0.9 and change[0, 1].abs() < 0.2
    assert change[1].abs().max() == 0.0


def test_hand_forces_point_away_from_the_other_hand() -> None:
    palms = torch.tensor([[[0.3, 0.15, 1.0], [0.3, -0.15, 1.0]], [[0.0, 0.0, 1.3], [0.4, 0.0, 1.0]]])
    force = hand_forces(palms, torch.tensor([15.0, 10.0]), torch.tensor([5.0, 0.0]))
    torch.testing.assert_close(force[0], torch.tensor([[0.0, 15.0, -5.0], [0.0, -15.0, -5.0]]))
    # Unit vector (-0.8, 0, 0.6) from the right hand to the left one.
    torch.testing.assert_close(force[1], torch.tensor([[-8.0, 0.0, 6.0], [8.0, 0.0, -6.0]]))


def test_a_load_bears_on_its_robot_from_its_time_on(arena: Arena, controller: Controller) -> None:
    loaded, left_alone = standing(controller, 2)
    loaded = replace(loaded, load=HandLoad(outward=15.0, downward=5.0, begin=0.1))
    hands = [arena.simulation.model.body(name).id for name in HAND_BODIES]
    palms = []
    for moment in arena.run([loaded, left_alone]):
        force = arena.simulation.robot_data(0).xfrc_applied[hands]
        if moment.step < 5:
            assert not force.any()
        else:
            # Acts along the line between the palms at the beginning of the step.
            across = (palms[-1][0, 0] - palms[-1][0, 1]).numpy()
            outward = 15.0 * across / np.linalg.norm(across)
            np.testing.assert_allclose(force[0, :3], outward - [0.0, 0.0, 5.0], atol=1e-4)
            np.testing.assert_allclose(force[1, :3], -outward - [0.0, 0.0, 5.0], atol=1e-4)
        assert not force[:, 3:].any() and not arena.simulation.robot_data(1).xfrc_applied.any()
        palms.append(moment.measured.robot.palm_position)
    unloaded = [m.measured.robot.palm_position for m in arena.run([replace(loaded, load=None), left_alone])]
    assert not arena.simulation.robot_data(0).xfrc_applied.any(), "the next episode starts without it"
    apart = [(end[-1][0, 0] - end[-1][0, 1]).norm() for end in (palms, unloaded)]
    assert apart[0] > apart[1] + 0.002
    assert torch.equal(palms[4][0], unloaded[4][0]) and torch.equal(palms[-1][1], unloaded[-1][1])


def test_a_fall_ends_its_command_and_the_next_one_begins_from_standing(arena: Arena, controller: Controller) -> None:
    hit, spared = standing(controller, 2, duration=1.6)
    neutral = hit.commands
    two = replace(hit, starts=(0.0, 0.8), commands=neutral.repeat(2, 1), flags=torch.ones(2))
    two = replace(two, pushes=(Push(0.0, (0.0, 12.0, 0.0)),))
    hit = replace(hit, pushes=two.pushes)
    moments = list(arena.run([hit, spared, two]))
    fell, active = (torch.stack([getattr(moment, name) for moment in moments]) for name in ("fell", "active"))
    assert fell[:40].sum(dim=0).tolist()[0] == 1 and fell[:40].sum(dim=0).tolist()[2] == 1
    for row in (0, 2):
        when = int(fell[:, row].nonzero()[0])
        assert when < 40 and active[: when + 1, row].all() and not active[when + 1 : 40, row].any()
    assert not active[40:, 0].any() and active[40, 2]
    risen = moments[40].measured
    assert risen.base_height[2] == pytest.approx(0.765, abs=0.02) and risen.projected_gravity[2, 2] < -0.9
    assert moments[39].number.tolist()[2] == 0 and moments[40].number.tolist()[2] == 1
    assert not active[:, 3:].any()
    down = list(arena.run([replace(two, stands_up=False)]))
    assert len(down) < 40


def test_robots_that_lie_are_not_simulated(arena: Arena, controller: Controller) -> None:
    hit, spared = standing(controller, 2, duration=1.2)
    hit = replace(hit, pushes=(Push(0.0, (0.0, 12.0, 0.0)),))
    places = [moment.measured.robot.joint_position[0] for moment in arena.run([hit, spared]) if not moment.active[0]]
    assert len(places) > 2 and torch.equal(places[0], places[-1])


class Statue:
    """A controller that is not PILOT's: it stands, whatever it is told."""

    gains = gain_set("stiff")

    def __init__(self, fails: Sequence[int] = ()) -> None:
        self.fails = list(fails)
        limits = joint_limits(build_spec().compile())
        self.neutral = command_space(limits[:, 0].tolist(), limits[:, 1].tolist()).neutral()
        self.supports = Supports(Bounds(self.neutral, self.neutral), Bounds(self.neutral, self.neutral))

    def reset(self, num_robots: int, ids: torch.Tensor | None = None) -> None:
        """It remembers nothing."""

    def act(self, *measured: object) -> torch.Tensor:
        stands = NominalPose.load().lookup(torch.tensor([[0.76, 0.0, 0.0, 0.0]])).position
        targets = torch.cat([stands, self.neutral[None, ARMS]], dim=1).repeat(2, 1)
        targets[self.fails] = torch.nan
        return targets


def test_any_controller_can_be_run() -> None:
    arena = Arena(Statue(), FLAT, num_threads=1, batch=2)
    episodes = [constant(seed, 1.0, arena.space.neutral(), flag=1.0) for seed in range(2)]
    moments = list(arena.run(episodes))
    assert len(moments) == 50 and moments[-1].active.all()
    assert moments[-1].gate.shape == (2, arena.experts) == (2, 0)


def test_targets_that_are_not_finite_are_no_fall(controller: Controller) -> None:
    arena = Arena(Statue(fails=[1]), FLAT, num_threads=1, batch=2)
    moments = list(arena.run(standing(controller, 2)))
    assert moments[0].failed.tolist() == [False, True] and not torch.stack([m.fell for m in moments]).any()
    assert len(moments) == 10 and not moments[1].active[1]


def test_work_is_torque_times_angle_over_the_physics_steps(controller: Controller) -> None:
    """Against MuJoCo's own actuator power, integrated with a hundredth of the step."""
    arena = Arena(controller, FLAT, noise=QUIET, num_threads=1, batch=1)
    moment = next(arena.run(standing(controller, 1)))
    simulation = arena.simulation
    model, data = simulation.robot_model(0), simulation.robot_data(0)
    targets = moment.targets + 0.1
    work = simulation.step_with_work(targets, torch.tensor([0]))
    data.ctrl[:NUM_JOINTS] = targets[0].numpy()
    expected = 0.0
    for _ in range(10):
        mujoco.mj_step1(model, data)
        before = data.qvel.copy()
        mujoco.mj_step2(model, data)
        middle = 0.5 * (before + data.qvel)[6 : 6 + NUM_JOINTS]
        expected += 0.002 * float(np.abs(data.actuator_force[:NUM_JOINTS] * middle).sum())
    assert work[0].item() == pytest.approx(expected, rel=0.15) and work[0] > 0.1


def test_noise_reaches_what_the_controller_sees_but_not_what_is_measured(controller: Controller) -> None:
    episodes = standing(controller, 1)
    noisy = Arena(controller, FLAT, num_threads=1, batch=1)
    quiet = Arena(controller, FLAT, noise=QUIET, num_threads=1, batch=1)
    seen = [next(arena.run(episodes)) for arena in (noisy, quiet)]
    spread = seen[0].elevation - seen[1].elevation
    assert 0.015 < spread.abs().max() <= 0.02
    expected = seen[1].measured.robot.base_position[:, 2:3].expand(-1, 121)
    torch.testing.assert_close(seen[1].elevation, expected, atol=0.01, rtol=0.0)
    assert not torch.equal(seen[0].measured.robot.joint_velocity, seen[1].measured.robot.joint_velocity)


def test_steps_are_counted_by_batches(arena: Arena, controller: Controller) -> None:
    episodes = standing(controller, 6, duration=0.1)
    passed: list[int] = []
    record(arena, episodes, {}, passed.append)
    assert sum(passed) == batch_steps(arena, episodes) == 10


def test_conditions_that_no_episode_would_meet_are_refused(controller: Controller) -> None:
    pushed = replace(RandomizationConfig.for_evaluation(), push_velocity=1.0)
    with pytest.raises(ValueError, match="does not draw 'push_velocity'"):
        Arena(controller, FLAT, pushed, num_threads=1, batch=1)


def test_the_robot_has_the_controllers_gains(untrained_controller: Path) -> None:
    controller = Controller.load(untrained_controller)
    controller.gains = replace(controller.gains, stiffness=2.0 * controller.gains.stiffness)
    model = Arena(controller, FLAT, batch=1).simulation.model
    np.testing.assert_allclose(model.actuator_gainprm[:NUM_JOINTS, 0], controller.gains.stiffness)
    np.testing.assert_allclose(model.actuator_biasprm[:NUM_JOINTS, 2], -controller.gains.damping)


def test_conditions_delay_and_weaken(controller: Controller) -> None:
    conditions = replace(RandomizationConfig.for_evaluation(), delay=(0.0, 0.0, 1.0), effort_scale=0.5)
    arena = Arena(controller, FLAT, conditions, num_threads=1, batch=1)
    controls, targets = [], []
    for moment in arena.run(standing(controller, 1)):
        targets.append(moment.targets[0].numpy())
        controls.append(arena.simulation.robot_data(0).ctrl[:NUM_JOINTS].copy())
    np.testing.assert_allclose(controls[5], targets[3], atol=1e-6)
    assert arena.simulation.robot_model(0).actuator("left_knee_joint").forcerange[1] == pytest.approx(0.5 * 139.0)


def test_seeds_of_different_episodes_differ() -> None:
    seeds = {seed for index in range(50) for seed in episode_seeds(3, index)}
    assert len(seeds) == 100
    assert episode_seeds(3, 0) != episode_seeds(4, 0)


def test_forward_means_forward_in_the_heading_frame(controller: Controller) -> None:
    """A push along the robot's own heading shows up as vx, whatever the heading."""
    arena = Arena(controller, FLAT, noise=QUIET, num_threads=1, batch=1)
    (episode,) = standing(controller, 1)
    heading = next(arena.run([episode])).measured.heading[0].item()
    along = (float(np.cos(heading)), float(np.sin(heading)), 0.0)
    moments = list(arena.run([replace(episode, pushes=(Push(0.0, along),))]))
    velocity = moments[0].measured.linear_velocity[0]
    assert velocity[0] > 0.5 and velocity[1].abs() < 0.15
    assert moments[0].command[0, VELOCITY].abs().max() == 0.0
