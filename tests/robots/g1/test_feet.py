"""Feet on the ground: contact must come to rest, also on slippery ground and with the long steps of training."""

import mujoco
import numpy as np
import pytest
import torch

from lowlevel.world.terrain import Terrain, TerrainConfig
from robots.g1.constants import GAINS, LOWER_JOINTS, SIDES
from robots.g1.model import ModelOptions, build_spec
from robots.g1.nominal_pose import NominalPose


@pytest.mark.parametrize("friction", [0.5, 1.0])
def test_a_standing_robot_keeps_its_feet_on_the_ground(friction: float) -> None:
    model = build_spec(ModelOptions(timestep=0.02 / 3, friction=friction)).compile()
    data = mujoco.MjData(model)
    height = 0.6
    stance = NominalPose.load().lookup(torch.tensor([[height, 0.0, 0.0, 0.0]]))
    position, torque = stance.position[0].numpy(), stance.torque[0].numpy()
    data.qpos[2] = height
    data.qpos[7:][LOWER_JOINTS] = position
    data.ctrl[:] = data.qpos[7:]
    data.ctrl[LOWER_JOINTS] += torque / GAINS["stiff"].stiffness[LOWER_JOINTS]
    # The pelvis is upright in this posture, so that the soles are level.
    lifted, fastest = 0, 0.0
    for step in range(75):
        mujoco.mj_step(model, data)
        if step < 15:
            continue
        for side in SIDES:
            lifted += int(np.linalg.norm(data.sensor(f"{side}_foot_force").data) < 5.0)
            fastest = max(fastest, float(np.linalg.norm(data.sensor(f"{side}_foot_velocity").data[:2])))
    assert lifted == 0
    assert fastest < 0.1


@pytest.mark.parametrize("toe", [-0.004, -0.001, 0.002])
def test_feet_do_not_trip_over_the_borders_of_a_level_floor(toe: float) -> None:
    """Landing while sliding forwards on slabs of one height is landing on a plane."""

    def land(slabs: bool) -> np.ndarray:
        spec = build_spec(ModelOptions(timestep=0.02 / 3))
        level = 0.0
        if slabs:
            terrain = Terrain(TerrainConfig(tiles=("slabs",), levels=(0.0,)))
            terrain.add_to(spec)
            level = terrain.blocks[0].top
        model = spec.compile()
        data = mujoco.MjData(model)
        position = NominalPose.load().lookup(torch.tensor([[0.7, 0.0, 0.0, 0.0]])).position[0].numpy()
        data.qpos[7:][LOWER_JOINTS] = position
        data.ctrl[:] = data.qpos[7:]
        mujoco.mj_forward(model, data)
        # The toes come down beside a border, which lie every 0.4 m, at 1 m/s.
        data.qpos[0] += toe - (data.site("left_foot").xpos[0] + 0.085)
        data.qpos[2] += level + 0.002 - data.site("left_foot").xpos[2]
        data.qvel[:3] = 0.5, 0.0, -1.0
        mujoco.mj_step(model, data, 12)
        return data.qpos[:7] - np.array([0.0, 0.0, level, 0.0, 0.0, 0.0, 0.0])

    np.testing.assert_allclose(land(slabs=True), land(slabs=False), atol=2e-3)


@pytest.mark.parametrize("tile", ["slabs", "rough"])
def test_ground_pushes_a_foot_up_that_has_sunk_into_it(tile: str) -> None:
    """Out of thin blocks a foot was pushed downwards, and stayed caught in them."""
    spec = build_spec(ModelOptions())
    terrain = Terrain(TerrainConfig(tiles=(tile,), levels=(0.0,)))
    terrain.add_to(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    data.qpos[2] += terrain.blocks[0].top - 0.022 - data.site("left_foot").xpos[2]
    mujoco.mj_forward(model, data)
    directions = [
        contact.frame[2] if "foot" in model.geom(contact.geom2).name else -contact.frame[2]
        for contact in data.contact
        if "foot" in model.geom(contact.geom1).name + model.geom(contact.geom2).name
    ]
    assert len(directions) >= 16 and min(directions) > 0.99
