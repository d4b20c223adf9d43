"""Rotations against scipy-free independent sources: Pinocchio's SE(3) algebra."""

import numpy as np
import pinocchio as pin
import pytest
import torch

from robots import rotations


@pytest.fixture
def quaternions() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.nn.functional.normalize(torch.randn(50, 4, generator=generator, dtype=torch.float64), dim=-1)


def matrix(quaternion: torch.Tensor) -> np.ndarray:
    w, x, y, z = quaternion.tolist()
    return pin.Quaternion(w, x, y, z).toRotationMatrix()


def test_rotating_agrees_with_pinocchio(quaternions: torch.Tensor) -> None:
    vectors = torch.randn(50, 3, dtype=torch.float64)
    rotated, back = rotations.rotate(quaternions, vectors), rotations.rotate_inverse(quaternions, vectors)
    for i, quaternion in enumerate(quaternions):
        np.testing.assert_allclose(rotated[i], matrix(quaternion) @ vectors[i].numpy(), atol=1e-12)
        np.testing.assert_allclose(back[i], matrix(quaternion).T @ vectors[i].numpy(), atol=1e-12)


def test_products_and_rotation_vectors_agree_with_pinocchio(quaternions: torch.Tensor) -> None:
    first, second = quaternions[:25], quaternions[25:]
    product = rotations.multiply(first, second)
    logs = rotations.rotation_vector(product)
    for i in range(25):
        expected = matrix(first[i]) @ matrix(second[i])
        np.testing.assert_allclose(matrix(product[i]), expected, atol=1e-12)
        np.testing.assert_allclose(logs[i], pin.log3(expected), atol=1e-6)


def test_roll_pitch_yaw_is_the_product_of_elementary_rotations() -> None:
    angles = torch.tensor([[0.3, 1.2, -0.7], [-0.4, 1.5, 1.5]], dtype=torch.float64)
    for angle, quaternion in zip(angles, rotations.from_roll_pitch_yaw(angles), strict=True):
        np.testing.assert_allclose(matrix(quaternion), pin.rpy.rpyToMatrix(*angle.tolist()), atol=1e-12)
    assert torch.allclose(rotations.yaw_of(rotations.from_roll_pitch_yaw(angles[:1])), angles[0, 2])


def test_small_rotation_vectors_keep_their_precision() -> None:
    tiny = torch.tensor([[1.0, 5e-10, 0.0, 0.0]], dtype=torch.float64)
    assert rotations.rotation_vector(tiny)[0, 0] == pytest.approx(1e-9)


def test_turn_about_one_axis_is_the_one_with_a_single_angle() -> None:
    for axis in range(3):
        angles = torch.zeros(4, 3)
        angles[:, axis] = torch.tensor([-3.0, -0.4, 0.0, 2.5])
        assert torch.allclose(rotations.about_axis(axis, angles[:, axis]), rotations.from_roll_pitch_yaw(angles))
