"""MuJoCo model of the G1, built from the same URDF that Pinocchio reads.

The URDF gives the kinematic tree, inertias and joint limits. Added here: the free joint, rotor inertia, position
actuators with force limits, foot spheres, box-primitive palms, the self-collision pairs that matter, and sensors.
Meshes are loaded for pictures only.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from robots.errors import PilotError
from robots.g1.constants import (
    ARMATURE,
    BODY_POINTS,
    EFFORT,
    FOOT_BODIES,
    HAND_BODIES,
    JOINT_NAMES,
    PALM_HALF_THICKNESS,
    PALM_OFFSET,
    PELVIS_BODY,
    SIDES,
    SOLE_CENTER,
    SOLE_OFFSET,
    STIFF_GAINS,
    TORSO_BODY,
    Gains,
    urdf_path,
)

WORLD_COLLISION = 1
"""Collision bit of the ground and of everything else that feet can touch."""
PALM_COLLISION = 2
"""Collision bit of what palms can touch: manipulated objects."""

_FOOT_SPHERES = ((-0.05, 0.025), (-0.05, -0.025), (0.12, 0.03), (0.12, -0.03))
_FOOT_SPHERE_RADIUS = 0.02
"""Edge radius of the sole [m]. It must exceed what a foot sinks in on impact: the URDF's 5 mm spheres sink below the
top of the next slab and are stopped by its side, even where slabs differ by a millimeter."""
_FOOT_SPHERE_HEIGHT = SOLE_OFFSET + _FOOT_SPHERE_RADIUS


_TORSO_LOAD_RADIUS = 0.08
"""[m]: 5 kg of a density of 2.3 kg/l."""


@dataclass(frozen=True)
class ModelOptions:
    """What the compiled model contains."""

    gains: Gains = STIFF_GAINS
    """Stiffness and damping of the position actuators."""
    timestep: float = 0.002
    """Physics step [s]."""
    visuals: bool = False
    """Load the visual meshes (for pictures and recordings; never needed for physics)."""
    elliptic_friction: bool = False
    """Elliptic friction cones with ``impratio`` (grasping) instead of pyramidal ones (locomotion, cheaper)."""
    floor: bool = True
    """Add an infinite ground plane named ``floor``."""
    solver_iterations: int = 10
    """Most Newton iterations per step; it stops once converged. With 3, feet of friction 0.5 never come to rest."""
    line_search_iterations: int = 20
    """Most iterations of the line search in each of them. A higher ``impratio`` needs more."""
    impratio: float = 10.0
    """How much stiffer friction is than contact, with elliptic cones: what keeps a squeezed box from creeping."""
    friction: float = 1.0
    """Sliding friction coefficient of floor, feet and palms."""
    armature_scale: float = 1.0
    """Factor on the rotor inertia of all motors."""
    torso_mass: float = 0.0
    """Carried at the torso's center of mass, beside its own [kg]."""
    mjcf: Path | None = None
    """Somebody else's MJCF of the G1: its masses, inertias, joint limits and collisions instead of ours."""


def build_spec(options: ModelOptions = ModelOptions()) -> mujoco.MjSpec:
    """The robot as an editable MuJoCo specification; ``.compile()`` gives nq 36, nv 35, nu 29.

    Raises:
        PilotError: if the URDF is not installed, or ``options.mjcf`` is no G1 with 29 joints.
    """
    spec = _own_robot(options.visuals) if options.mjcf is None else _foreign_robot(options.mjcf)
    _set_physics(spec, options)
    if options.floor:
        floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
        floor.contype, floor.conaffinity = 0, WORLD_COLLISION
        floor.friction = [options.friction, 0.005, 0.0001]
        floor.rgba = [0.55, 0.6, 0.65, 1.0]
    _add_actuators(spec, options)
    _add_frames(spec)
    _add_palms(spec, options)
    _add_limbs(spec)
    if options.mjcf is None:
        _add_feet(spec, options)
        _add_self_collision(spec)
    _add_body_points(spec)
    _add_sensors(spec)
    if options.torso_mass > 0.0:
        torso = spec.body(TORSO_BODY)
        load = torso.add_body(name="torso_load", pos=torso.ipos)
        ball = load.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_TORSO_LOAD_RADIUS, 0, 0])
        ball.mass, ball.contype, ball.conaffinity, ball.group = options.torso_mass, 0, 0, 3
    return spec


