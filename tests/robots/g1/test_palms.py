"""Palms carry a box by friction alone: held at the nominal friction, dropped without any."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, HAND_BODIES, JOINT_NAMES
from robots.g1.mirror import ARMS_MIRROR
from robots.g1.model import PALM_COLLISION, WORLD_COLLISION, ModelOptions, build_spec

# Left arm with the palm vertical before the chest, from inverse kinematics; the right arm mirrors it.
_LEFT_ARM = np.array([-0.16, 0.11, -0.01, 0.22, -0.13, 0.47, 0.03])
_SQUEEZE = 0.15


def _squeeze_box(friction: float, mass: float = 1.0, seconds: float = 2.5) -> tuple[np.ndarray, np.ndarray]:
    """Squeeze a box with a fixed pelvis; heights of the box and of the palms' middle over time (T,) [m]."""
    options = ModelOptions(elliptic_friction=True, solver_iterations=12, friction=friction)
    spec = build_spec(options)
    spec.delete(spec.joint("floating_base"))
    spec.body("pelvis").pos = [0.0, 0.0, 1.0]
    box_body = spec.worldbody.add_body(name="box", pos=[0.0, 0.0, 0.2])
    box_body.add_freejoint(name="box")
    box = box_body.add_geom(name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.15, 0.15, 0.15], mass=mass)
    box.contype, box.conaffinity, box.condim = WORLD_COLLISION, WORLD_COLLISION | PALM_COLLISION, 4
    model = spec.compile()
    data = mujoco.MjData(model)

    arms = DEFAULT_POSITION.copy()
    both = np.concatenate([_LEFT_ARM, np.zeros(7)])
    arms[ARM_JOINTS] = both + ARMS_MIRROR(both)
    addresses = [int(model.joint(name).qposadr[0]) for name in JOINT_NAMES]
    data.qpos[addresses] = arms
    mujoco.mj_forward(model, data)
    palms = np.array([data.site(f"{side}_palm").xpos for side in ("left", "right")])
    width = palms[0, 1] - palms[1, 1]
    model.geom("box").size[1] = 0.5 * width
    start = int(model.joint("box").qposadr[0])
    data.qpos[start : start + 3] = palms.mean(axis=0)
    targets = arms.copy()
    targets[JOINT_NAMES.index("left_shoulder_roll_joint")] -= _SQUEEZE
    targets[JOINT_NAMES.index("right_shoulder_roll_joint")] += _SQUEEZE
    data.ctrl[:] = targets
    box_height, palm_height = [], []
    for _ in range(round(seconds / options.timestep)):
        mujoco.mj_step(model, data)
        box_height.append(data.body("box").xpos[2])
        palm_height.append(np.mean([data.site(f"{side}_palm").xpos[2] for side in ("left", "right")]))
    return np.array(box_height), np.array(palm_height)


def test_palms_hold_a_box_for_two_seconds_with_less_than_five_millimeters_of_slip() -> None:
    box, palms = _squeeze_box(friction=0.8)
    relative = (box - palms)[250:]
    assert np.abs(relative - relative[0]).max() < 0.005


def test_palms_without_friction_drop_the_box() -> None:
    box, palms = _squeeze_box(friction=0.0)
    assert (palms - box)[-1] > 0.3


@pytest.mark.parametrize("hand", HAND_BODIES)
def test_hands_collide_with_objects_and_not_with_the_ground(hand: str) -> None:
    model = build_spec().compile()
    geoms = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name == hand]
    solid = [g for g in geoms if model.geom_contype[g]]
    assert len(solid) == 2
    assert all(model.geom_contype[g] == PALM_COLLISION and model.geom_condim[g] >= 4 for g in solid)
    assert all(not model.geom_contype[g] & model.geom("floor").conaffinity[0] for g in solid)
