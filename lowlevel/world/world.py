"""The World: N robots on ground. Whoever steps robots holds one: training, the planner's environment, evaluation."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import torch
from torch import Tensor

from lowlevel.commands import ARMS, HEIGHT, POSTURE, TORSO
from lowlevel.control.observation import CONTROL_PERIOD
from lowlevel.world.measures import Measurement, has_fallen, measure
from lowlevel.world.simulation import BatchSimulation
from lowlevel.world.terrain import STANCE_REACH, Terrain, TerrainConfig
from robots.errors import PilotError
from robots.g1.constants import WAIST_JOINTS
from robots.g1.model import ModelOptions, build_spec
from robots.g1.nominal_pose import NominalPose
from robots.g1.waist import pelvis_attitude
from robots.rotations import about_axis, multiply

CLEARANCE = 0.005
"""Height of the soles above the ground when a robot is stood up [m]."""


class World:
    """Stands robots up, advances them by one control period at a time, and measures them.

    Args:
        options: the robot's gains, and how finely it is simulated.
        terrain: the ground.
        num_robots: robots side by side (N).
        num_threads: physics threads.
        device: where tensors live.
        add_objects: adds what else is in the scene.

    Raises:
        PilotError: if the physics step does not divide the control period, or a number is not positive.
    """

    def __init__(
        self,
        options: ModelOptions,
        terrain: TerrainConfig,
        num_robots: int,
        num_threads: int,
        device: torch.device | str = "cpu",
        add_objects: Callable[[mujoco.MjSpec], None] | None = None,
    ) -> None:
        for name, number in (("num_robots", num_robots), ("num_threads", num_threads)):
            if number < 1:
                raise PilotError(f"{name} must be at least 1, not {number}")
        decimation = round(CONTROL_PERIOD / options.timestep)
        if abs(decimation * options.timestep - CONTROL_PERIOD) > 1e-9:
            raise PilotError(
                f"the physics step {options.timestep} s does not divide the control period {CONTROL_PERIOD} s"
            )
        self.terrain = Terrain(terrain, device)
        self.pose = NominalPose.load(device)
        spec = build_spec(options)
        self.terrain.add_to(spec)
        if add_objects is not None:
            add_objects(spec)
        self.simulation = BatchSimulation(spec.compile(), num_robots, decimation, num_threads, device)

    @property
    def num_robots(self) -> int:
        return self.simulation.num_robots

    def stand(
        self,
        ids: Tensor,
        xy: Tensor,
        heading: Tensor,
        command: Tensor,
        joint_spread: Tensor | None = None,
        velocity: Tensor | None = None,
    ) -> Tensor:
        """Put robots ``ids`` (n,) on their feet, in the posture and with the arms of ``command`` (n, 21).

        Everything else about them, and whatever else is in their scene, stays as it is.

        Args:
            ids: which robots.
            xy: on the ground (n, 2) [m].
            heading: yaw of the pelvis (n,) [rad].
            command: its height is above the highest ground under the feet.
            joint_spread: added to the joints (n, 29) [rad].
            velocity: of the pelvis (n, 6) [m/s, rad/s]; at rest by default.

        Returns:
            the joints of the posture (n, 29) [rad], without what is added to them.
        """
        joints = torch.cat([self.pose.lookup(command[:, POSTURE]).position, command[:, ARMS]], dim=1)
        height = self.terrain.highest(xy, STANCE_REACH) + command[:, HEIGHT] + CLEARANCE
        attitude = multiply(about_axis(2, heading), pelvis_attitude(command[:, TORSO], joints[:, WAIST_JOINTS]))
        spread = joints if joint_spread is None else joints + joint_spread
        self.simulation.place(ids, torch.cat([xy, height[:, None]], dim=1), attitude, spread, velocity)
        self.simulation.forward(ids)
        return joints

    def advance(self, targets: Tensor) -> Measurement:
        """One control period with PD ``targets`` (N, 29) [rad]."""
        self.simulation.step(targets)
        return self.measure()

    def measure(self, ids: Tensor | None = None) -> Measurement:
        """What can be measured of robots ``ids`` (n,), all by default."""
        return measure(self.simulation.read(ids), self.terrain)

    def fallen(self, measured: Measurement) -> Tensor:
        """Robots that lie on the ground or whose simulation diverged (N,)."""
        return has_fallen(measured) | self.simulation.diverged()

    def elevation(self, measured: Measurement) -> Tensor:
        """The elevation map (n, 121): vertical distance base - terrain [m], without noise."""
        return self.terrain.elevation_map(measured.robot.base_position, measured.heading)