def _own_robot(visuals: bool) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(_urdf_with_floating_base(visuals))
    for geom in spec.geoms:  # what the URDF brings is visual only
        geom.contype, geom.conaffinity, geom.group = 0, 0, 2
    return spec


def _foreign_robot(path: Path) -> mujoco.MjSpec:
    """The robot of an MJCF file without its actuators, sensors, sites and keyframes, and without its ground.

    Raises:
        PilotError: if it cannot be read, or lacks a body or a joint of the G1, or has others.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise PilotError(f"cannot read the robot in {path}: {str(error).splitlines()[0]}") from error
    joints = [joint.name for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    if joints != list(JOINT_NAMES):
        missing, strange = sorted(set(JOINT_NAMES) - set(joints)), sorted(set(joints) - set(JOINT_NAMES))
        what = f"lacks {missing[0]}" if missing else f"has {strange[0]}" if strange else "has them in another order"
        raise PilotError(f"{path} is no G1 with the 29 joints that policies drive here: it {what}")
    bodies = {body.name for body in spec.bodies}
    for name in (PELVIS_BODY, TORSO_BODY, *FOOT_BODIES, *HAND_BODIES, *(point.body for point in BODY_POINTS)):
        if name not in bodies:
            raise PilotError(f"{path} has no body {name}: bodies must be called as in Unitree's models")
    for element in (*spec.actuators, *spec.sensors, *spec.keys, *spec.sites):
        spec.delete(element)
    for geom in list(spec.geoms):
        if geom.parent.name == "world":
            spec.delete(geom)
        elif geom.contype or geom.conaffinity:
            # It touches the ground and what stands on it, and itself as its file says.
            geom.contype |= WORLD_COLLISION
            if geom.parent.name in FOOT_BODIES:
                geom.priority = 1
    return spec


def describe_foreign(path: Path) -> str:
    """What of the robot in an MJCF file is its own, and what is ours all the same, in one sentence."""
    spec = _foreign_robot(path)
    bare = [joint.name for joint in spec.joints if joint.name in JOINT_NAMES and not joint.armature]
    rotors = f"our rotor inertias for the {len(bare)} joints that have none" if bare else "its rotor inertias"
    return (
        f"the robot of {path}: its masses, joint limits and collisions, {rotors}; our gains, torque limits, palms, and "
        "places of soles and body points"
    )


def _urdf_with_floating_base(visuals: bool) -> str:
    """The URDF text with a floating base, without collision meshes, ready for MuJoCo's importer."""
    path = urdf_path()
    robot = ElementTree.parse(path).getroot()
    for link in robot.iter("link"):
        for child in [*link.findall("collision"), *([] if visuals else link.findall("visual"))]:
            link.remove(child)
    meshes = str(path.parent.parent / "meshes")
    extension = ElementTree.SubElement(robot, "mujoco")
    ElementTree.SubElement(
        extension, "compiler", meshdir=meshes, discardvisual="false", fusestatic="true", strippath="true"
    )
    ElementTree.SubElement(robot, "link", name="world")
    joint = ElementTree.SubElement(robot, "joint", name="floating_base", type="floating")
    ElementTree.SubElement(joint, "parent", link="world")
    ElementTree.SubElement(joint, "child", link=PELVIS_BODY)
    return ElementTree.tostring(robot, encoding="unicode")


def _set_physics(spec: mujoco.MjSpec, options: ModelOptions) -> None:
    spec.option.timestep = options.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # MuJoCo 4.0.0 factors sparse Jacobians wrongly (mujoco#3767), and dense is faster at this size anyway.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.iterations = options.solver_iterations
    spec.option.ls_iterations = options.line_search_iterations
    # Whoever steps the robot ends the episode of one that diverged; MuJoCo would put it back upright, unseen.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if options.elliptic_friction:
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = options.impratio
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960


