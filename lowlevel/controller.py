"""The frozen controller: whole-body commands in, PD joint targets out, at 50 Hz, for any number of robots.

A controller is a folder. Beside this package nothing else is needed to run it, and nothing in it is pickled; its ONNX
file needs nothing but ONNX Runtime:

``controller.json``      every convention at full precision, and where the controller comes from
``weights.safetensors``  policy weights, normaliser and nominal-pose table
``controller.onnx``      the whole control step as :mod:`lowlevel.onnx_step` describes it, for other runtimes
``golden.json``          reference inputs and outputs that any port can be checked against
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from onnxruntime.capi.onnxruntime_pybind11_state import Fail, InvalidArgument, InvalidGraph, InvalidProtobuf
from torch import Tensor

from lowlevel.commands import CommandSpace
from lowlevel.control_step import ControlStep, Memory
from lowlevel.files import atomic_write
from lowlevel.frozen_folder import FrozenFolder
from lowlevel.golden import GOLDEN_ROBOTS, golden_vectors
from lowlevel.networks import NetworkConfig, ObservationSizes, PilotActor
from lowlevel.nominal import NominalMotion
from lowlevel.nominal_config import NominalConfig
from lowlevel.observation import (
    FRAME,
    FRAME_SIZE,
    HISTORY_LENGTH,
    Proprioception,
    normalised_columns,
)
from lowlevel.onnx_step import OnnxStep, export_step
from lowlevel.terrain import MAP_SIZE
from robots.g1.constants import JOINT_NAMES, NUM_JOINTS, Gains
from robots.g1.nominal_pose import Axis, NominalPose

FORMAT_VERSION = 8
CONFIG_FILE, WEIGHTS_FILE, ONNX_FILE, GOLDEN_FILE = (
    "controller.json",
    "weights.safetensors",
    "controller.onnx",
    "golden.json",
)


class ControllerError(ValueError):
    """A controller folder cannot be used; the message says which file is at fault and why."""


_FOLDER = FrozenFolder(
    kind="controller",
    version=FORMAT_VERSION,
    description_file=CONFIG_FILE,
    weights_file=WEIGHTS_FILE,
    example="checkpoints/lowlevel",
    error=ControllerError,
)


@dataclass(frozen=True)
class ControllerConfig:
    """Contents of ``controller.json`` that define behaviour."""

    joint_names: tuple[str, ...]
    default_position: tuple[float, ...]
    """[rad]"""
    joint_lower: tuple[float, ...]
    """[rad]"""
    joint_upper: tuple[float, ...]
    """[rad]"""
    stiffness: tuple[float, ...]
    """[N m/rad]"""
    damping: tuple[float, ...]
    """[N m s/rad]"""
    action_scale: tuple[float, ...]
    """[rad]"""
    action_limit: float
    """Largest action, in action scales."""
    control_period: float
    """[s]"""
    command_space: CommandSpace
    nominal: NominalConfig
    network: NetworkConfig
    pose_axes: tuple[Axis, Axis, Axis, Axis]
    """Grid of the nominal-pose table: height, roll, pitch, yaw."""


class Controller:
    """A frozen PILOT policy with its history, reference filter and gait clock.

    Call :meth:`reset` once for a number of robots, then :meth:`act` every control period.
    """

    def __init__(
        self,
        config: ControllerConfig,
        actor: PilotActor,
        pose: NominalPose,
        provenance: dict[str, Any],
        device: torch.device | str = "cpu",
        runtime: OnnxStep | None = None,
    ) -> None:
        """``runtime`` computes the control steps in place of torch, with the same weights."""
        self.config = config
        self.provenance = provenance
        self.device = torch.device(device)
        self.actor = actor.to(device).eval().requires_grad_(False)
        self.gains = Gains(np.array(config.stiffness), np.array(config.damping), np.array(config.action_scale))
        self.motion = NominalMotion(config.nominal, self.gains, config.control_period, device, pose)
        self.action_scale = torch.tensor(config.action_scale, device=device)
        self.step = ControlStep(self.actor, self.motion, config.command_space, self.action_scale, config.action_limit)
        self._compute = self.step if runtime is None else runtime
        self._memory: Memory | None = None
        self.gate = torch.zeros(0)
        """Expert activations of the last :meth:`act` (N, experts)."""

    # -- control ----------------------------------------------------------------------------------------------

    def reset(self, num_robots: int, ids: Tensor | None = None) -> None:
        """Forget everything about robots ``ids`` (all ``num_robots`` by default): history, last action, clock."""
        space, settling_time = self.config.command_space, self.config.nominal.settling_time
        fresh = Memory.fresh(num_robots, space, settling_time, self.device)
        if self._memory is None or ids is None or len(self._memory.action) != num_robots:
            self._memory = fresh
            return
        for remembered, cleared in zip(self._memory.tensors, fresh.tensors, strict=True):
            remembered[ids] = cleared[ids]

    @torch.no_grad()
    def act(self, proprioception: Proprioception, elevation_map: Tensor, command: Tensor, flag: Tensor) -> Tensor:
        """PD targets (N, 29) [rad] for the next control period.

        Args:
            proprioception: measurements.
            elevation_map: vertical distance base - terrain (N, 121) [m], egocentric, rows along x.
            command: whole-body command (N, 21); its posture is clamped to the feasible region.
            flag: tracking flag I (N, 1).

        Raises:
            RuntimeError: if :meth:`reset` was not called for this number of robots.
        """
        memory = self._memory
        if memory is None or len(memory.action) != len(command):
            raise RuntimeError(f"call reset({len(command)}) before act() with {len(command)} robots")
        result = self._compute(proprioception, elevation_map, command, flag, memory)
        self.gate, self._memory = result.gate, result.memory
        return result.targets

    def clamp_command(self, command: Tensor) -> Tensor:
        """The command (N, 21) that is observed and scored in place of ``command``."""
        return self.motion.clamp(command)

    @property
    def reference(self) -> Tensor:
        """Slewed command (N, 21) that the nominal motion follows."""
        if self._memory is None:
            raise RuntimeError("call reset() first")
        return self._memory.nominal.reference

    def twin(self, num_robots: int) -> Controller:
        """A controller on the CPU with copies of the weights and a fresh memory for ``num_robots`` robots.

        One that runs in ONNX Runtime stays there.
        """
        pose = self.motion.pose
        tensors = [getattr(pose, name).cpu() for name in _POSE_TENSORS]
        actor = PilotActor(self.actor.sizes, self.config.network, ~normalised_columns(FRAME))
        actor.load_state_dict({name: tensor.cpu() for name, tensor in self.actor.state_dict().items()})
        runtime = self._compute if isinstance(self._compute, OnnxStep) else None
        twin = Controller(self.config, actor, NominalPose(pose.axes, *tensors), self.provenance, runtime=runtime)
        twin.reset(num_robots)
        return twin

    @property
    def last_history(self) -> Tensor:
        """Stacked frames (N, 6 * FRAME_SIZE) that the network saw last."""
        if self._memory is None:
            raise RuntimeError("call reset() first")
        return self._memory.history.flatten(1)

    @property
    def last_action(self) -> Tensor:
        """Residual action (N, 29) of the last step, in action scales."""
        if self._memory is None:
            raise RuntimeError("call reset() first")
        return self._memory.action

    # -- folders ----------------------------------------------------------------------------------------------

    @classmethod
    def load(
        cls,
        folder: Path | str,
        device: torch.device | str = "cpu",
        runtime: Literal["torch", "onnx"] = "torch",
    ) -> Controller:
        """Load a controller folder.

        ``runtime`` computes the control steps: torch, or ONNX Runtime, which is quicker for a few robots on a CPU.

        Raises:
            ControllerError: if a file is missing, damaged, of another version, or has weights that are not finite;
                or if the runtime is unknown or not for this device.
        """
        if runtime not in ("torch", "onnx"):
            raise ControllerError(f"there is no runtime {runtime!r}: use 'torch' or 'onnx'")
        folder = Path(folder)
        config, provenance = _FOLDER.read_config(folder, ControllerConfig)
        if config.joint_names != JOINT_NAMES:
            raise ControllerError(f"{folder / CONFIG_FILE} is for a robot with other joints or another joint order")
        tensors = _FOLDER.read_weights(folder)
        actor = PilotActor(actor_sizes(), config.network, ~normalised_columns(FRAME))
        try:
            pose_tensors = [tensors.pop(f"nominal_pose.{name}").to(device) for name in _POSE_TENSORS]
        except KeyError as error:
            raise ControllerError(f"{folder / WEIGHTS_FILE} has no {error}: export the controller again") from error
        try:
            actor.load_state_dict(tensors)
        except RuntimeError as error:
            first_line = str(error).splitlines()[-1].strip()
            raise ControllerError(f"{folder / WEIGHTS_FILE} does not fit {CONFIG_FILE}: {first_line}") from error
        pose = NominalPose(config.pose_axes, *pose_tensors)
        session = _read_onnx(folder, device) if runtime == "onnx" else None
        return cls(config, actor, pose, provenance, device, session)

    def save(self, folder: Path | str, golden_seed: int = 0) -> None:
        """Write the folder: JSON, weights, ONNX and golden vectors; each file is complete or absent.

        Raises:
            ControllerError: if a weight is not finite; nothing is written then.
        """
        folder = Path(folder)
        pose = {f"nominal_pose.{name}": getattr(self.motion.pose, name) for name in _POSE_TENSORS}
        _FOLDER.write_weights(folder, self.actor.state_dict() | pose)
        twin = self.twin(GOLDEN_ROBOTS)
        twin._compute = twin.step  # golden vectors are torch's
        golden = golden_vectors(twin, self.config.command_space, golden_seed)
        export_step(twin.step, self.config.command_space, folder / ONNX_FILE)
        atomic_write(folder / GOLDEN_FILE, lambda file: file.write(json.dumps(golden).encode()))
        layout = observation_layout()
        _FOLDER.write_description(folder, self.config, self.provenance, observation_layout=layout)


_POSE_TENSORS = ("values", "roll_limit", "pitch_limits")


def actor_sizes() -> ObservationSizes:
    """Sizes of what the policy sees; the critic's part plays no role in a frozen controller."""
    return ObservationSizes(FRAME_SIZE, HISTORY_LENGTH, MAP_SIZE, privileged=3, action=NUM_JOINTS)


