"""Pinocchio model of the G1 and the conversions between Pinocchio's and MuJoCo's conventions.

========================  ==============================  ==============================
floating base             MuJoCo ``qpos`` / ``qvel``      Pinocchio ``q`` / ``v``
========================  ==============================  ==============================
quaternion                w, x, y, z                      x, y, z, w
linear velocity           in the world frame              in the pelvis frame
angular velocity          in the pelvis frame             in the pelvis frame
========================  ==============================  ==============================

Both linear velocities are those of the pelvis origin; the 29 joints have the same order in both.
"""

from __future__ import annotations

import functools

import numpy as np
import pinocchio as pin

from robots.errors import PilotError
from robots.g1.constants import (
    ARMATURE,
    FOOT_BODIES,
    HAND_BODIES,
    JOINT_NAMES,
    PALM_OFFSET,
    PELVIS_BODY,
    TORSO_BODY,
    urdf_path,
)

PALM_FRAMES = ("left_palm", "right_palm")
"""Palm centers, with the axes of the wrist-yaw links."""
FRAMES = (PELVIS_BODY, TORSO_BODY, *FOOT_BODIES, *PALM_FRAMES)
"""Frames that :class:`Kinematics` reports: pelvis, torso, feet (ankle-roll links) and palms."""

_WXYZ_TO_XYZW = [1, 2, 3, 0]
_XYZW_TO_WXYZ = [3, 0, 1, 2]


@functools.cache
def build_model() -> pin.Model:
    """The G1 with a free-flyer pelvis, palm frames and rotor inertias (nq 36, nv 35).

    Built once and shared: copy it before changing it.

    Raises:
        PilotError: if the URDF is not installed.
        PilotError: if the URDF's joints are not those of :data:`robots.g1.constants.JOINT_NAMES`.
    """
    path = urdf_path()
    model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    if tuple(model.names)[2:] != JOINT_NAMES:
        raise PilotError(f"{path} is not the 29-joint G1: its joints are {', '.join(list(model.names)[2:])}")
    for palm, hand in zip(PALM_FRAMES, HAND_BODIES, strict=True):
        hand_id = model.getFrameId(hand)
        wrist = model.frames[hand_id]
        pose = wrist.placement * pin.SE3(np.eye(3), np.array(PALM_OFFSET))
        model.addFrame(pin.Frame(palm, wrist.parentJoint, hand_id, pose, pin.FrameType.OP_FRAME))
    model.armature = np.concatenate([np.zeros(6), ARMATURE])
    return model


def to_pinocchio(qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pinocchio's q (..., 36) and v (..., 35) from MuJoCo's ``qpos`` (..., 36) and ``qvel`` (..., 35)."""
    quaternion = qpos[..., 3:7][..., _WXYZ_TO_XYZW]
    q = np.concatenate([qpos[..., :3], quaternion, qpos[..., 7:]], axis=-1)
    inverse = quaternion * np.array([-1.0, -1.0, -1.0, 1.0])
    return q, np.concatenate([_rotate(inverse, qvel[..., :3]), qvel[..., 3:]], axis=-1)


def to_mujoco(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """MuJoCo's qpos (..., 36) and qvel (..., 35) from Pinocchio's ``q`` (..., 36) and ``v`` (..., 35)."""
    quaternion = q[..., 3:7]
    qpos = np.concatenate([q[..., :3], quaternion[..., _XYZW_TO_WXYZ], q[..., 7:]], axis=-1)
    return qpos, np.concatenate([_rotate(quaternion, v[..., :3]), v[..., 3:]], axis=-1)


def placement(position: np.ndarray, quaternion: np.ndarray) -> pin.SE3:
    """The pose at ``position`` (3,) [m] with MuJoCo's unit ``quaternion`` (4,) w, x, y, z."""
    return pin.XYZQUATToSE3(np.concatenate([position, np.asarray(quaternion)[_WXYZ_TO_XYZW]]))


class Kinematics:
    """Frame placements of one robot. Keeps Pinocchio's workspace between calls: one object per thread."""

    def __init__(self) -> None:
        self.model = build_model()
        self._data = self.model.createData()
        self._frames = {name: self.model.getFrameId(name) for name in FRAMES}

    def placements(self, q: np.ndarray) -> dict[str, pin.SE3]:
        """World placements of :data:`FRAMES` at Pinocchio's configuration ``q`` (36,)."""
        pin.framesForwardKinematics(self.model, self._data, q)
        return {name: self._data.oMf[frame].copy() for name, frame in self._frames.items()}


def pose_in_pelvis(pelvis: pin.SE3, thing: pin.SE3) -> pin.SE3:
    """Pose of a thing in the pelvis frame, from the world poses of both."""
    return pelvis.actInv(thing)


def _rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate ``vector`` (..., 3) by the unit ``quaternion`` (..., 4) x, y, z, w."""
    axis, scalar = quaternion[..., :3], quaternion[..., 3:]
    twice = 2.0 * np.cross(axis, vector)
    return vector + scalar * twice + np.cross(axis, twice)
