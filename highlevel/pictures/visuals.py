"""A scene to look at: the robot with its meshes, posed like one robot of a batch simulation.

The batch simulation has no meshes, so its states are copied into a second model that has them. Bodies and
joints are the same, because both come from the same specification.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco

from lowlevel.world.simulation import BatchSimulation
from robots.errors import PilotError
from robots.g1.model import ModelOptions, build_spec

VISIBLE_GROUPS = range(3)
"""Geom groups that are shown; collision shapes are in higher ones."""
_FLOOR_COLORS = ([0.62, 0.66, 0.70], [0.72, 0.76, 0.80])
_SKY_COLORS = ([0.85, 0.90, 0.95], [0.55, 0.65, 0.75])


class VisualTwin:
    """The visual double of one robot and its surroundings.

    Args:
        add_to: adds to the specification what the simulated scene holds beside the robot.
    """

    def __init__(self, add_to: Callable[[mujoco.MjSpec], None] = lambda spec: None) -> None:
        spec = build_spec(ModelOptions(visuals=True))
        add_to(spec)
        _decorate(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def adopt_sizes(self, simulation: BatchSimulation, row: int) -> None:
        """Take over the sizes of simulation ``row``'s named geoms, such as a randomized box."""
        source = simulation.robot_model(row)
        for geom in range(source.ngeom):
            name = source.geom(geom).name
            if name:
                self.model.geom(name).size = source.geom_size[geom]

    def follow(self, simulation: BatchSimulation, row: int) -> None:
        """Take the pose that simulation ``row`` has now.

        Raises:
            PilotError: if the simulated scene has other joints.
        """
        position = simulation.robot_data(row).qpos
        if len(position) != self.model.nq:
            raise PilotError(
                f"the simulated scene has {len(position)} coordinates, the visual one {self.model.nq}: "
                "add the same objects to both"
            )
        self.data.qpos[:] = position
        mujoco.mj_kinematics(self.model, self.data)


def _decorate(spec: mujoco.MjSpec) -> None:
    """Light, sky and a chequered floor."""
    spec.visual.headlight.ambient = [0.5, 0.5, 0.5]
    spec.visual.headlight.diffuse = [0.6, 0.6, 0.6]
    spec.visual.headlight.specular = [0.1, 0.1, 0.1]
    light = spec.worldbody.add_light(pos=[0, 0, 6], dir=[0.2, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    light.diffuse = [0.5, 0.5, 0.5]
    light.castshadow = False  # on an infinite floor its shadow map only makes patterns
    gradient, checker = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=gradient,
        rgb1=_SKY_COLORS[0],
        rgb2=_SKY_COLORS[1],
        width=256,
        height=256,
    )
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=checker,
        rgb1=_FLOOR_COLORS[0],
        rgb2=_FLOOR_COLORS[1],
        width=256,
        height=256,
    )
    material = spec.add_material(name="floor", texrepeat=[1, 1], texuniform=True, reflectance=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    floor = spec.geom("floor")
    if floor is not None:
        floor.material = "floor"
        floor.rgba = [1, 1, 1, 1]
