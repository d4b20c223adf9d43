"""The task in its environment: spawn, per-robot boxes, contact forces, controls, finite rewards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from highlevel.environment import CommandEnvironment, PhysicsConfig
from robots.g1.constants import HAND_BODIES
from robots.rotations import yaw_of
from tasks.lift_box.config import LiftBoxConfig, NoiseConfig, PushConfig, SpawnConfig
from tasks.lift_box.episode import draw
from tasks.lift_box.expert import LiftBoxExpert
from tasks.lift_box.geometry import relative_pose
from tasks.lift_box.scene import BOX, FORCE_SENSORS, HAND_GEOMS, SUPPORT
from tasks.lift_box.task import LiftBox

Make = Callable[..., CommandEnvironment]


@pytest.fixture
def make(untrained_controller: Path) -> Make:
    torch.set_num_threads(1)
    physics = PhysicsConfig(timestep=0.005, num_threads=1)

    def build(robots: int = 4, config: LiftBoxConfig | None = None) -> CommandEnvironment:
        return CommandEnvironment(LiftBox(config), untrained_controller, robots, 0, physics)

    return build


def _lift_box(environment: CommandEnvironment) -> LiftBox:
    assert isinstance(environment.task, LiftBox)
    return environment.task


def test_episodes_start_within_the_spawn_ranges() -> None:
    config = LiftBoxConfig()
    episode, start = draw(config, 3, torch.arange(4000))
    spawn = config.spawn
    distance = start.position.norm(dim=1) - 0.5 * episode.size[:, 0]
    assert spawn.distance[0] <= distance.min() and distance.max() <= spawn.distance[1]
    sight = torch.atan2(-start.position[:, 1], -start.position[:, 0])
    bearing = torch.atan2(torch.sin(start.heading - sight), torch.cos(start.heading - sight))
    assert sight.abs().max() <= spawn.box_yaw and spawn.bearing[0] <= bearing.min() <= bearing.max() <= spawn.bearing[1]
    on_floor = (episode.support_height == 0.0).float().mean().item()
    assert abs(on_floor - spawn.floor_share) < 0.03
    assert abs(episode.mass.mean().item() - 1.25) < 0.03
    assert episode.center_of_mass.abs().max() <= spawn.center_of_mass


def test_every_robot_has_its_own_box_and_it_rests_on_its_support(make: Make) -> None:
    environment = make(6)
    environment.reset(seed=2)
    task = _lift_box(environment)
    assert (task.episode.support_height == 0).any() and (task.episode.support_height > 0).any()
    for robot in range(6):
        model = environment.simulation.robot_model(robot)
        np.testing.assert_allclose(model.geom(BOX).size, 0.5 * task.episode.size[robot], atol=1e-6)
        assert model.body(BOX).mass[0] == pytest.approx(task.episode.mass[robot].item(), rel=1e-5)
        width, depth, tall = task.episode.size[robot].tolist()
        expected = (
            task.episode.mass[robot].item()
            / 12
            * np.array([depth**2 + tall**2, width**2 + tall**2, width**2 + depth**2])
        )
        np.testing.assert_allclose(model.body(BOX).inertia, expected, rtol=1e-5)
        for geom in HAND_GEOMS:
            assert model.geom(geom).friction[0] == pytest.approx(task.episode.friction[robot].item(), rel=1e-5)
        top = model.geom(SUPPORT).pos[2] + model.geom(SUPPORT).size[2]
        height = task.episode.support_height[robot].item()
        assert top == pytest.approx(height, abs=1e-6) if height > 0 else top < -0.01
    for _ in range(3):
        environment.step(environment.action_map.action(environment.command))
    pose = environment.simulation.object_pose(BOX)
    resting = task.episode.support_height + 0.5 * task.episode.size[:, 2]
    torch.testing.assert_close(pose[:, 2], resting, atol=2e-3, rtol=0)
    assert yaw_of(pose[:, 3:]).abs().max() < 0.01


def test_collision_uses_the_size_of_each_simulation(make: Make) -> None:
    """A box larger than the compiled one rests on its own faces, wherever it is dropped."""
    spawn = SpawnConfig(edge=(0.4, 0.4), floor_share=1.0)
    environment = make(2, LiftBoxConfig(spawn=spawn))
    environment.reset(seed=0)
    pose = environment.simulation.object_pose(BOX)
    pose[:, :3] = torch.tensor([[3.0, 3.0, 0.25], [3.0, -3.0, 0.23]])
    environment.simulation.set_object_pose(torch.arange(2), BOX, pose)
    for _ in range(100):
        environment.simulation._batch.step(nstep=4)
    settled = environment.simulation.object_pose(BOX)[:, 2]
    torch.testing.assert_close(settled, torch.full((2,), 0.2), atol=2e-3, rtol=0)


def test_hand_forces_point_at_the_box_and_count_only_its_contacts(make: Make) -> None:
    """Press the box against the left palm from outside and add up the contact forces by hand."""
    environment = make(1, LiftBoxConfig(spawn=SpawnConfig(edge=(0.3, 0.3), mass=(1.0, 1.0), floor_share=1.0)))
    environment.reset(seed=0)
    task, simulation = _lift_box(environment), environment.simulation
    model, data = simulation.robot_model(0), simulation.robot_data(0)
    model.opt.gravity[:] = 0.0
    mujoco.mj_forward(model, data)
    hand = data.body(HAND_BODIES[0])
    rotation = hand.xmat.reshape(3, 3)
    # The face with normal +y of the box, 1 mm inside the palm plate.
    normal = -rotation[:, 1]
    palm = data.geom("left_palm").xpos
    start = model.joint(BOX).qposadr[0]
    data.qpos[start : start + 3] = palm + normal * (0.012 + 0.15 - 0.001)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.reshape(-1))
    data.qpos[start + 3 : start + 7] = quaternion
    mujoco.mj_forward(model, data)
    force = data.sensor(FORCE_SENSORS[0]).data.copy()
    assert np.linalg.norm(force) > 1.0
    others = data.sensor(FORCE_SENSORS[1]).data
    np.testing.assert_allclose(others, 0.0, atol=1e-9)
    assert float(force @ normal) > 0.0
    by_contact = np.zeros(3)
    for number, contact in enumerate(data.contact):
        first, second = (model.geom(geom).bodyid[0] for geom in contact.geom)
        if {first, second} == {model.body(HAND_BODIES[0]).id, model.body(BOX).id}:
            local = np.zeros(6)
            mujoco.mj_contactForce(model, data, number, local)
            # The force acts on the contact's second geom.
            sign = 1.0 if second == model.body(BOX).id else -1.0
            by_contact += sign * contact.frame.reshape(3, 3).T @ local[:3]
    np.testing.assert_allclose(force, by_contact, rtol=1e-6)
    environment.simulation.set_object_pose(
        torch.tensor([0]), BOX, torch.tensor(data.qpos[start : start + 7]).float()[None]
    )
    environment.simulation.forward()
    assert environment.measured is not None
    seen = task.look(environment.measured)
    assert seen.palm_force[0, 0] > 1.0 and seen.palm_force[0, 1] == 0.0


def test_pushes_come_when_they_are_due_and_in_all_directions(make: Make) -> None:
    changes = {}
    for velocity in (0.0, 0.5):
        environment = make(4, LiftBoxConfig(push=PushConfig(velocity, interval=0.2)))
        environment.reset(seed=2)
        before = []
        push = environment.simulation.push
        environment.simulation.push = lambda change, push=push, before=before: (before.append(change), push(change))
        for _ in range(4):
            environment.step(environment.action_map.action(environment.command))
        changes[velocity] = before
    assert not changes[0.0]
    pushed = torch.stack(changes[0.5])
    speed = pushed.norm(dim=2)
    due = torch.arange(1, 21) % 10 == 0
    assert not speed[~due].any() and pushed[..., 2].eq(0.0).all()
    torch.testing.assert_close(speed[due], torch.full((2, 4), 0.5))
    angles = torch.atan2(pushed[due][..., 1], pushed[due][..., 0]).flatten()
    assert angles.unique().numel() == 8


def test_nothing_succeeds_at_reset_and_rewards_are_finite(make: Make) -> None:
    environment = make(8)
    observation = environment.reset(seed=1)
    assert torch.isfinite(observation).all()
    task = _lift_box(environment)
    assert (task.stage == 0).all()
    generator = torch.Generator().manual_seed(0)
    for _ in range(15):
        result = environment.step(2.0 * torch.rand(8, 21, generator=generator) - 1.0)
        assert torch.isfinite(result.reward).all() and torch.isfinite(result.observation).all()
        assert not result.success.any()
        assert (result.reward[result.fallen] < -1.0).all()


@pytest.mark.parametrize("control", ["frictionless", "no_hands"])
def test_negative_controls_take_the_hands_away(make: Make, control: str) -> None:
    environment = make(2, LiftBoxConfig(control=control))  # type: ignore[arg-type]
    environment.reset(seed=0)
    for robot in range(2):
        model = environment.simulation.robot_model(robot)
        for geom in HAND_GEOMS:
            if control == "frictionless":
                assert (model.geom(geom).friction == 0.0).all() and model.geom(geom).contype[0] != 0
            else:
                assert model.geom(geom).contype[0] == 0 and model.geom(geom).conaffinity[0] == 0


def test_the_observed_box_is_noisy_and_the_noise_repeats(make: Make) -> None:
    environment = make(3)
    first = environment.reset(seed=4)
    torch.testing.assert_close(environment.observe(), first, rtol=0, atol=0)
    task = _lift_box(environment)
    shift, turn = task._pose_noise()
    noise = task.config.noise
    assert 0.0 < shift.abs().max() <= noise.position and 0.0 < turn.abs().max() <= noise.angle
    environment.step(environment.action_map.action(environment.command))
    assert not torch.equal(task._pose_noise()[0], shift)


def test_the_observed_box_is_off_by_the_noise_and_the_same_way_all_episode(make: Make) -> None:
    noise = NoiseConfig(position=0.02, angle=0.05)
    environment, exact = make(16, LiftBoxConfig(noise=noise)), make(16, LiftBoxConfig(noise=NoiseConfig(0.0, 0.0)))
    errors = []
    for moment in range(12):
        if moment == 0:
            seen, true = environment.reset(seed=3)[:, :9], exact.reset(seed=3)[:, :9]
        else:
            still = environment.action_map.action(environment.command)
            seen, true = environment.step(still).observation[:, :9], exact.step(still).observation[:, :9]
        errors.append(seen - true)
    pelvis = torch.cat([exact.measured.robot.base_position, exact.measured.robot.base_quaternion], -1)  # type: ignore[union-attr]
    position, _ = relative_pose(pelvis, exact.simulation.object_pose(BOX))
    torch.testing.assert_close(true[:, :3], position)
    shift, turn = torch.stack(errors)[..., :3], torch.stack(errors)[..., 3:]
    assert 0.5 * noise.position < shift.abs().max() <= noise.position + 1e-6
    assert 0.0 < turn.abs().max() < 3 * noise.angle
    lasting, fresh = shift.mean(dim=0), shift.std(dim=0)
    assert lasting.std() > 0.2 * noise.position, "half of the error is a bias of the episode"
    assert (fresh > 0.1 * noise.position).all(), "the other half is new at every decision"


def test_palms_are_seen_relative_to_the_box_that_is_seen(make: Make) -> None:
    environment = make(8, LiftBoxConfig(noise=NoiseConfig(position=0.1, angle=0.5)))
    observation = environment.reset(seed=3)
    measured, size = environment.measured, _lift_box(environment).episode.size
    assert measured is not None
    robot, names = measured.robot, [block.name for block in environment.blocks]
    begin = sum(block.size for block in environment.blocks[: names.index("palm_to_face")])
    for robot_number, row in enumerate(observation.numpy()):
        columns = row[3:9].reshape(2, 3)
        seen = np.column_stack([*columns, np.cross(*columns)])
        pelvis = np.empty(9)
        mujoco.mju_quat2Mat(pelvis, robot.base_quaternion[robot_number].double().numpy())
        heading = float(measured.heading[robot_number])
        to_heading = np.array(
            [[np.cos(heading), np.sin(heading), 0], [-np.sin(heading), np.cos(heading), 0], [0, 0, 1]]
        )
        for palm, side in enumerate((1.0, -1.0)):
            face = row[:3] + seen @ [0.0, side * 0.5 * float(size[robot_number, 1]), 0.0]
            world = pelvis.reshape(3, 3) @ face + robot.base_position[robot_number].numpy()
            offset = to_heading @ (world - robot.palm_position[robot_number, palm].numpy())
            at = begin + 3 * palm
            np.testing.assert_allclose(row[at : at + 3], offset, atol=1e-5)


def test_the_expert_walks_to_the_box_first(make: Make) -> None:
    environment = make(6)
    environment.reset(seed=0)
    task = _lift_box(environment)
    expert = LiftBoxExpert(environment)
    action = expert.act(environment.observe())
    command = environment.action_map.command(action)
    assert environment.measured is not None
    situation = task.look(environment.measured)
    assert (expert.phase == 0).all()
    bearing = torch.atan2(situation.near_face[:, 1], situation.near_face[:, 0])
    turning = bearing.abs() > 0.3
    assert turning.any()
    assert (torch.sign(command[turning, 2]) == torch.sign(bearing[turning])).all()
    torch.testing.assert_close(command[:, 3], torch.full((6,), 0.76))
    torch.testing.assert_close(environment.action_map.action(command), action, atol=1e-5, rtol=0)
