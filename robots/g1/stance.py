"""Inverse kinematics of a balanced double stance: leg and waist joints for one torso posture.

A posture (h, roll, pitch, yaw) leaves the G1 four degrees of freedom: how pelvis and waist share the torso's
roll and pitch, and where the center of mass sits over the feet. A regularized least-squares problem chooses
among them. Its unknowns are the pelvis's x, y, roll and pitch and the 15 leg and waist joints; the pelvis's
height is h and its yaw is zero by construction, so that the heading frame is the world frame. The ground is
at z = 0 and the ankles are at x = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from robots.g1.constants import (
    DEFAULT_POSITION,
    FOOT_BODIES,
    LOWER_JOINTS,
    NUM_JOINTS,
    SOLE_OFFSET,
    TORSO_BODY,
    joint_index,
)
from robots.g1.kinematics import build_model

STANCE_HALF_WIDTH = 0.12
"""Lateral distance of each ankle from the middle [m]; about the hips' own, so that the legs stand upright."""
CONTACT_POINTS = np.array([[-0.05, -0.025], [-0.05, 0.025], [0.12, -0.03], [0.12, 0.03]])
"""Contact points of a sole in the ankle-roll frame, x and y [m]: the URDF's foot spheres."""
COM_MARGIN = 0.02
"""Least distance of the center of mass from the border of the support polygon [m]."""
LIMIT_MARGIN = 0.02
"""Least distance of a joint from its limits [rad]."""
FOOT_TOLERANCE = 1e-3
"""Greatest error of a foot in a solved stance [m and rad]."""
KNEE_MINIMUM = 0.2
"""Least knee angle [rad]: near the straight leg small changes of height take large changes of the joints."""

_COM_TARGET = np.array([0.03, 0.0])
# The band around the support polygon's core in which leaving it starts to cost [m].
_COM_BOX = np.array([[-0.027, -0.11], [0.097, 0.11]])
_LIMIT_BAND = 0.06
# Weights per meter or radian. Feet and torso are constraints in all but name.
_CONSTRAINT_WEIGHT = 1000.0
_COM_WEIGHT, _COM_BOX_WEIGHT = 10.0, 200.0
_LIMIT_WEIGHT = 20.0
_BASE_WEIGHT = np.array([0.0, 0.0, 0.5, 0.5])
_LEG_WEIGHT = (0.03, 0.2, 0.2, 0.03, 0.03, 0.03)
_JOINT_WEIGHT = np.array([*_LEG_WEIGHT, *_LEG_WEIGHT, 0.05, 0.5, 0.7])

_MAX_ITERATIONS = 60
_MAX_STEP = 0.3
_CONVERGED_STEP = 1e-5


@dataclass(frozen=True)
class Stance:
    """A double stance and how sound it is.

    ``unknowns`` (19,): pelvis x, y [m], roll, pitch [rad], then the leg and waist joints [rad]. ``torques``
    (15,) hold it against gravity [N m]. ``foot_error`` and ``torso_error`` are what inverse kinematics left
    over [m and rad]. The margins to the support polygon [m], joint limits [rad] and effort limits [N m] are
    negative outside.
    """

    unknowns: np.ndarray
    torques: np.ndarray
    foot_error: float
    torso_error: float
    com_margin: float
    limit_margin: float
    effort_margin: float

    @property
    def joints(self) -> np.ndarray:
        """Leg and waist joints (15,) [rad]."""
        return self.unknowns[4:]

    def is_sound(self, tolerance: float = FOOT_TOLERANCE) -> bool:
        """Whether feet and torso are where they should be within ``tolerance`` and all margins are kept."""
        return (
            max(self.foot_error, self.torso_error) < tolerance
            and self.com_margin >= COM_MARGIN
            and self.limit_margin >= LIMIT_MARGIN
            and self.effort_margin >= 0.0
        )