def _add_actuators(spec: mujoco.MjSpec, options: ModelOptions) -> None:
    gains = options.gains
    for index, name in enumerate(JOINT_NAMES):
        joint = spec.joint(name)
        joint.armature = options.armature_scale * (joint.armature or ARMATURE[index])
        effort = float(EFFORT[index])
        # The limit belongs to the actuator: MuJoCo 4 no longer damps saturated joint limits implicitly.
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        stiffness, damping = float(gains.stiffness[index]), float(gains.damping[index])
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=stiffness, kv=damping)
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = [-effort, effort]


def _add_frames(spec: mujoco.MjSpec) -> None:
    """Sites at the centers of soles and palms."""
    for side, foot, hand in zip(SIDES, FOOT_BODIES, HAND_BODIES, strict=True):
        spec.body(foot).add_site(name=f"{side}_foot", pos=[SOLE_CENTER, 0.0, SOLE_OFFSET])
        inwards = -1.0 if side == "left" else 1.0
        palm = [PALM_OFFSET[0], inwards * PALM_HALF_THICKNESS, PALM_OFFSET[2]]
        spec.body(hand).add_site(name=f"{side}_palm", pos=palm)


def _add_feet(spec: mujoco.MjSpec, options: ModelOptions) -> None:
    for body_name, side in zip(FOOT_BODIES, SIDES, strict=True):
        body = spec.body(body_name)
        for number, (x, y) in enumerate(_FOOT_SPHERES):
            sphere = body.add_geom(name=f"{side}_foot_{number}", type=mujoco.mjtGeom.mjGEOM_SPHERE)
            sphere.size = [_FOOT_SPHERE_RADIUS, 0, 0]
            sphere.pos = [x, y, _FOOT_SPHERE_HEIGHT]
            sphere.mass = 0.0
            sphere.contype, sphere.conaffinity = WORLD_COLLISION, 0
            sphere.condim = 3
            # A foot's friction is its own, not the larger of foot and ground, so that it can be randomized.
            sphere.priority = 1
            sphere.friction = [options.friction, 0.005, 0.0001]
            sphere.group = 3


def _add_palms(spec: mujoco.MjSpec, options: ModelOptions) -> None:
    """Palm plate and wrist block, in the wrist-yaw frame (shape as in OmniContact's G1 model).

    The URDF's rubber hands are visual only, so without these the palms would pass through a box.
    """
    for side, body_name in zip(SIDES, HAND_BODIES, strict=True):
        body = spec.body(body_name)
        parts = (
            ("palm", [PALM_OFFSET[0], 0.0, 0.0], [0.05, PALM_HALF_THICKNESS, 0.045]),
            ("wrist", [0.02, 0.0, 0.0], [0.03, PALM_HALF_THICKNESS, 0.025]),
        )
        for part, position, half_size in parts:
            box = body.add_geom(name=f"{side}_{part}", type=mujoco.mjtGeom.mjGEOM_BOX)
            box.pos, box.size = position, half_size
            box.mass = 0.0
            box.contype, box.conaffinity = PALM_COLLISION, 0
            box.condim = 4
            box.friction = [options.friction, 0.02, 0.0001]
            # Palm friction is what the scene says, not the larger of palm and object (MuJoCo's default rule).
            box.priority = 1
            box.group = 3


def _add_limbs(spec: mujoco.MjSpec) -> None:
    """Capsules for thighs, shins and forearms, for explicit pairs; contype 0 keeps them out of everything else."""
    for side in SIDES:
        for body_name, start, end, radius in (
            (f"{side}_hip_yaw_link", (0.0, 0.0, -0.02), (-0.07, 0.0, -0.16), 0.055),
            (f"{side}_knee_link", (0.0, 0.0, -0.04), (0.0, 0.0, -0.27), 0.04),
            (f"{side}_elbow_link", (0.02, 0.0, -0.01), (0.12, 0.0, -0.01), 0.03),
        ):
            capsule = spec.body(body_name).add_geom(name=f"{body_name}_capsule")
            capsule.type = mujoco.mjtGeom.mjGEOM_CAPSULE
            capsule.fromto = [*start, *end]
            capsule.size = [radius, 0, 0]
            capsule.mass, capsule.contype, capsule.conaffinity, capsule.group = 0.0, 0, 0, 3


