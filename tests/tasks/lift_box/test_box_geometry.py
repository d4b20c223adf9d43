"""Relative poses against Pinocchio, faces and tilt against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import torch
from torch import Tensor

from lowlevel.world.measures import Measurement
from lowlevel.world.simulation import RobotState
from robots.g1.kinematics import placement, pose_in_pelvis
from robots.rotations import from_roll_pitch_yaw
from tasks.lift_box.geometry import observe_situation, relative_pose, rotation_6d


def _random_pose(generator: torch.Generator, count: int) -> Tensor:
    quaternion = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    return torch.cat([torch.randn(count, 3, generator=generator), quaternion], -1)


def test_the_relative_pose_is_pinocchios_act_inv() -> None:
    generator = torch.Generator().manual_seed(0)
    pelvis, box = _random_pose(generator, 20), _random_pose(generator, 20)
    position, quaternion = relative_pose(pelvis, box)
    six = rotation_6d(quaternion)
    for i in range(20):
        expected = pose_in_pelvis(
            placement(pelvis[i, :3].double().numpy(), pelvis[i, 3:].double().numpy()),
            placement(box[i, :3].double().numpy(), box[i, 3:].double().numpy()),
        )
        np.testing.assert_allclose(position[i], expected.translation, atol=1e-5)
        np.testing.assert_allclose(six[i], expected.rotation[:, :2].T.reshape(-1), atol=1e-5)


def _measurement(heading: float, palms: Tensor) -> Measurement:
    zeros = torch.zeros(1, 3)
    facing = from_roll_pitch_yaw(torch.tensor([[0.0, 0.0, heading]]))
    robot = RobotState(
        joint_position=torch.zeros(1, 29),
        joint_velocity=torch.zeros(1, 29),
        joint_torque=torch.zeros(1, 29),
        base_position=torch.tensor([[0.0, 0.0, 0.7]]),
        base_quaternion=facing,
        base_linear_velocity=zeros,
        base_angular_velocity=zeros,
        center_of_mass=torch.zeros(1, 3),
        center_of_mass_velocity=torch.zeros(1, 3),
        torso_quaternion=facing,
        foot_position=torch.zeros(1, 2, 3),
        foot_velocity=torch.zeros(1, 2, 3),
        foot_force=torch.zeros(1, 2, 3),
        palm_position=palms,
        palm_quaternion=facing[:, None].expand(-1, 2, -1),
        body_points=torch.ones(1, 7, 3),
    )
    return Measurement(
        robot=robot,
        heading=torch.tensor([heading]),
        linear_velocity=torch.tensor([[0.3, -0.4, 0.1]]),
        yaw_rate=torch.zeros(1),
        projected_gravity=torch.tensor([[0.0, 0.0, -1.0]]),
        base_height=torch.tensor([0.7]),
        torso_orientation=from_roll_pitch_yaw(torch.tensor([[0.1, 0.6, -0.2]])),
        capture_point=torch.zeros(1, 2),
        foot_position=torch.zeros(1, 2, 3),
        foot_velocity=torch.zeros(1, 2, 3),
        foot_force=torch.zeros(1, 2, 3),
        foot_clearance=torch.zeros(1, 2),
        foot_contact=torch.ones(1, 2, dtype=torch.bool),
        body_clearance=torch.ones(1, 7),
    )


def test_distances_forces_and_angles_of_a_box_straight_ahead() -> None:
    size = torch.tensor([[0.3, 0.2, 0.4]])
    box = torch.tensor([[1.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0]])
    # The left palm 5 cm outside its face; the right one 3 cm above the top edge of its own.
    palms = torch.tensor([[[1.0, 0.15, 0.2], [1.0, -0.1, 0.43]]])
    force = torch.tensor([[[1.0, -12.0, 3.0], [0.0, 7.0, 2.0]]])
    seen = observe_situation(_measurement(0.0, palms), box, size, force)
    torch.testing.assert_close(seen.near_face, torch.tensor([[0.85, 0.0, -0.5]]))
    torch.testing.assert_close(seen.palm_distance, torch.tensor([[0.05, 0.03]]))
    torch.testing.assert_close(seen.palm_offset[0], torch.tensor([[0.0, -0.05, 0.0], [0.0, 0.0, -0.23]]))
    torch.testing.assert_close(seen.palm_force, torch.tensor([[12.0, 7.0]]))
    torch.testing.assert_close(seen.bottom, torch.zeros(1))
    torch.testing.assert_close(seen.speed, torch.tensor([0.5]))
    torch.testing.assert_close(seen.torso_pitch, torch.tensor([0.6]))
    assert seen.tilt.item() < 1e-3 and seen.yaw_error.item() == 0.0
    pulling = observe_situation(_measurement(0.0, palms), box, size, -force)
    assert (pulling.palm_force == 0.0).all()


def test_a_tilted_box_reaches_lower_with_its_edge() -> None:
    size, angle = torch.tensor([[0.3, 0.3, 0.3]]), 0.4
    quaternion = from_roll_pitch_yaw(torch.tensor([[angle, 0.0, 0.0]]))
    box = torch.cat([torch.tensor([[0.0, 1.0, 0.5]]), quaternion], -1)
    seen = observe_situation(_measurement(1.2, torch.zeros(1, 2, 3)), box, size, torch.zeros(1, 2, 3))
    corner = 0.15 * (np.cos(angle) + np.sin(angle))
    assert abs(seen.bottom.item() - (0.5 - corner)) < 1e-5
    assert abs(seen.tilt.item() - angle) < 1e-3
    assert abs(seen.yaw_error.item() + 1.2) < 1e-5
    # In the heading frame the box's -x face is a rotation by minus the heading away.
    expected = pin.rpy.rpyToMatrix(0.0, 0.0, -1.2) @ np.array([-0.15, 1.0, -0.2])
    np.testing.assert_allclose(seen.near_face[0], expected, atol=1e-5)
