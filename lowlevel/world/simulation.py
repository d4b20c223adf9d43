"""N robots in ``mujoco.batch.Batch``: targets in, tensors of shape (N, ...) out.

Above this module only randomization (through :meth:`BatchSimulation.per_robot`) and scenes (which are ``MjSpec``) know
MuJoCo's data structures.
Positions and velocities of base and joints are exact; torques and what is read from sensors (torso, feet, palms,
forces) are one physics substep old, as after any ``mj_step``.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from robots.errors import PilotError
from robots.g1.constants import BODY_POINTS, HAND_BODIES, JOINT_NAMES, PELVIS_BODY, SIDES, TORSO_BODY
from robots.g1.model import joint_limits


@dataclass(frozen=True)
class RobotState:
    """One instant of N robots, float32; world frame unless the name says otherwise."""

    joint_position: Tensor
    """(N, 29) [rad]"""
    joint_velocity: Tensor
    """(N, 29) [rad/s]"""
    joint_torque: Tensor
    """(N, 29) [N m], as applied by the actuators."""
    base_position: Tensor
    """Pelvis (N, 3) [m]."""
    base_quaternion: Tensor
    """Pelvis (N, 4) wxyz."""
    base_linear_velocity: Tensor
    """Pelvis (N, 3) [m/s]."""
    base_angular_velocity: Tensor
    """Pelvis (N, 3) [rad/s], in the pelvis frame."""
    center_of_mass: Tensor
    """Of the whole robot (N, 3) [m]."""
    center_of_mass_velocity: Tensor
    """(N, 3) [m/s]"""
    torso_quaternion: Tensor
    """(N, 4) wxyz."""
    foot_position: Tensor
    """Center of each sole (N, 2, 3) [m], left then right."""
    foot_velocity: Tensor
    """(N, 2, 3) [m/s]."""
    foot_force: Tensor
    """Net contact force on each foot (N, 2, 3) [N]."""
    palm_position: Tensor
    """(N, 2, 3) [m]."""
    body_points: Tensor
    """Centers of :data:`robots.g1.constants.BODY_POINTS` (N, 7, 3) [m]."""
    palm_quaternion: Tensor
    """(N, 2, 4) wxyz."""


class BatchSimulation:
    """Steps N copies of a compiled scene that contains the robot.

    Args:
        model: scene with the robot of :func:`robots.g1.model.build_spec`, possibly with objects attached.
        num_robots: number of simulations.
        decimation: physics steps per control step.
        num_threads: physics threads.
        device: where the tensors handed out live.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_robots: int,
        decimation: int,
        num_threads: int = 2,
        device: torch.device | str = "cpu",
    ) -> None:
        self.model = model
        self.num_robots = num_robots
        self.decimation = decimation
        self.device = torch.device(device)
        self.control_period = decimation * float(model.opt.timestep)
        limits = torch.tensor(joint_limits(model), dtype=torch.float32, device=device)
        self.joint_lower, self.joint_upper = limits[:, 0], limits[:, 1]

        self._batch = Batch(model, num_robots, num_threads)
        self._sensordata = self._batch.bind("sensordata")
        self._torque = self._batch.bind("actuator_force")
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl, self._external_force = self._batch.bind("ctrl"), self._batch.bind("xfrc_applied")
        self._joint_qpos = _contiguous([model.joint(name).qposadr[0] for name in JOINT_NAMES])
        self._joint_qvel = _contiguous([model.joint(name).dofadr[0] for name in JOINT_NAMES])
        self._actuators = _contiguous([model.actuator(name).id for name in JOINT_NAMES])
        self._base_qpos, self._base_qvel = self._free_joint_slices(PELVIS_BODY)
        self._sensor_columns = {
            model.sensor(i).name: slice(int(model.sensor_adr[i]), int(model.sensor_adr[i]) + int(model.sensor_dim[i]))
            for i in range(model.nsensor)
        }
        self._per_robot_fields: dict[str, np.ndarray] = {}
        self.step_seconds = 0.0
        """Time that MuJoCo has taken for steps [s]."""
        self.reset_seconds = 0.0
        """Time that MuJoCo has taken for the constants and derived quantities of robots that were reset [s]."""
        self._diverged = np.zeros(num_robots, dtype=bool)

    def _free_joint_slices(self, body: str) -> tuple[slice, slice]:
        joint = self.model.body(body).jntadr[0]
        if joint < 0 or self.model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"body {body!r} has no free joint")
        qpos, qvel = int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
        return slice(qpos, qpos + 7), slice(qvel, qvel + 6)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.array(array, dtype=np.float32)).to(self.device)

    def sensor(self, name: str) -> Tensor:
        """Current value of a named sensor (N, dim)."""
        return self._tensor(self._sensordata[:, self._sensor_columns[name]])

    def read(self, ids: Tensor | None = None) -> RobotState:
        """Snapshot of the robots ``ids`` (n,), all by default."""
        rows = slice(None) if ids is None else ids.cpu().numpy()
        qpos, qvel, torque, sensors = (a[rows] for a in (self._qpos, self._qvel, self._torque, self._sensordata))
        base_qpos, base_qvel = qpos[:, self._base_qpos], qvel[:, self._base_qvel]

        def sensor(name: str) -> Tensor:
            return self._tensor(sensors[:, self._sensor_columns[name]])

        def pair(frame: str, quantity: str) -> Tensor:
            return torch.stack([sensor(f"{side}_{frame}_{quantity}") for side in SIDES], dim=1)

        return RobotState(
            joint_position=self._tensor(qpos[:, self._joint_qpos]),
            joint_velocity=self._tensor(qvel[:, self._joint_qvel]),
            joint_torque=self._tensor(torque[:, self._actuators]),
            base_position=self._tensor(base_qpos[:, :3]),
            base_quaternion=self._tensor(base_qpos[:, 3:]),
            base_linear_velocity=self._tensor(base_qvel[:, :3]),
            base_angular_velocity=self._tensor(base_qvel[:, 3:]),
            center_of_mass=sensor("center_of_mass_position"),
            center_of_mass_velocity=sensor("center_of_mass_linear_velocity"),
            torso_quaternion=sensor(f"{TORSO_BODY}_quaternion"),
            foot_position=pair("foot", "position"),
            foot_velocity=pair("foot", "velocity"),
            # The sensor reports the force that the foot exerts on the ground.
            foot_force=-pair("foot", "force"),
            palm_position=pair("palm", "position"),
            body_points=torch.stack([sensor(f"{point.name}_point_position") for point in BODY_POINTS], dim=1),
            palm_quaternion=pair("palm", "quaternion"),
        )

    def step(self, targets: Tensor) -> None:
        """Advance one control step with PD targets (N, 29) [rad].

        Robots whose state is not finite afterwards return to the model's initial state; see :meth:`diverged`.
        """
        self._ctrl[:, self._actuators] = targets.detach().cpu().numpy()
        began = time.perf_counter()
        self._batch.step(nstep=self.decimation)
        self.step_seconds += time.perf_counter() - began
        self._find_diverged()

    def step_with_work(self, targets: Tensor, ids: Tensor) -> Tensor:
        """As :meth:`step` for robots ``ids`` (n,), and the work of all motors (N,) [J], both signs counted positive.

        It is added up over the physics steps: what a joint trembles between two control steps counts, too.
        """
        self._ctrl[:, self._actuators] = targets.detach().cpu().numpy()
        rows = ids.cpu().numpy()
        work = np.zeros(self.num_robots)
        for _ in range(self.decimation):
            before = self._qpos[rows, self._joint_qpos]
            self._batch.step(rows)
            # The torque of a physics step is constant over it.
            moved = self._qpos[rows, self._joint_qpos] - before
            work[rows] += np.abs(self._torque[rows, self._actuators] * moved).sum(axis=1)
        self._find_diverged()
        return torch.from_numpy(work)

    def _find_diverged(self) -> None:
        # A sum is finite only if all of its terms are.
        self._diverged = ~np.isfinite(self._batch.state.sum(axis=1))
        if self._diverged.any():
            # One number that is not finite would spoil the rewards and losses of all robots.
            self._batch.reset(np.flatnonzero(self._diverged))

    def forward(self, ids: Tensor | None = None) -> None:
        """Recompute the derived quantities of ``ids`` (all by default) without advancing time."""
        began = time.perf_counter()
        self._batch.forward(None if ids is None else ids.cpu().numpy())
        self.reset_seconds += time.perf_counter() - began

    def restart(self, ids: Tensor) -> None:
        """Put everything in the scenes of ``ids`` (n,) into the model's initial state; :meth:`place` robots next."""
        self._batch.reset(ids.cpu().numpy(), stage=int(mujoco.mjtStage.mjSTAGE_NONE))

    def place(
        self,
        ids: Tensor,
        base_position: Tensor,
        base_quaternion: Tensor,
        joint_position: Tensor,
        base_velocity: Tensor | None = None,
    ) -> None:
        """Put robots ``ids`` (n,) into a state, at rest unless ``base_velocity`` (n, 6) is given.

        Call :meth:`forward` when all writes are done.
        """
        rows = ids.cpu().numpy()
        self._qpos[rows, self._base_qpos] = torch.cat([base_position, base_quaternion], -1).cpu().numpy()
        self._qpos[rows, self._joint_qpos] = joint_position.cpu().numpy()
        self._ctrl[rows, self._actuators] = joint_position.cpu().numpy()
        if base_velocity is not None:
            self._qvel[rows, self._base_qvel] = base_velocity.cpu().numpy()

    def push(self, velocity_change: Tensor) -> None:
        """Add ``velocity_change`` (N, 3) [m/s] to the base's linear velocity."""
        self._qvel[:, self._base_qvel][:, :3] += velocity_change.cpu().numpy()

    def set_hand_force(self, force: Tensor) -> None:
        """Apply external forces (N, 2, 3) [N], world frame, at the hands' centers of mass until set again."""
        for hand, name in enumerate(HAND_BODIES):
            self._external_force[:, self.model.body(name).id, :3] = force[:, hand].cpu().numpy()

    def object_pose(self, body: str) -> Tensor:
        """Position and quaternion (N, 7) of a free body."""
        return self._tensor(self._qpos[:, self._free_joint_slices(body)[0]])

    def set_object_pose(self, ids: Tensor, body: str, pose: Tensor) -> None:
        """Place a free body at ``pose`` (n, 7), at rest."""
        qpos, qvel = self._free_joint_slices(body)
        rows = ids.cpu().numpy()
        self._qpos[rows, qpos] = pose.cpu().numpy()
        self._qvel[rows, qvel] = 0.0

    def per_robot(self, field: str) -> np.ndarray:
        """A model field with one row per robot, to be written in place for domain randomization."""
        if field not in self._per_robot_fields:
            self._per_robot_fields[field] = self._batch.expand(field)
        return self._per_robot_fields[field]

    def update_constants(self, ids: Tensor) -> None:
        """Recompute what MuJoCo derives from masses and sizes, after :meth:`per_robot` writes."""
        began = time.perf_counter()
        self._batch.set_const(ids.cpu().numpy())
        self.reset_seconds += time.perf_counter() - began

    def diverged(self) -> Tensor:
        """Robots whose state was not finite after the last :meth:`step` (N,)."""
        return torch.from_numpy(self._diverged).to(self.device)

    def robot_model(self, robot: int) -> mujoco.MjModel:
        """A copy of one robot's model, with its own field values, for rendering."""
        return self._batch.get_model(robot)

    def robot_data(self, robot: int) -> mujoco.MjData:
        """A copy of one robot's simulation state, for rendering."""
        return self._batch.get_data(robot)

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that determines the future of the simulation."""
        fields = {f"field.{name}": torch.from_numpy(array.copy()) for name, array in self._per_robot_fields.items()}
        return {"state": torch.from_numpy(self._batch.state.copy()), **fields}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore :meth:`state_dict`.

        Raises:
            PilotError: if it was saved with another model or number of robots.
        """
        if state["state"].shape != self._batch.state.shape:
            raise PilotError(
                f"the saved simulation has shape {tuple(state['state'].shape)}, this one "
                f"{self._batch.state.shape}: resume with the number of robots and the terrain of the saved run"
            )
        for name in [key.removeprefix("field.") for key in state if key.startswith("field.")]:
            self.per_robot(name)[...] = state[f"field.{name}"].numpy()
        self._batch.state[...] = state["state"].numpy()
        self._batch.set_const()
        self._batch.state[...] = state["state"].numpy()
        self._batch.forward()
        self._batch.state[...] = state["state"].numpy()


def _contiguous(indices: Sequence[int]) -> slice:
    """The slice that covers ``indices``, which the model must lay out in order without gaps."""
    start = int(indices[0])
    if [int(index) for index in indices] != list(range(start, start + len(indices))):
        raise ValueError("the scene's joints are not in Unitree's order: attach the robot unchanged")
    return slice(start, start + len(indices))
