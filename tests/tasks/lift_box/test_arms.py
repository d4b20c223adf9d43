"""Batched arm kinematics against Pinocchio, and inverse kinematics against forward kinematics."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import torch

from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, WAIST_JOINTS
from robots.g1.kinematics import PALM_FRAMES, Kinematics
from tasks.lift_box.arms import ArmKinematics, palm_rotation, quaternion_of


@pytest.fixture(scope="module")
def arms() -> ArmKinematics:
    torch.set_num_threads(1)
    return ArmKinematics()


def _random_joints(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.8, 0.8, (count, 29))


def test_palm_poses_equal_pinocchios(arms: ArmKinematics) -> None:
    joints = _random_joints(6, 0)
    pose = arms.forward(torch.tensor(joints[:, WAIST_JOINTS]).float(), torch.tensor(joints[:, ARM_JOINTS]).float())
    kinematics = Kinematics()
    for i, row in enumerate(joints):
        q = np.concatenate([[1.0, 2.0, 3.0], pin.Quaternion(pin.rpy.rpyToMatrix(0.1, 0.2, 0.3)).coeffs(), row])
        placements = kinematics.placements(q)
        for side, name in enumerate(PALM_FRAMES):
            expected = placements["pelvis"].actInv(placements[name])
            np.testing.assert_allclose(pose.position[i, side], expected.translation, atol=1e-5)
            np.testing.assert_allclose(pose.rotation[i, side], expected.rotation, atol=1e-5)


def test_the_jacobian_equals_finite_differences(arms: ArmKinematics) -> None:
    joints = torch.tensor(_random_joints(2, 1)).float()
    waist, position = joints[:, WAIST_JOINTS], joints[:, ARM_JOINTS]
    pose, step = arms.forward(waist, position), 1e-3
    for side in range(2):
        for joint in range(7):
            change = torch.zeros_like(position)
            change[:, 7 * side + joint] = step
            ahead, behind = arms.forward(waist, position + change), arms.forward(waist, position - change)
            linear = (ahead.position - behind.position)[:, side] / (2 * step)
            torch.testing.assert_close(pose.jacobian[:, side, :3, joint], linear, atol=2e-3, rtol=0)
            turn = (ahead.rotation - behind.rotation)[:, side] / (2 * step) @ pose.rotation[:, side].transpose(-1, -2)
            angular = torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1)
            torch.testing.assert_close(pose.jacobian[:, side, 3:, joint], angular, atol=2e-3, rtol=0)


def test_inverse_kinematics_reaches_what_forward_kinematics_gave(arms: ArmKinematics) -> None:
    generator = torch.Generator().manual_seed(2)
    rest = torch.tensor(DEFAULT_POSITION[ARM_JOINTS]).float()
    goal = rest + 0.4 * (2.0 * torch.rand(32, 14, generator=generator) - 1.0)
    waist = 0.3 * (2.0 * torch.rand(32, 3, generator=generator) - 1.0)
    wanted = arms.forward(waist, goal)
    solution, distance = arms.inverse(waist, rest.repeat(32, 1), rest, wanted.position, wanted.rotation)
    found = arms.forward(waist, solution)
    assert distance.max() < 0.005
    torch.testing.assert_close(distance, (found.position - wanted.position).norm(dim=-1))
    # The palms face the same way; turning about the palm normal (y) is only preferred.
    facing = (found.rotation[..., 1] * wanted.rotation[..., 1]).sum(-1)
    assert facing.min() > np.cos(0.05)
    assert (solution >= arms.lower).all() and (solution <= arms.upper).all()


def test_quaternions_of_matrices_equal_pinocchios_at_every_branch() -> None:
    rng = np.random.default_rng(3)
    angles = [
        *rng.uniform(-np.pi, np.pi, (20, 3)),
        [np.pi, 0, 0],
        [0, 0, np.pi],
        [np.pi, 0, np.pi],
        [0, 0, 0],
    ]
    matrices = np.array([pin.rpy.rpyToMatrix(*angle) for angle in angles])
    found = quaternion_of(torch.tensor(matrices)).numpy()
    for matrix, quaternion in zip(matrices, found, strict=True):
        w, x, y, z = quaternion
        np.testing.assert_allclose(pin.Quaternion(w, x, y, z).matrix(), matrix, atol=1e-6)


def test_palms_face_each_other_with_fingers_down_and_inwards() -> None:
    rotation = palm_rotation(torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([0.5]), torch.tensor([0.2]))[0]
    left, right = rotation[0], rotation[1]
    torch.testing.assert_close(rotation @ rotation.transpose(-1, -2), torch.eye(3).expand(2, 3, 3))
    # Facing world y, the robot's left is -x: the left hand's fingers point to +x, the right hand's to -x.
    assert left[0, 0] > 0.1 and right[0, 0] < -0.1
    assert left[2, 0] == pytest.approx(-np.sin(0.5) * np.cos(0.2), abs=1e-6)
    assert left[0, 1] < -0.9 and right[0, 1] < -0.9
