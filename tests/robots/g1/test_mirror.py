"""Mirroring is an involution, and the mirrored robot moves as the mirror image of the robot.

The URDF is not exactly symmetric: link placements differ by rounding (1e-5 m), masses and inertias by up to a
permille. Tolerances below are two to three times what that amounts to; a wrong sign or partner breaks them by
orders.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, JOINT_NAMES, LOWER_JOINTS, SIDES
from robots.g1.kinematics import FRAMES, Kinematics, build_model
from robots.g1.mirror import (
    ARMS_MIRROR,
    AXIAL_VECTOR,
    JOINTS_MIRROR,
    LOWER_MIRROR,
    VECTOR,
    Mirror,
    both_arms,
    concatenate,
    signs,
)

VELOCITY_MIRROR = concatenate(VECTOR, AXIAL_VECTOR, JOINTS_MIRROR)
QUATERNION_MIRROR = signs(-1, 1, -1, 1)
"""x, y, z, w: the rotation axis is an axial vector."""
CONFIGURATION_MIRROR = concatenate(VECTOR, QUATERNION_MIRROR, JOINTS_MIRROR)

POSES = 100
PLACEMENT_TOLERANCE = 3e-5
"""Meters and rotation-matrix entries; measured 1.0e-5."""
DYNAMICS_TOLERANCE = 0.008
"""Of the greatest magnitude of each component; measured 0.0038 at most over five seeds."""


@pytest.fixture(scope="module")
def configurations() -> np.ndarray:
    model, rng = build_model(), np.random.default_rng(0)
    q = np.empty((POSES, 36))
    q[:, :3] = rng.normal(size=(POSES, 3))
    q[:, 3:7] = rng.normal(size=(POSES, 4))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    q[:, 7:] = rng.uniform(model.lowerPositionLimit[7:], model.upperPositionLimit[7:], size=(POSES, 29))
    return q


@pytest.mark.parametrize(
    "mirror",
    [
        VECTOR,
        AXIAL_VECTOR,
        JOINTS_MIRROR,
        LOWER_MIRROR,
        ARMS_MIRROR,
        VELOCITY_MIRROR,
        CONFIGURATION_MIRROR,
        JOINTS_MIRROR.repeated(6),
        concatenate(VECTOR, JOINTS_MIRROR, signs(-1)).repeated(2),
    ],
)
def test_mirroring_twice_is_the_identity(mirror: Mirror) -> None:
    values = np.random.default_rng(0).normal(size=(5, len(mirror.index)))
    assert not np.array_equal(mirror(values), values)
    np.testing.assert_array_equal(mirror(mirror(values)), values)


def test_repeated_mirrors_each_copy() -> None:
    frames = np.random.default_rng(0).normal(size=(4, 3, 29))
    expected = JOINTS_MIRROR(frames).reshape(4, 87)
    np.testing.assert_array_equal(JOINTS_MIRROR.repeated(3)(frames.reshape(4, 87)), expected)


def test_parts_agree_with_the_whole() -> None:
    values = np.random.default_rng(0).normal(size=29)
    np.testing.assert_array_equal(LOWER_MIRROR(values[LOWER_JOINTS]), JOINTS_MIRROR(values)[LOWER_JOINTS])
    np.testing.assert_array_equal(ARMS_MIRROR(values[ARM_JOINTS]), JOINTS_MIRROR(values)[ARM_JOINTS])


def test_left_knee_and_waist_by_hand() -> None:
    values = np.zeros(29)
    values[JOINT_NAMES.index("left_knee_joint")] = 1.0
    values[JOINT_NAMES.index("left_hip_roll_joint")] = 2.0
    values[JOINT_NAMES.index("waist_yaw_joint")] = 3.0
    mirrored = dict(zip(JOINT_NAMES, JOINTS_MIRROR(values), strict=True))
    assert mirrored["right_knee_joint"] == 1.0
    assert mirrored["right_hip_roll_joint"] == -2.0
    assert mirrored["waist_yaw_joint"] == -3.0
    assert sum(value != 0.0 for value in mirrored.values()) == 3


def test_both_arms_are_their_own_mirror_image() -> None:
    default = DEFAULT_POSITION[ARM_JOINTS]
    np.testing.assert_array_equal(both_arms(default[:7]), default)
    arms = both_arms((0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7))
    np.testing.assert_array_equal(arms[7:], [0.1, -0.2, -0.3, 0.4, -0.5, 0.6, -0.7])
    np.testing.assert_array_equal(ARMS_MIRROR(arms), arms)


def test_mismatched_mirror_is_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        Mirror(np.arange(3), np.ones(2))


def test_joint_and_effort_limits_are_symmetric() -> None:
    model = build_model()
    lower, upper = model.lowerPositionLimit[7:], model.upperPositionLimit[7:]
    bounds = np.stack([JOINTS_MIRROR(lower), JOINTS_MIRROR(upper)])
    np.testing.assert_allclose(bounds.min(axis=0), lower, atol=1e-9)
    np.testing.assert_allclose(bounds.max(axis=0), upper, atol=1e-9)
    np.testing.assert_array_equal(np.abs(JOINTS_MIRROR(model.effortLimit[6:])), model.effortLimit[6:])


def test_mirrored_kinematics(configurations: np.ndarray) -> None:
    """The left palm of the mirrored robot is the mirror image of the right palm, and so on."""
    kinematics = Kinematics()
    reflection = np.diag([1.0, -1.0, 1.0])
    left, right = SIDES
    for q in configurations:
        original, mirrored = kinematics.placements(q), kinematics.placements(CONFIGURATION_MIRROR(q))
        for name in FRAMES:
            partner = name.replace(left, right) if left in name else name.replace(right, left)
            expected = original[name].translation * np.diag(reflection)
            np.testing.assert_allclose(mirrored[partner].translation, expected, atol=PLACEMENT_TOLERANCE)
            expected = reflection @ original[name].rotation @ reflection
            np.testing.assert_allclose(mirrored[partner].rotation, expected, atol=PLACEMENT_TOLERANCE)


def test_mirrored_dynamics(configurations: np.ndarray) -> None:
    """Inverse and forward dynamics of the mirrored state are the mirror images of those of the state."""
    model, rng = build_model(), np.random.default_rng(1)
    data = model.createData()
    for algorithm, scale in ((pin.rnea, 3.0), (pin.aba, 10.0)):
        expected, reached = [], []
        for q in configurations:
            v, last = rng.normal(size=35), scale * rng.normal(size=35)
            expected.append(VELOCITY_MIRROR(algorithm(model, data, q, v, last)))
            reached.append(
                algorithm(model, data, CONFIGURATION_MIRROR(q), VELOCITY_MIRROR(v), VELOCITY_MIRROR(last)).copy()
            )
        error = np.abs(np.array(expected) - np.array(reached)).max(axis=0)
        assert (error < DYNAMICS_TOLERANCE * np.abs(expected).max(axis=0)).all(), error
