"""The World: how robots are stood up, on which ground, and what is refused."""

import numpy as np
import pinocchio as pin
import pytest
import torch

from lowlevel.commands import ARMS, HEIGHT, TORSO, clamp_posture, command_space
from lowlevel.world.measures import height_error, torso_error
from lowlevel.world.terrain import TerrainConfig
from lowlevel.world.world import CLEARANCE, World
from robots.errors import PilotError
from robots.g1.kinematics import build_model, to_pinocchio
from robots.g1.model import ModelOptions
from robots.rotations import rotate_about_vertical

SLABS = TerrainConfig(tiles=("slabs",))


def test_a_robot_stands_as_it_is_told_on_the_highest_ground_under_its_feet() -> None:
    """Against MuJoCo's kinematics of the whole robot."""
    world = World(ModelOptions(), SLABS, num_robots=4, num_threads=1)
    limits = world.simulation.joint_lower, world.simulation.joint_upper
    command = command_space(*(limit.tolist() for limit in limits)).neutral().repeat(4, 1)
    command[:, HEIGHT] = torch.tensor([0.76, 0.6, 0.5, 0.45])
    command[:, TORSO] = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.4, -0.6], [-0.1, 0.9, 0.3], [0.0, 1.2, 0.0]])
    command[:, ARMS] += 0.2
    command = clamp_posture(command, world.pose)
    everyone, heading = torch.arange(4), torch.tensor([0.0, 1.0, -2.0, 3.0])
    world.simulation.restart(everyone)
    world.stand(everyone, torch.tensor([[0.0, 0.0], [1.0, 2.0], [-2.0, 1.0], [0.5, -3.0]]), heading, command)
    measured = world.measure()

    # The pose table holds an attitude to a milliradian or so.
    torch.testing.assert_close(measured.heading, heading, atol=2e-3, rtol=0.0)
    torch.testing.assert_close(torso_error(measured, command), torch.zeros(4, 3), atol=2e-3, rtol=0.0)
    torch.testing.assert_close(measured.robot.joint_position[:, 15:], command[:, ARMS], atol=1e-5, rtol=0.0)
    # Slabs differ by 2 cm either way, and a robot is never stood into one.
    gaps = height_error(measured, command) - CLEARANCE
    assert (gaps > -1e-3).all() and (gaps < 0.05).all()
    assert (measured.foot_clearance > 0.0).all()
    assert not world.fallen(measured).any()


def test_what_is_measured_in_the_heading_frame_does_not_depend_on_the_heading() -> None:
    world = World(ModelOptions(), TerrainConfig(), num_robots=3, num_threads=1)
    limits = world.simulation.joint_lower, world.simulation.joint_upper
    neutral = command_space(*(limit.tolist() for limit in limits)).neutral().repeat(3, 1)
    heading = torch.tensor([0.0, 1.5, -2.5])
    forwards = torch.zeros(3, 6)
    forwards[:, 0], forwards[:, 1] = 0.5 * torch.cos(heading), 0.5 * torch.sin(heading)
    everyone = torch.arange(3)
    world.simulation.restart(everyone)
    joints = world.stand(everyone, torch.zeros(3, 2), heading, neutral, velocity=forwards)
    for _ in range(5):
        measured = world.advance(joints)
    assert measured.foot_contact.any(dim=1).all() and (measured.linear_velocity[:, 0] > 0.3).all()
    for name in ("linear_velocity", "foot_position", "foot_velocity", "foot_force"):
        values = getattr(measured, name)
        torch.testing.assert_close(values[1:], values[:1].expand_as(values[1:]), atol=1e-2, rtol=1e-2)


def test_what_no_world_can_be_made_of_is_refused() -> None:
    with pytest.raises(PilotError, match="does not divide"):
        World(ModelOptions(timestep=0.003), TerrainConfig(), num_robots=1, num_threads=1)
    with pytest.raises(PilotError, match="num_robots must be at least 1"):
        World(ModelOptions(), TerrainConfig(), num_robots=0, num_threads=1)


def test_the_capture_point_is_pinocchios_center_of_mass_and_its_velocity() -> None:
    world = World(ModelOptions(), TerrainConfig(), num_robots=1, num_threads=1)
    simulation, robot = world.simulation, torch.arange(1)
    limits = simulation.joint_lower, simulation.joint_upper
    command = command_space(*(limit.tolist() for limit in limits)).neutral()[None]
    command[:, HEIGHT], command[:, TORSO.start + 1], command[:, ARMS] = 0.6, 0.5, 0.4
    velocity = torch.tensor([[0.3, -0.2, 0.1, 0.4, -0.5, 0.6]])
    simulation.restart(robot)
    world.stand(robot, torch.tensor([[1.0, -2.0]]), torch.tensor([0.7]), command, velocity=velocity)
    measured = world.measure()
    state = measured.robot
    qpos = torch.cat([state.base_position, state.base_quaternion, state.joint_position], dim=1)[0].double().numpy()
    qvel = torch.cat([state.base_linear_velocity, state.base_angular_velocity, state.joint_velocity], dim=1)
    q, v = to_pinocchio(qpos, qvel[0].double().numpy())
    model = build_model()
    data = model.createData()
    pin.centerOfMass(model, data, q, v)
    middle = state.foot_position[0].mean(dim=0).double().numpy()
    height = data.com[0][2] - middle[2]
    point = (data.com[0] + data.vcom[0] * np.sqrt(height / 9.81) - middle)[:2]
    expected = rotate_about_vertical(-measured.heading, torch.tensor(point, dtype=torch.float32)[None])
    torch.testing.assert_close(measured.capture_point, expected, atol=1e-4, rtol=0.0)
    assert measured.capture_point.abs().min() > 0.02
