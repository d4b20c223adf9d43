"""The frozen controller: whole-body commands in, PD joint targets out, at 50 Hz, for any number of robots.

A controller is a folder. Nothing in it is pickled:

``controller.json``      every convention at full precision, and where the controller comes from
``controller.onnx``      the whole control step as :mod:`lowlevel.control.onnx_step` describes it; needs ONNX Runtime
``weights.safetensors``  policy weights, normalizer and nominal-pose table, for torch
``golden.json``          reference inputs and outputs that any port can be checked against
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError
from torch import Tensor

from lowlevel.commands import POSTURE, VELOCITY, WALKING_POSTURE, CommandSpace, clamp_posture
from lowlevel.control.control_step import ControlStep, Memory
from lowlevel.control.elevation_map import MAP_SIZE
from lowlevel.control.golden import GOLDEN_ROBOTS, golden_vectors
from lowlevel.control.observation import (
    CONTROL_PERIOD,
    FRAME,
    FRAME_SIZE,
    HISTORY_LENGTH,
    Proprioception,
    columns,
    normalized_columns,
)
from lowlevel.control.onnx_step import OnnxStep, export_step
from lowlevel.control.reference import Reference, ReferenceConfig
from lowlevel.control.velocity_correction import VelocityCorrection
from lowlevel.control.whole_body import Bounds, Supports
from lowlevel.networks.actor import NetworkConfig, ObservationSizes, PilotActor
from lowlevel.runs.configs import from_plain
from lowlevel.runs.files import atomic_write
from lowlevel.runs.frozen_folder import FrozenFolder
from lowlevel.runs.precision import single_precision
from robots.errors import PilotError
from robots.g1.constants import JOINT_NAMES, NUM_JOINTS, Gains
from robots.g1.nominal_pose import Axis, NominalPose

FORMAT_VERSION = 10
CONFIG_FILE, WEIGHTS_FILE, ONNX_FILE, GOLDEN_FILE = (
    "controller.json",
    "weights.safetensors",
    "controller.onnx",
    "golden.json",
)


LOST_AFTER = 10
"""Control steps in a row without usable measurements after which a robot counts as lost: 0.2 s."""


class ControllerError(PilotError):
    """A controller folder cannot be used; the message says which file is at fault and why."""


_FOLDER = FrozenFolder(
    kind="controller",
    version=FORMAT_VERSION,
    description_file=CONFIG_FILE,
    weights_file=WEIGHTS_FILE,
    other_files=(ONNX_FILE, GOLDEN_FILE),
    example="checkpoints/lowlevel",
    error=ControllerError,
)


@dataclass(frozen=True)
class ControllerConfig:
    """What whoever runs the controller must know."""

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


@dataclass(frozen=True)
class PolicyConfig:
    """What it takes to compute the control step in torch."""

    reference: ReferenceConfig
    network: NetworkConfig
    pose_axes: tuple[Axis, Axis, Axis, Axis]
    """Grid of the nominal-pose table: height, roll, pitch, yaw."""


class Controller:
    """A frozen policy with its memory.

    Call :meth:`reset` once for a number of robots, then :meth:`act` every control period.

    A robot one of whose inputs is not finite, such as a sensor sample that was lost, keeps its last targets for that
    control period (:attr:`holds`) and remembers nothing of it; :attr:`lost` says when that has lasted too long.
    """

    def __init__(
        self,
        config: ControllerConfig,
        step: ControlStep | OnnxStep,
        provenance: dict[str, Any],
        device: torch.device | str = "cpu",
        pose: NominalPose | None = None,
    ) -> None:
        """``pose`` is the robot's nominal-pose table, the package's own by default."""
        self.config = config
        self.provenance = provenance
        self.device = torch.device(device)
        self.gains = Gains(np.array(config.stiffness), np.array(config.damping), np.array(config.action_scale))
        self.pose = NominalPose.load(device) if pose is None else pose
        self.step = step
        self._memory: Memory = {}
        self._default = torch.tensor(config.default_position, dtype=torch.float32, device=self.device)
        self._targets = self._default[None]
        self._steps_held = torch.zeros(1, dtype=torch.long, device=self.device)
        self.gate = torch.zeros(0)
        """Expert activations of the last :meth:`act` (N, experts)."""

    @property
    def command_space(self) -> CommandSpace:
        """What it can be told."""
        return self.config.command_space

    @property
    def supports(self) -> Supports:
        """All of its command space, in the postures in which it walks while it does."""
        bounds = Bounds(*self.command_space.bounds())
        still = Bounds(bounds.lower.clone(), bounds.upper.clone())
        still.lower[VELOCITY], still.upper[VELOCITY] = 0.0, 0.0
        lowest, highest = torch.tensor(WALKING_POSTURE).unbind(-1)
        posture = Bounds(bounds.lower.clone(), bounds.upper.clone())
        posture.lower[POSTURE], posture.upper[POSTURE] = lowest, highest
        return Supports(still, bounds & posture)

    @property
    def experts(self) -> int:
        """Experts whose activations :attr:`gate` holds."""
        return self.step.experts

    # -- control ----------------------------------------------------------------------------------------------

    @property
    def holds(self) -> Tensor:
        """Robots that keep earlier targets, because an input of the last :meth:`act` was not finite (N,)."""
        return self._steps_held > 0

    @property
    def lost(self) -> Tensor:
        """Robots that have kept them for LOST_AFTER control steps (N,): damp their motors."""
        return self._steps_held >= LOST_AFTER

    @single_precision()
    def reset(self, num_robots: int, ids: Tensor | None = None) -> None:
        """Forget everything about robots ``ids`` (all ``num_robots`` by default)."""
        fresh = self.step.first_memory(num_robots)
        if not self._memory or ids is None or len(self._memory["action"]) != num_robots:
            self._memory = fresh
            self._targets = self._default.repeat(num_robots, 1)
            self._steps_held = torch.zeros(num_robots, dtype=torch.long, device=self.device)
            return
        # Into copies: what was computed in inference mode cannot be written to outside of it.
        begins = torch.zeros(num_robots, dtype=torch.bool, device=self.device)
        begins[ids] = True
        self._memory = {name: _rows_where(begins, cleared, self._memory[name]) for name, cleared in fresh.items()}
        self._targets = _rows_where(begins, self._default.expand_as(self._targets), self._targets)
        self._steps_held = torch.where(begins, 0, self._steps_held)

    @torch.no_grad()
    @single_precision()
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
        if not self._memory or len(self._memory["action"]) != len(command):
            raise RuntimeError(f"call reset({len(command)}) before act() with {len(command)} robots")
        proprioception = Proprioception(*(tensor.float() for tensor in vars(proprioception).values()))
        elevation_map, command, flag = elevation_map.float(), command.float(), flag.float()
        result = self.step(proprioception, elevation_map, command, flag, self._memory)
        usable = _all_finite(*vars(proprioception).values(), elevation_map, command, flag)
        self._steps_held = torch.where(usable, 0, self._steps_held + 1)
        memory = {name: _rows_where(usable, value, self._memory[name]) for name, value in result.memory.items()}
        self.gate, self._memory = _rows_where(usable, result.gate, torch.zeros_like(result.gate)), memory
        self._targets = _rows_where(usable, result.targets, self._targets)
        return self._targets

    def clamp_command(self, command: Tensor) -> Tensor:
        """The command (N, 21) that is observed and scored in place of ``command``."""
        return clamp_posture(command, self.pose)

    @property
    def reference(self) -> Tensor:
        """Slewed command (N, 21)."""
        return self._remembered("reference")

    @property
    def last_history(self) -> Tensor:
        """Stacked frames (N, 6 * FRAME_SIZE) that the network saw last."""
        return self._remembered("history").flatten(1)

    @property
    def last_action(self) -> Tensor:
        """Residual action (N, 29) of the last step, in action scales."""
        return self._remembered("action")

    def _remembered(self, name: str) -> Tensor:
        if not self._memory:
            raise RuntimeError("call reset() first")
        return self._memory[name]

    def twin(self, num_robots: int) -> Controller:
        """A controller that shares the step and has a memory of its own for ``num_robots`` robots."""
        twin = Controller(self.config, self.step, self.provenance, self.device, self.pose)
        twin.reset(num_robots)
        return twin

    # -- folders ----------------------------------------------------------------------------------------------

    @classmethod
    @single_precision()
    def load(
        cls,
        folder: Path | str,
        device: torch.device | str = "cpu",
        runtime: Literal["onnx", "torch"] = "onnx",
    ) -> Controller:
        """Load a controller folder.

        ``runtime`` computes the control steps: ONNX Runtime on a CPU, or torch on any device.

        Raises:
            ControllerError: if a file that the runtime needs is missing, damaged, of another version, or gives targets
                that are not finite; or if the runtime is unknown or not for this device.
        """
        folder = Path(folder)
        config, provenance = _FOLDER.read_config(folder, ControllerConfig)
        if config.joint_names != JOINT_NAMES:
            raise ControllerError(f"{folder / CONFIG_FILE} is for a robot with other joints or another joint order")
        if abs(config.control_period - CONTROL_PERIOD) > 1e-9:
            raise ControllerError(
                f"{folder / CONFIG_FILE} is for a control period of {config.control_period} s, not {CONTROL_PERIOD} s"
            )
        if runtime not in ("onnx", "torch"):
            raise ControllerError(f"there is no runtime {runtime!r}: use 'onnx' or 'torch'")
        step = _read_onnx(folder, device) if runtime == "onnx" else _read_policy(folder, config, device)
        controller = cls(config, step, provenance, device)
        controller.reset(1)
        if not torch.isfinite(controller.act(*_standing(config, device))).all():
            raise ControllerError(f"{folder} gives a standing robot targets that are not finite: export it again")
        controller.reset(1)
        return controller


def _all_finite(*tensors: Tensor) -> Tensor:
    """Robots all of whose numbers in ``tensors`` (N, ...) are finite (N,)."""
    return torch.isfinite(torch.cat([tensor.flatten(1) for tensor in tensors], dim=1)).all(dim=1)


def _rows_where(chosen: Tensor, values: Tensor, others: Tensor) -> Tensor:
    return torch.where(chosen.view(-1, *[1] * (values.dim() - 1)), values, others)


def _standing(config: ControllerConfig, device: torch.device | str) -> tuple[Proprioception, Tensor, Tensor, Tensor]:
    """What a controller is given for one robot that stands as it is told."""
    command = config.command_space.neutral(device)[None]
    zeros = torch.zeros(1, 3, device=device)
    joints = torch.tensor(config.default_position, device=device)[None]
    measured = Proprioception(joints, torch.zeros_like(joints), zeros, torch.tensor([[0.0, 0.0, -1.0]], device=device))
    return measured, torch.full((1, MAP_SIZE), 0.76, device=device), command, torch.ones(1, 1, device=device)


def save_controller(
    folder: Path | str, config: ControllerConfig, policy: PolicyConfig, step: ControlStep, provenance: dict[str, Any]
) -> None:
    """Write a controller folder: JSON, weights, ONNX and golden vectors; each file is complete or absent.

    Raises:
        ControllerError: if a weight is not finite; nothing is written then.
    """
    folder = Path(folder)
    pose = {f"nominal_pose.{name}": getattr(step.reference.pose, name) for name in _POSE_TENSORS}
    _FOLDER.write_weights(folder, step.state_dict() | pose)
    controller = Controller(config, step, provenance)
    controller.reset(GOLDEN_ROBOTS)
    golden = golden_vectors(controller, config.command_space, seed=0)
    export_step(step, config.command_space, asdict(config), folder / ONNX_FILE)
    atomic_write(folder / GOLDEN_FILE, lambda file: file.write(json.dumps(golden).encode()))
    _FOLDER.write_description(
        folder, config, provenance, policy=asdict(policy), observation_layout=observation_layout()
    )


_POSE_TENSORS = ("values", "roll_limit", "pitch_limits")


def build_step(
    config: ControllerConfig,
    policy: PolicyConfig,
    actor: PilotActor,
    correction: VelocityCorrection,
    pose: NominalPose,
    device: torch.device | str,
) -> ControlStep:
    """The control step of ``actor``, told what ``correction`` makes of the command, in torch."""
    scale = torch.tensor(config.action_scale, device=device)
    gains = Gains(np.array(config.stiffness), np.array(config.damping), np.array(config.action_scale))
    reference = Reference(policy.reference, gains, config.control_period, device, pose)
    step = ControlStep(actor, correction, reference, config.command_space, scale, config.action_limit)
    return step.to(device).eval().requires_grad_(False)


def _read_policy(folder: Path, config: ControllerConfig, device: torch.device | str) -> ControlStep:
    try:
        policy = from_plain(PolicyConfig, _FOLDER.read_description(folder)["policy"])
    except (KeyError, TypeError, ValueError) as error:
        raise ControllerError(f"{folder / CONFIG_FILE} is incomplete: {error}") from error
    tensors = _FOLDER.read_weights(folder)
    try:
        pose_tensors = [tensors.pop(f"nominal_pose.{name}").to(device) for name in _POSE_TENSORS]
    except KeyError as error:
        raise ControllerError(f"{folder / WEIGHTS_FILE} has no {error}: export the controller again") from error
    actor = PilotActor(actor_sizes(), policy.network, ~normalized_columns(FRAME))
    correction = VelocityCorrection(config.command_space)
    step = build_step(config, policy, actor, correction, NominalPose(policy.pose_axes, *pose_tensors), device)
    try:
        step.load_state_dict(tensors)
    except RuntimeError as error:
        first_line = str(error).splitlines()[-1].strip()
        raise ControllerError(f"{folder / WEIGHTS_FILE} does not fit {CONFIG_FILE}: {first_line}") from error
    return step


def actor_sizes() -> ObservationSizes:
    """Sizes of what the policy sees; the critic's part plays no role in a frozen controller."""
    return ObservationSizes(FRAME_SIZE, HISTORY_LENGTH, MAP_SIZE, privileged=3, action=NUM_JOINTS)