class StanceSolver:
    """Solves for one posture at a time; keeps Pinocchio's workspace between calls."""

    def __init__(self) -> None:
        self.model = build_model()
        self.data = self.model.createData()
        self._feet = [self.model.getFrameId(name) for name in FOOT_BODIES]
        self._torso = self.model.getFrameId(TORSO_BODY)
        self._foot_targets = [
            pin.SE3(np.eye(3), np.array([0.0, side * STANCE_HALF_WIDTH, -SOLE_OFFSET])) for side in (1.0, -1.0)
        ]
        self.lower_limit = self.model.lowerPositionLimit[7:][LOWER_JOINTS].copy()
        self.upper_limit = self.model.upperPositionLimit[7:][LOWER_JOINTS].copy()
        self.lower_limit[[joint_index("left_knee_joint"), joint_index("right_knee_joint")]] = KNEE_MINIMUM
        # The URDF's: 35 N m at ankles and waist, where the motors give 50 (constants.Motor); a margin.
        self.effort_limit = self.model.effortLimit[6:][LOWER_JOINTS].copy()

    def solve(self, posture: np.ndarray, start: np.ndarray | None = None) -> Stance:
        """Gauss-Newton for ``posture`` (4,) = (h, roll, pitch, yaw) from ``start`` (19,), else from standing.

        A posture that cannot be reached gives a stance that is not sound, not an error.
        """
        unknowns = np.concatenate([np.zeros(4), DEFAULT_POSITION[LOWER_JOINTS]]) if start is None else start.copy()
        for iteration in range(_MAX_ITERATIONS):
            residual, jacobian = self._residual(posture, unknowns)
            step = np.linalg.solve(jacobian.T @ jacobian + 1e-6 * np.eye(len(unknowns)), -jacobian.T @ residual)
            largest = float(np.abs(step).max())
            # Full steps restore the feet at once; shorter ones later stop cycling between active limits.
            step *= min(1.0 if iteration < 15 else 0.3, _MAX_STEP / largest)
            unknowns += step
            unknowns[4:] = np.clip(unknowns[4:], self.lower_limit, self.upper_limit)
            if largest < _CONVERGED_STEP:
                break
        return self.evaluate(posture, unknowns)

    def evaluate(self, posture: np.ndarray, unknowns: np.ndarray) -> Stance:
        """How well ``unknowns`` (19,) hold ``posture`` (4,)."""
        q = self.configuration(posture[0], unknowns)
        torques = self.gravity_torques(q)
        joints = unknowns[4:]
        feet = [pin.log6(error).vector for error in self._foot_errors()]
        return Stance(
            unknowns=unknowns,
            torques=torques,
            foot_error=float(np.abs(feet).max()),
            torso_error=float(np.abs(pin.log3(self._torso_error(posture))).max()),
            com_margin=support_margin(self.data.com[0][:2]),
            limit_margin=float(np.minimum(joints - self.lower_limit, self.upper_limit - joints).min()),
            effort_margin=float((self.effort_limit - np.abs(torques)).min()),
        )

    def place(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stand on the ground with leg and waist ``joints`` (15,), both feet as near their places as can be.

        Returns the unknowns (19,) and the posture (4,) that result. Used to judge interpolated joints, whose
        feet are not exactly flat and whose pelvis height is not exactly the one asked for.
        """
        q = pin.neutral(self.model)
        q[7:] = DEFAULT_POSITION
        q[7:][LOWER_JOINTS] = joints
        pin.framesForwardKinematics(self.model, self.data, q)
        left, right = (
            target * self.data.oMf[foot].inverse() for foot, target in zip(self._feet, self._foot_targets, strict=True)
        )
        pelvis = pin.SE3.Interpolate(left, right, 0.5)
        roll, pitch, yaw = pin.rpy.matrixToRpy(pelvis.rotation)
        heading = pin.rpy.rpyToMatrix(0.0, 0.0, yaw)
        torso = heading.T @ pelvis.rotation @ self.data.oMf[self._torso].rotation
        unknowns = np.concatenate([pelvis.translation[:2], [roll, pitch], joints])
        return unknowns, np.concatenate([pelvis.translation[2:], pin.rpy.matrixToRpy(torso)])

    def configuration(self, height: float, unknowns: np.ndarray) -> np.ndarray:
        """Pinocchio's q (36,) for pelvis ``height`` [m] and ``unknowns`` (19,), arms at their default."""
        x, y, roll, pitch = unknowns[:4]
        q = np.empty(self.model.nq)
        q[:7] = pin.SE3ToXYZQUAT(pin.SE3(pin.rpy.rpyToMatrix(roll, pitch, 0.0), np.array([x, y, height])))
        q[7:] = DEFAULT_POSITION
        q[7:][LOWER_JOINTS] = unknowns[4:]
        return q

    def gravity_torques(self, q: np.ndarray) -> np.ndarray:
        """Leg and waist torques (15,) [N m] that hold ``q`` (36,), with least-norm contact forces."""
        model, data = self.model, self.data
        gravity = pin.computeGeneralizedGravity(model, data, q)
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        pin.centerOfMass(model, data, q)
        blocks = []
        for foot in self._feet:
            frame = pin.getFrameJacobian(model, data, foot, pin.LOCAL_WORLD_ALIGNED)
            for x, y in CONTACT_POINTS:
                lever = data.oMf[foot].rotation @ np.array([x, y, SOLE_OFFSET])
                blocks.append(frame[:3] - pin.skew(lever) @ frame[3:])
        jacobian = np.vstack(blocks)
        forces = np.linalg.lstsq(jacobian[:, :6].T, gravity[:6], rcond=None)[0]
        return (gravity - jacobian.T @ forces)[6:][LOWER_JOINTS]

    def _foot_errors(self) -> list[pin.SE3]:
        return [t.actInv(self.data.oMf[foot]) for foot, t in zip(self._feet, self._foot_targets, strict=True)]

    def _torso_error(self, posture: np.ndarray) -> np.ndarray:
        return pin.rpy.rpyToMatrix(*posture[1:]).T @ self.data.oMf[self._torso].rotation

    def _residual(self, posture: np.ndarray, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted residuals (R,) and their Jacobian (R, 19)."""
        model, data = self.model, self.data
        q = self.configuration(posture[0], unknowns)
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        com_jacobian = pin.jacobianCenterOfMass(model, data, q)
        tangent = _tangent(*unknowns[2:4])
        joints_only = np.eye(19)[4:]
        rows: list[tuple[np.ndarray, np.ndarray]] = []
        for foot, error in zip(self._feet, self._foot_errors(), strict=True):
            jacobian = pin.Jlog6(error) @ pin.getFrameJacobian(model, data, foot, pin.LOCAL) @ tangent
            rows.append((_CONSTRAINT_WEIGHT * pin.log6(error).vector, _CONSTRAINT_WEIGHT * jacobian))
        error = self._torso_error(posture)
        jacobian = pin.Jlog3(error) @ pin.getFrameJacobian(model, data, self._torso, pin.LOCAL)[3:] @ tangent
        rows.append((_CONSTRAINT_WEIGHT * pin.log3(error), _CONSTRAINT_WEIGHT * jacobian))
        com, com_jacobian = data.com[0][:2], com_jacobian[:2] @ tangent
        rows.append((_COM_WEIGHT * (com - _COM_TARGET), _COM_WEIGHT * com_jacobian))
        outside = _excess(com, *_COM_BOX)
        rows.append((_COM_BOX_WEIGHT * outside, _COM_BOX_WEIGHT * (outside != 0.0)[:, None] * com_jacobian))
        rows.append((_BASE_WEIGHT * unknowns[:4], _BASE_WEIGHT[:, None] * np.eye(19)[:4]))
        joints = unknowns[4:]
        rows.append((_JOINT_WEIGHT * joints, _JOINT_WEIGHT[:, None] * joints_only))
        outside = _excess(joints, self.lower_limit + _LIMIT_BAND, self.upper_limit - _LIMIT_BAND)
        rows.append((_LIMIT_WEIGHT * outside, _LIMIT_WEIGHT * (outside != 0.0)[:, None] * joints_only))
        return np.concatenate([row[0] for row in rows]), np.vstack([row[1] for row in rows])


def support_margin(point: np.ndarray) -> float:
    """Distance of a ground point (2,) from the border of the support polygon [m], negative outside.

    The polygon is the hull of the contact points of both feet at their places.
    """
    heel, toe = CONTACT_POINTS[1], CONTACT_POINTS[3]
    edge = (toe - heel) / np.linalg.norm(toe - heel)
    offset = np.array([point[0], abs(point[1]) - STANCE_HALF_WIDTH]) - heel
    return float(min(point[0] - heel[0], toe[0] - point[0], edge[1] * offset[0] - edge[0] * offset[1]))


def _excess(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """How far values lie above ``upper`` (positive) or below ``lower`` (negative); zero between."""
    return np.maximum(values - upper, 0.0) + np.minimum(values - lower, 0.0)


def _tangent(roll: float, pitch: float) -> np.ndarray:
    """Derivative of Pinocchio's velocity (pelvis twist in its frame, joints) by the unknowns, (35, 19)."""
    tangent = np.zeros((6 + NUM_JOINTS, 19))
    tangent[0:3, 0:2] = pin.rpy.rpyToMatrix(roll, pitch, 0.0).T[:, 0:2]
    tangent[3:6, 2] = (1.0, 0.0, 0.0)
    tangent[3:6, 3] = (0.0, np.cos(roll), -np.sin(roll))
    tangent[6:21, 4:19] = np.eye(15)
    return tangent