def observation_layout() -> list[dict[str, Any]]:
    """Blocks of a proprioceptive frame in order, for whoever ports the controller."""
    start, layout = 0, []
    for block in FRAME:
        layout.append({"name": block.name, "start": start, "stop": start + block.size})
        start += block.size
    return layout


def content_hash(folder: Path | str) -> str:
    """Identity of a controller: SHA-256 over configuration and weights, 16 hexadecimal digits."""
    return _FOLDER.identity(Path(folder))


def add_metrics(folder: Path | str, metrics: dict[str, Any]) -> None:
    """Write measured figures into ``controller.json``; the identity does not change."""
    _FOLDER.add_provenance(Path(folder), metrics=metrics)


def _read_onnx(folder: Path, device: torch.device | str) -> OnnxStep:
    if torch.device(device).type != "cpu":
        raise ControllerError(f"the runtime 'onnx' computes on the CPU, not on {device}: use the runtime 'torch'")
    path = folder / ONNX_FILE
    if not path.is_file():
        raise ControllerError(f"{path} is missing: copy the whole controller folder")
    try:
        return OnnxStep(path)
    except (Fail, InvalidArgument, InvalidGraph, InvalidProtobuf) as error:
        raise ControllerError(f"{path} is damaged or truncated: {error}") from error