def observation_layout() -> list[dict[str, Any]]:
    """Blocks of a proprioceptive frame in order, for whoever ports the controller."""
    places = {block.name: columns(FRAME, block.name) for block in FRAME}
    return [{"name": name, "start": place.start, "stop": place.stop} for name, place in places.items()]


def content_hash(folder: Path | str) -> str:
    """Identity of a controller: SHA-256 over all of its folder but the provenance, 16 hexadecimal digits."""
    return _FOLDER.identity(Path(folder))


def _read_onnx(folder: Path, device: torch.device | str) -> OnnxStep:
    if torch.device(device).type != "cpu":
        raise ControllerError(f"the runtime 'onnx' computes on the CPU, not on {device}: use the runtime 'torch'")
    path = folder / ONNX_FILE
    if not path.is_file():
        raise ControllerError(f"{path} is missing: copy the whole controller folder")
    try:
        # ONNX Runtime's own errors are private to it.
        onnx.checker.check_model(onnx.load(path))
        return OnnxStep(path.read_bytes())
    except (DecodeError, onnx.checker.ValidationError) as error:
        raise ControllerError(f"{path} is damaged or truncated: {error}") from error
    except (KeyError, ValueError) as error:
        raise ControllerError(f"{path} does not say what its first memory is: export the controller again") from error
