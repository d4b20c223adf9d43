"""The lift-box scene: a box, the block it stands on, what of the robot may touch it, and the sensors between.

The box starts at the origin of every simulation and the robots are placed around it, so that the block
beneath needs only a height.
"""

from __future__ import annotations

import mujoco
import numpy as np

from lowlevel.world.simulation import BatchSimulation
from robots.g1.constants import HAND_BODIES, SIDES, TORSO_BODY
from robots.g1.model import PALM_COLLISION, WORLD_COLLISION

BOX = "box"
SUPPORT = "support"
HAND_GEOMS = tuple(f"{side}_{part}" for side in SIDES for part in ("palm", "wrist"))
FORCE_SENSORS = tuple(f"{side}_hand_box_force" for side in SIDES)
"""Net contact force that each hand, palm and wrist together, exerts on the box, world frame."""

NOMINAL_EDGE, NOMINAL_MASS = 0.30, 1.0
_BURIED = 0.05
"""Depth at which an unused block lies under the floor [m]."""
_BLOCKERS = (
    *(f"{side}_{link}_capsule" for side in SIDES for link in ("hip_yaw_link", "knee_link", "elbow_link")),
    "torso_shell",
)


def add_box_scene(spec: mujoco.MjSpec) -> None:
    """Add box, support block, contacts and sensors to the robot's scene."""
    half = 0.5 * NOMINAL_EDGE
    support = spec.worldbody.add_geom(name=SUPPORT, type=mujoco.mjtGeom.mjGEOM_BOX)
    support.pos, support.size = [0.0, 0.0, -1.0], [0.22, 0.22, 1.0 - _BURIED]
    support.contype, support.conaffinity = 0, WORLD_COLLISION | PALM_COLLISION
    support.rgba = [0.45, 0.38, 0.30, 1.0]

    body = spec.worldbody.add_body(name=BOX, pos=[0.0, 0.0, half])
    body.add_freejoint(name=BOX)
    body.simple = False  # its center of mass will not stay at its origin
    box = body.add_geom(name=BOX, type=mujoco.mjtGeom.mjGEOM_BOX, size=[half, half, half], mass=NOMINAL_MASS)
    box.contype, box.conaffinity = WORLD_COLLISION, WORLD_COLLISION | PALM_COLLISION
    box.condim = 4
    # Of floor, block and box alike; hands and feet bring their own, which has priority.
    box.friction = [1.0, 0.005, 0.0001]  # against floor and block; against palms that of the palms counts
    box.rgba = [0.80, 0.55, 0.25, 1.0]

    shell = spec.body(TORSO_BODY).add_geom(name="torso_shell", type=mujoco.mjtGeom.mjGEOM_BOX)
    shell.pos, shell.size = [0.0, 0.0, 0.14], [0.075, 0.11, 0.16]
    shell.mass, shell.contype, shell.conaffinity, shell.group = 0.0, 0, 0, 3
    for part in _BLOCKERS:
        # Without friction: the rest of the body may be in the way of the box, but only the palms carry it.
        spec.add_pair(geomname1=part, geomname2=BOX, condim=1)
    for hand, name in zip(HAND_BODIES, FORCE_SENSORS, strict=True):
        sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_BODY, hand
        sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_GEOM, BOX
        # fields: force only; reduction: net force, expressed in the world frame
        sensor.intprm = [1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1]


class BoxProperties:
    """Writes the properties of each simulation's box, block and palms."""

    def __init__(self, simulation: BatchSimulation) -> None:
        model = simulation.model
        self._simulation = simulation
        self._box_geom, self._box_body = model.geom(BOX).id, model.body(BOX).id
        self._support = model.geom(SUPPORT).id
        self._hands = [model.geom(name).id for name in HAND_GEOMS]

    def write(
        self,
        rows: np.ndarray,
        size: np.ndarray,
        mass: np.ndarray,
        center_of_mass: np.ndarray,
        friction: np.ndarray,
        support_height: np.ndarray,
        hands: bool,
    ) -> None:
        """Set the properties of simulations ``rows`` (n,).

        Args:
            rows: simulations.
            size: edges of the box (n, 3) [m].
            mass: of the box (n,) [kg].
            center_of_mass: of the box in its own frame (n, 3) [m].
            friction: sliding friction of the hands (n,); their torsional friction goes with it.
            support_height: top of the block (n,) [m]; zero buries it.
            hands: whether the hands can touch anything.
        """
        field = self._simulation.per_robot
        half = 0.5 * size
        _set_box(field, rows, self._box_geom, half)
        field("body_mass")[rows, self._box_body] = mass
        squares = np.square(size)
        others = squares.sum(axis=1, keepdims=True) - squares
        field("body_inertia")[rows, self._box_body] = mass[:, None] * others / 12.0
        field("body_ipos")[rows, self._box_body] = center_of_mass
        top = np.where(support_height > 0.0, support_height, -_BURIED)
        block = np.stack([half[:, 0] + 0.03, half[:, 1] + 0.03, 1.0 + top], axis=1)
        _set_box(field, rows, self._support, block)
        cells = np.ix_(rows, self._hands)
        field("geom_friction")[cells] = friction[:, None, None] * np.array([1.0, 0.02, 0.0001])
        field("geom_contype")[cells] = PALM_COLLISION if hands else 0


def _set_box(field: object, rows: np.ndarray, geom: int, half: np.ndarray) -> None:
    """Half sizes of a box geom, together with the bounds that collision detection uses."""
    assert callable(field)
    field("geom_size")[rows, geom] = half
    field("geom_rbound")[rows, geom] = np.linalg.norm(half, axis=1)
    field("geom_aabb")[rows, geom, 3:] = half
