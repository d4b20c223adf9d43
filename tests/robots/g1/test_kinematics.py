"""Pinocchio and MuJoCo describe the same robot, and the converter between them is exact."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from robots.g1 import constants
from robots.g1.kinematics import (
    FRAMES,
    PALM_FRAMES,
    Kinematics,
    build_model,
    placement,
    pose_in_pelvis,
    to_mujoco,
    to_pinocchio,
)
from robots.g1.model import build_spec

POSES = 100
STEP = 1e-6
"""Step of finite differences [s]."""


@pytest.fixture(scope="module")
def mujoco_model() -> mujoco.MjModel:
    return build_spec().compile()


@pytest.fixture(scope="module")
def states(mujoco_model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Random qpos (POSES, 36) within the joint limits and qvel (POSES, 35)."""
    rng = np.random.default_rng(0)
    qpos = np.empty((POSES, 36))
    qpos[:, :3] = rng.normal(size=(POSES, 3))
    qpos[:, 3:7] = rng.normal(size=(POSES, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 7:] = rng.uniform(mujoco_model.jnt_range[1:, 0], mujoco_model.jnt_range[1:, 1], size=(POSES, 29))
    return qpos, rng.normal(size=(POSES, 35))


def velocity_map(quaternion: np.ndarray) -> np.ndarray:
    """Matrix (35, 35) that takes MuJoCo's qvel to Pinocchio's v, from MuJoCo's own rotation matrix."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    matrix = np.eye(35)
    matrix[:3, :3] = rotation.reshape(3, 3).T
    return matrix


def test_model_is_the_g1() -> None:
    model = build_model()
    assert (model.nq, model.nv) == (36, 35)
    assert pin.computeTotalMass(model) == pytest.approx(33.34, abs=5e-3)
    assert pin.computeTotalMass(model) == pytest.approx(constants.TOTAL_MASS, abs=1e-3)
    assert tuple(model.names)[2:] == constants.JOINT_NAMES
    np.testing.assert_array_equal(model.armature[6:], constants.ARMATURE)
    assert build_model() is model


def test_limits_and_masses_agree(mujoco_model: mujoco.MjModel) -> None:
    model = build_model()
    np.testing.assert_allclose(model.lowerPositionLimit[7:], mujoco_model.jnt_range[1:, 0], atol=1e-9)
    np.testing.assert_allclose(model.upperPositionLimit[7:], mujoco_model.jnt_range[1:, 1], atol=1e-9)
    # Two 25 N m motors drive an ankle, and waist roll and pitch; the URDF says 35 N m there.
    in_pairs = np.array([joint.motor is constants.Motor.DUAL_5020 for joint in constants.JOINTS])
    np.testing.assert_allclose(model.effortLimit[6:][in_pairs], 35.0)
    np.testing.assert_allclose(mujoco_model.actuator_forcerange[in_pairs, 1], 2.0 * constants.Motor.SINGLE_5020.effort)
    np.testing.assert_allclose(model.effortLimit[6:][~in_pairs], mujoco_model.actuator_forcerange[~in_pairs, 1])
    assert mujoco_model.body_mass.sum() == pytest.approx(pin.computeTotalMass(model), abs=1e-9)


def test_forward_kinematics_agree(mujoco_model: mujoco.MjModel, states: tuple[np.ndarray, np.ndarray]) -> None:
    data, kinematics = mujoco.MjData(mujoco_model), Kinematics()
    offsets = dict.fromkeys(FRAMES, np.zeros(3)) | dict.fromkeys(PALM_FRAMES, np.array(constants.PALM_OFFSET))
    bodies = dict(zip(FRAMES, FRAMES, strict=True)) | dict(zip(PALM_FRAMES, constants.HAND_BODIES, strict=True))
    for qpos, qvel in zip(*states, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(mujoco_model, data)
        placements = kinematics.placements(to_pinocchio(qpos, qvel)[0])
        assert set(placements) == set(FRAMES)
        for name, reached in placements.items():
            body = data.body(bodies[name])
            rotation = body.xmat.reshape(3, 3)
            np.testing.assert_allclose(reached.rotation, rotation, atol=1e-6)
            np.testing.assert_allclose(reached.translation, body.xpos + rotation @ offsets[name], atol=1e-6)


def test_mass_matrices_agree(mujoco_model: mujoco.MjModel, states: tuple[np.ndarray, np.ndarray]) -> None:
    model, data = build_model(), mujoco.MjData(mujoco_model)
    workspace = model.createData()
    mass = np.empty((35, 35))
    for qpos, qvel in zip(*states, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_forward(mujoco_model, data)
        mujoco.mj_fullM(mujoco_model, data, mass)
        to_v = velocity_map(qpos[3:7])
        expected = to_v.T @ pin.crba(model, workspace, to_pinocchio(qpos, qvel)[0]) @ to_v
        upper = np.triu(np.ones((35, 35), dtype=bool))
        np.testing.assert_allclose(mass[upper], expected[upper], atol=1e-6)


def test_gravity_and_velocity_forces_agree(mujoco_model: mujoco.MjModel, states: tuple[np.ndarray, np.ndarray]) -> None:
    """``qfrc_bias`` equals Pinocchio's inverse dynamics: velocities are right inside the dynamics too.

    MuJoCo's acceleration coordinates are not Pinocchio's: with linear velocity v = R^T u, dv/dt = R^T du/dt -
    w x v.
    """
    model, data = build_model(), mujoco.MjData(mujoco_model)
    workspace = model.createData()
    for qpos, qvel in zip(*states, strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(mujoco_model, data)
        q, v = to_pinocchio(qpos, qvel)
        acceleration = np.zeros(35)
        acceleration[:3] = -np.cross(v[3:6], v[:3])
        expected = velocity_map(qpos[3:7]).T @ pin.rnea(model, workspace, q, v, acceleration)
        np.testing.assert_allclose(data.qfrc_bias, expected, atol=1e-6)


def test_conversion_round_trip(states: tuple[np.ndarray, np.ndarray]) -> None:
    q, v = to_pinocchio(*states)
    qpos, qvel = to_mujoco(q, v)
    np.testing.assert_array_equal(qpos, states[0])
    np.testing.assert_allclose(qvel, states[1], atol=1e-12)
    one = to_pinocchio(states[0][3], states[1][3])  # a single state converts like a row of a batch
    np.testing.assert_array_equal(one[0], q[3])
    np.testing.assert_allclose(one[1], v[3], atol=1e-15)


def test_converted_velocity_is_the_derivative(
    mujoco_model: mujoco.MjModel, states: tuple[np.ndarray, np.ndarray]
) -> None:
    """MuJoCo integrates qvel; Pinocchio's difference of the configurations is the converted velocity."""
    model = build_model()
    for qpos, qvel in zip(*states, strict=True):
        moved = qpos.copy()
        mujoco.mj_integratePos(mujoco_model, moved, qvel, STEP)
        q, v = to_pinocchio(qpos, qvel)
        q_moved, _ = to_pinocchio(moved, qvel)
        np.testing.assert_allclose(pin.difference(model, q, q_moved) / STEP, v, atol=2e-5)


def test_converted_velocity_moves_the_palms(
    mujoco_model: mujoco.MjModel, states: tuple[np.ndarray, np.ndarray]
) -> None:
    """Pinocchio's frame velocity equals the finite difference of MuJoCo's forward kinematics."""
    model, data = build_model(), mujoco.MjData(mujoco_model)
    workspace = model.createData()

    def palm_positions(qpos: np.ndarray) -> np.ndarray:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(mujoco_model, data)
        hands = [data.body(name) for name in constants.HAND_BODIES]
        return np.array([hand.xpos + hand.xmat.reshape(3, 3) @ constants.PALM_OFFSET for hand in hands])

    for qpos, qvel in list(zip(*states, strict=True))[:20]:
        ahead, behind = qpos.copy(), qpos.copy()
        mujoco.mj_integratePos(mujoco_model, ahead, qvel, STEP)
        mujoco.mj_integratePos(mujoco_model, behind, qvel, -STEP)
        expected = (palm_positions(ahead) - palm_positions(behind)) / (2 * STEP)
        pin.forwardKinematics(model, workspace, *to_pinocchio(qpos, qvel))
        for name, velocity in zip(PALM_FRAMES, expected, strict=True):
            frame = model.getFrameId(name)
            reached = pin.getFrameVelocity(model, workspace, frame, pin.LOCAL_WORLD_ALIGNED).linear
            np.testing.assert_allclose(reached, velocity, atol=1e-6)


def test_pose_in_pelvis() -> None:
    """By hand: a pelvis at x = 1 that is turned left by 90 degrees sees a box at x = 1, y = 2 ahead of it."""
    half = np.sqrt(0.5)
    pelvis = placement(np.array([1.0, 0.0, 0.8]), np.array([half, 0.0, 0.0, half]))
    box = placement(np.array([1.0, 2.0, 0.3]), np.array([1.0, 0.0, 0.0, 0.0]))
    relative = pose_in_pelvis(pelvis, box)
    np.testing.assert_allclose(relative.translation, [2.0, 0.0, -0.5], atol=1e-12)
    np.testing.assert_allclose(pin.rpy.matrixToRpy(relative.rotation), [0.0, 0.0, -np.pi / 2], atol=1e-12)


def test_placements_are_copies() -> None:
    """A placement must not change when the workspace moves on to the next robot."""
    kinematics, q = Kinematics(), pin.neutral(build_model())
    first = kinematics.placements(q)["pelvis"]
    q[0] = 5.0
    kinematics.placements(q)
    assert first.translation[0] == 0.0
