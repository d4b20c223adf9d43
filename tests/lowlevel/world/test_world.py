"""The World: how robots are stood up, on which ground, and what is refused."""

import pytest
import torch

from lowlevel.commands import ARMS, HEIGHT, TORSO, clamp_posture, command_space
from lowlevel.world.measures import height_error, torso_error
from lowlevel.world.terrain import TerrainConfig
from lowlevel.world.world import CLEARANCE, World
from robots.errors import PilotError
from robots.g1.model import ModelOptions

SLABS = TerrainConfig(tiles=("irregular",))


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
