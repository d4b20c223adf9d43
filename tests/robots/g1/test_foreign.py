"""Another MJCF of the G1 keeps its own masses and collisions, and is driven and measured as ours is."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from lowlevel.commands import COMMAND_SIZE, HEIGHT
from lowlevel.world.terrain import TerrainConfig
from lowlevel.world.world import World
from robots.errors import PilotError
from robots.g1.constants import ARMATURE, FOOT_BODIES, JOINT_NAMES, urdf_path
from robots.g1.model import ModelOptions, build_spec, describe_foreign


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ours in a stranger's clothes: no rotor inertias, capsules for feet, a heavier head, motors, a floor, sites."""
    spec = build_spec(ModelOptions())
    for pair in list(spec.pairs):
        spec.delete(pair)
    for geom in list(spec.geoms):
        if geom.parent.name != "world" and geom.type != mujoco.mjtGeom.mjGEOM_MESH:
            spec.delete(geom)
    for body in FOOT_BODIES:
        sole = spec.body(body).add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE)
        sole.fromto, sole.size = [-0.05, 0.0, -0.025, 0.12, 0.0, -0.025], [0.01, 0, 0]
    for joint in spec.joints:
        joint.armature = 0.0
    spec.body("torso_link").mass = spec.body("torso_link").mass + 1.0
    path = tmp_path_factory.mktemp("robot") / "g1.xml"
    path.write_text(spec.to_xml())
    return path


def test_it_keeps_its_masses_and_collisions_and_gets_our_motors(foreign: Path) -> None:
    theirs = mujoco.MjModel.from_xml_path(str(foreign))
    model, ours = build_spec(ModelOptions(mjcf=foreign)).compile(), build_spec().compile()
    assert model.body_subtreemass[0] == pytest.approx(theirs.body_subtreemass[0])
    assert model.body_subtreemass[0] == pytest.approx(ours.body_subtreemass[0] + 1.0)
    assert [model.actuator(i).name for i in range(model.nu)] == list(JOINT_NAMES)
    np.testing.assert_allclose(model.actuator_forcerange, ours.actuator_forcerange)
    np.testing.assert_allclose(model.dof_armature[6:], ARMATURE)
    feet = [
        g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name in FOOT_BODIES and model.geom_contype[g]
    ]
    assert len(feet) == 2 and {int(model.geom_type[g]) for g in feet} == {int(mujoco.mjtGeom.mjGEOM_CAPSULE)}
    assert [model.geom(g).name for g in range(model.ngeom) if model.geom_bodyid[g] == 0] == ["floor"]
    assert "our rotor inertias for the 29 joints that have none" in describe_foreign(foreign)


def test_it_stands_on_its_own_feet(foreign: Path) -> None:
    world = World(ModelOptions(mjcf=foreign), TerrainConfig(), num_robots=1, num_threads=1)
    command = torch.zeros(1, COMMAND_SIZE)
    command[0, HEIGHT] = 0.74
    joints = world.stand(torch.arange(1), torch.zeros(1, 2), torch.zeros(1), command)
    for _ in range(15):
        measured = world.advance(joints)
    weight = float(world.simulation.model.body_subtreemass[0]) * 9.81
    assert float(measured.foot_force[0, :, 2].sum()) == pytest.approx(weight, rel=0.2)
    assert float(measured.base_height[0]) == pytest.approx(0.74, abs=0.03)


def test_a_file_that_is_no_g1_is_refused_in_one_sentence(foreign: Path, tmp_path: Path) -> None:
    with pytest.raises(PilotError, match="cannot read the robot in"):
        build_spec(ModelOptions(mjcf=tmp_path / "nowhere.xml"))
    for old, new, message in (
        ('name="waist_yaw_joint"', 'name="waist"', "it lacks waist_yaw_joint"),
        ('name="torso_link"', 'name="chest"', "has no body torso_link"),
    ):
        other = tmp_path / "other.xml"
        spec = mujoco.MjSpec.from_file(str(foreign))
        for element in (*spec.actuators, *spec.sensors):
            spec.delete(element)
        text = spec.to_xml()
        assert old in text
        other.write_text(text.replace(old, new))
        with pytest.raises(PilotError, match=message):
            build_spec(ModelOptions(mjcf=other))
    assert urdf_path().is_file()
