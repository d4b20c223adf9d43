"""The Unitree G1 (29 DoF, rev 1.0) as data: joints, motors, gains and frames.

Joint order is Unitree's and is stated once, in :data:`JOINTS`; everything else is indexed by name.
Position limits are read from the URDF by :mod:`robots.g1.model`.

Efforts are the URDF's but for the joints that two 5020 motors of 25 N m drive in parallel, ankles and waist roll and
pitch: 50 N m, as in Unitree's MJCF of the same revision, in mjlab, HOMIE and FALCON; the URDF says 35.

Sources: rotor inertias and the armature gain rule are those published with mjlab
(``asset_zoo/robots/unitree_g1/g1_constants.py``) and BeyondMimic; waist and ankle gains of the stiff set
follow HOMIE's training configuration, arm gains follow Unitree's ``xr_teleoperate``. Its hips and knees are stiffer
than HOMIE's (100 and 150 N m/rad): standing on the ankles' 80 N m/rad alone leaves no room for legs that give way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from importlib import metadata
from pathlib import Path

import numpy as np

from robots.errors import PilotError


class Motor(Enum):
    """Actuator type; the value is the reflected rotor inertia (armature) [kg m^2] and the largest torque [N m]."""

    GEAR_7520_14 = (0.01018, 88.0)
    GEAR_7520_22 = (0.02510, 139.0)
    DUAL_5020 = (0.00722, 50.0)
    SINGLE_5020 = (0.00361, 25.0)
    SINGLE_4010 = (0.00425, 5.0)

    def __init__(self, armature: float, effort: float) -> None:
        self.armature = armature
        self.effort = effort


@dataclass(frozen=True)
class Joint:
    """One actuated joint: URDF name, motor, and default position [rad]."""

    name: str
    motor: Motor
    default: float = 0.0


def _leg(side: str) -> tuple[Joint, ...]:
    return (
        Joint(f"{side}_hip_pitch_joint", Motor.GEAR_7520_14, -0.2),
        Joint(f"{side}_hip_roll_joint", Motor.GEAR_7520_22),
        Joint(f"{side}_hip_yaw_joint", Motor.GEAR_7520_14),
        Joint(f"{side}_knee_joint", Motor.GEAR_7520_22, 0.42),
        Joint(f"{side}_ankle_pitch_joint", Motor.DUAL_5020, -0.23),
        Joint(f"{side}_ankle_roll_joint", Motor.DUAL_5020),
    )


def _arm(side: str) -> tuple[Joint, ...]:
    outwards = 1.0 if side == "left" else -1.0
    return (
        Joint(f"{side}_shoulder_pitch_joint", Motor.SINGLE_5020, 0.3),
        Joint(f"{side}_shoulder_roll_joint", Motor.SINGLE_5020, outwards * 0.2),
        Joint(f"{side}_shoulder_yaw_joint", Motor.SINGLE_5020),
        Joint(f"{side}_elbow_joint", Motor.SINGLE_5020, 0.9),
        Joint(f"{side}_wrist_roll_joint", Motor.SINGLE_5020),
        Joint(f"{side}_wrist_pitch_joint", Motor.SINGLE_4010),
        Joint(f"{side}_wrist_yaw_joint", Motor.SINGLE_4010),
    )


_WAIST = (
    Joint("waist_yaw_joint", Motor.GEAR_7520_14),
    Joint("waist_roll_joint", Motor.DUAL_5020),
    Joint("waist_pitch_joint", Motor.DUAL_5020),
)

JOINTS: tuple[Joint, ...] = (*_leg("left"), *_leg("right"), *_WAIST, *_arm("left"), *_arm("right"))
JOINT_NAMES: tuple[str, ...] = tuple(joint.name for joint in JOINTS)
NUM_JOINTS = len(JOINTS)

GRAVITY = 9.81
"""[m/s^2]"""
WAIST_JOINTS = slice(12, 15)
LOWER_JOINTS = slice(0, 15)
"""Legs and waist: the joints that carry the body."""
ARM_JOINTS = slice(15, 29)

DEFAULT_POSITION = np.array([joint.default for joint in JOINTS])
"""Default joint positions (29,) [rad]; knees and elbows slightly bent, arms at the sides."""
ARMATURE = np.array([joint.motor.armature for joint in JOINTS])
"""Reflected rotor inertia (29,) [kg m^2]."""
EFFORT = np.array([joint.motor.effort for joint in JOINTS])
"""Largest torque (29,) [N m]."""

PELVIS_BODY = "pelvis"
TORSO_BODY = "torso_link"
FOOT_BODIES = ("left_ankle_roll_link", "right_ankle_roll_link")
HAND_BODIES = ("left_wrist_yaw_link", "right_wrist_yaw_link")
SIDES = ("left", "right")

SOLE_OFFSET = -0.035
"""Height of the sole in the ankle-roll frame [m]: the URDF's foot spheres, center -0.030, radius 0.005."""
SOLE_CENTER = 0.035
"""Middle of the sole ahead of the ankle-roll frame [m]; the foot sites lie there."""
PALM_HALF_THICKNESS = 0.012
"""Of the palm plates [m]: the surface that touches lies this far from the palm center along the palm normal."""
PALM_OFFSET = (0.09, 0.0, 0.0)
"""Palm center in the wrist-yaw frame [m]; the palm normal is -y on the left hand, +y on the right."""