def _add_self_collision(spec: mujoco.MjSpec) -> None:
    """Plates for the feet, and explicit pairs."""
    for name in FOOT_BODIES:
        plate = spec.body(name).add_geom(name=f"{name}_plate", type=mujoco.mjtGeom.mjGEOM_BOX)
        plate.pos, plate.size = [SOLE_CENTER, 0.0, -0.02], [0.085, 0.03, 0.012]
        plate.mass, plate.contype, plate.conaffinity, plate.group = 0.0, 0, 0, 3
    for side in SIDES:
        for arm_part in (f"{side}_palm", f"{side}_elbow_link_capsule"):
            _add_pair(spec, arm_part, f"{side}_hip_yaw_link_capsule")
        _add_pair(spec, f"{side}_palm", f"{side}_knee_link_capsule")
    _add_pair(spec, *(f"{name}_plate" for name in FOOT_BODIES))
    _add_pair(spec, *(f"{side}_knee_link_capsule" for side in SIDES))


def _add_pair(spec: mujoco.MjSpec, first: str, second: str) -> None:
    spec.add_pair(geomname1=first, geomname2=second, condim=1)


def _add_body_points(spec: mujoco.MjSpec) -> None:
    """A site and a position sensor for each of :data:`BODY_POINTS`."""
    for point in BODY_POINTS:
        name = f"{point.name}_point"
        spec.body(point.body).add_site(name=name, pos=list(point.center))
        position = mujoco.mjtSensor.mjSENS_FRAMEPOS
        spec.add_sensor(name=f"{name}_position", type=position, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=name)


def _add_sensors(spec: mujoco.MjSpec) -> None:
    """Sensors of feet, palms, torso and center of mass, and of the net contact force on each foot (world frame)."""
    for side, body_name in zip(SIDES, FOOT_BODIES, strict=True):
        for frame in (f"{side}_foot", f"{side}_palm"):
            _add_frame_sensors(spec, frame, mujoco.mjtObj.mjOBJ_SITE)
        sensor = spec.add_sensor(name=f"{side}_foot_force", type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_BODY, body_name
        # fields: force only; reduction: net force, expressed in the world frame
        sensor.intprm = [1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1]
    _add_frame_sensors(spec, TORSO_BODY, mujoco.mjtObj.mjOBJ_XBODY)
    for suffix, kind in (
        ("position", mujoco.mjtSensor.mjSENS_SUBTREECOM),
        ("linear_velocity", mujoco.mjtSensor.mjSENS_SUBTREELINVEL),
    ):
        name = f"center_of_mass_{suffix}"
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_BODY, objname=PELVIS_BODY)


def _add_frame_sensors(spec: mujoco.MjSpec, frame: str, kind: mujoco.mjtObj) -> None:
    for suffix, sensor_type in (
        ("position", mujoco.mjtSensor.mjSENS_FRAMEPOS),
        ("quaternion", mujoco.mjtSensor.mjSENS_FRAMEQUAT),
        ("velocity", mujoco.mjtSensor.mjSENS_FRAMELINVEL),
    ):
        spec.add_sensor(name=f"{frame}_{suffix}", type=sensor_type, objtype=kind, objname=frame)


def effort_limits(model: mujoco.MjModel) -> np.ndarray:
    """Torque limit of each actuator (29,) [N m]."""
    return model.actuator_forcerange[:, 1].copy()


def joint_limits(model: mujoco.MjModel) -> np.ndarray:
    """Position limits of the joints (29, 2) [rad], in Unitree's order."""
    return np.array([model.joint(name).range for name in JOINT_NAMES])