@dataclass(frozen=True)
class BodyPoint:
    """A ball that stands for a part of the robot: center in the frame of ``body`` [m], and ``radius`` [m]."""

    name: str
    body: str
    center: tuple[float, float, float]
    radius: float


BODY_POINTS: tuple[BodyPoint, ...] = (
    BodyPoint("pelvis", PELVIS_BODY, (0.0, 0.0, 0.0), 0.12),
    BodyPoint("torso", TORSO_BODY, (0.0, 0.0, 0.2), 0.12),
    BodyPoint("head", TORSO_BODY, (0.0, 0.0, 0.43), 0.08),
    BodyPoint("left_knee", "left_knee_link", (0.0, 0.0, 0.0), 0.06),
    BodyPoint("right_knee", "right_knee_link", (0.0, 0.0, 0.0), 0.06),
    BodyPoint("left_elbow", "left_elbow_link", (0.0, 0.0, 0.0), 0.05),
    BodyPoint("right_elbow", "right_elbow_link", (0.0, 0.0, 0.0), 0.05),
)
"""What never reaches the ground unless the robot falls."""
TOTAL_MASS = 33.341
"""Mass of all links in the URDF [kg]."""


def joint_index(name: str) -> int:
    """Index of a joint in Unitree's order.

    Raises:
        PilotError: if the robot has no joint of that name.
    """
    if name not in JOINT_NAMES:
        raise PilotError(f"the G1 has no joint named {name!r}; its joints are {', '.join(JOINT_NAMES)}")
    return JOINT_NAMES.index(name)


@dataclass(frozen=True)
class Gains:
    """PD gains and action scale, one number per joint (29,).

    ``stiffness`` [N m/rad], ``damping`` [N m s/rad], ``action_scale`` [rad per unit of action].
    """

    stiffness: np.ndarray
    damping: np.ndarray
    action_scale: np.ndarray


def _per_joint(legs: tuple[float, ...], waist: tuple[float, ...], arm: tuple[float, ...]) -> np.ndarray:
    return np.array([*legs, *legs, *waist, *arm, *arm])


def _armature_gains() -> Gains:
    # Each joint becomes a 10 Hz oscillator on its own rotor inertia with damping ratio 2 (mjlab, BeyondMimic).
    natural_frequency = 2.0 * math.pi * 10.0
    stiffness = ARMATURE * natural_frequency**2
    damping = 2.0 * 2.0 * ARMATURE * natural_frequency
    return Gains(stiffness, damping, 0.25 * EFFORT / stiffness)


STIFF_GAINS = Gains(
    stiffness=_per_joint((150, 150, 150, 300, 40, 40), (200, 200, 200), (80, 80, 80, 80, 40, 40, 40)),
    damping=_per_joint((5, 5, 5, 8, 2, 2), (5, 5, 5), (3, 3, 3, 3, 1.5, 1.5, 1.5)),
    action_scale=_per_joint((1 / 6, 1 / 6, 1 / 6, 0.125, 0.25, 0.25), (0.12,) * 3, (0.08,) * 7),
)
SOFT_GAINS = _armature_gains()
GAINS: dict[str, Gains] = {"stiff": STIFF_GAINS, "soft": SOFT_GAINS}


def gain_set(name: str) -> Gains:
    """A gain set of :data:`GAINS` by name.

    Raises:
        PilotError: if there is none of that name.
    """
    if name not in GAINS:
        raise PilotError(f"unknown gain set {name!r}; choose one of {', '.join(GAINS)}")
    return GAINS[name]


def urdf_path() -> Path:
    """Path of the G1 URDF that the ``example-robot-data`` package installs.

    Raises:
        PilotError: if the package is missing or does not contain the robot.
    """
    name = "g1_29dof_rev_1_0.urdf"
    try:
        files = metadata.files("example-robot-data") or []
    except metadata.PackageNotFoundError:
        files = []
    for file in files:
        if file.name == name:
            return Path(str(file.locate())).resolve()
    raise PilotError(f"{name} not found: install the robot with 'pip install example-robot-data'")
