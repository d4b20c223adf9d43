"""One control step of a frozen controller as a pure function, so that torch and ONNX Runtime can both compute it.

Whatever a controller remembers between steps goes in and comes out; nothing else is kept anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lowlevel.commands import CommandSpace
from lowlevel.networks import PilotActor
from lowlevel.nominal import NominalMotion
from lowlevel.nominal_state import NominalState
from lowlevel.observation import (
    FRAME_SIZE,
    HISTORY_LENGTH,
    FrameBuilder,
    Proprioception,
    map_observation,
    push_history,
    start_history,
)
from robots.g1.constants import NUM_JOINTS


class Memory(NamedTuple):
    """What a controller carries from one control step to the next, one row per robot."""

    nominal: NominalState
    """References, gait clock and feedback."""
    action: Tensor
    """Last action (N, 29), in action scales."""
    history: Tensor
    """Stacked frames (N, 6, FRAME_SIZE), oldest first."""
    is_fresh: Tensor
    """Robots that have not acted since their reset (N,) bool: their history starts with the next frame."""

    @classmethod
    def fresh(
        cls, num_robots: int, space: CommandSpace, settling_time: float, device: torch.device | str = "cpu"
    ) -> Memory:
        """The memory of robots that have not acted yet and first stand still for ``settling_time`` [s]."""
        return cls(
            nominal=NominalState.standing(space.neutral(device).repeat(num_robots, 1), settling_time),
            action=torch.zeros(num_robots, NUM_JOINTS, device=device),
            history=torch.zeros(num_robots, HISTORY_LENGTH + 1, FRAME_SIZE, device=device),
            is_fresh=torch.ones(num_robots, dtype=torch.bool, device=device),
        )

    @classmethod
    def from_tensors(cls, tensors: Sequence[Tensor]) -> Memory:
        """The memory whose :attr:`tensors` these are."""
        count = len(NominalState._fields)
        return cls(NominalState(*tensors[:count]), *tensors[count:])

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """One after the other, as :data:`MEMORY_NAMES` names them."""
        return *self.nominal, *self[1:]


MEMORY_NAMES = (*NominalState._fields, *Memory._fields[1:])
"""Names of :attr:`Memory.tensors`."""


class StepResult(NamedTuple):
    """What a control step returns for N robots."""

    targets: Tensor
    """PD targets (N, 29) [rad]."""
    gate: Tensor
    """Probability of each expert (N, E)."""
    memory: Memory
    """For the next step."""


class ControlStep(nn.Module):
    """Measurements, command and memory in; joint targets and memory out."""

    def __init__(
        self, actor: PilotActor, motion: NominalMotion, space: CommandSpace, action_scale: Tensor, action_limit: float
    ) -> None:
        """``action_scale`` (29,) [rad]; actions are clipped to +- ``action_limit`` of it."""
        super().__init__()
        self.actor = actor
        self.motion = motion
        self.action_limit = action_limit
        self._action_scale = action_scale
        self._build_frame = FrameBuilder(space, motion, action_scale.device)

    def forward(
        self, measured: Proprioception, elevation_map: Tensor, command: Tensor, flag: Tensor, memory: Memory
    ) -> StepResult:
        """One control period, with ``elevation_map`` (N, 121) [m], ``command`` (N, 21) and ``flag`` (N, 1)."""
        command = self.motion.clamp(command)
        state = self.motion.advance(memory.nominal, command)
        frame = self._build_frame(
            measured.joint_position,
            measured.joint_velocity,
            measured.base_angular_velocity,
            measured.projected_gravity,
            self.motion.tracked_command(state, command),
            memory.action,
            state,
        )
        started = memory.is_fresh[:, None, None]
        history = torch.where(started, start_history(frame), push_history(memory.history, frame))
        output = self.actor(history.flatten(1), map_observation(elevation_map), flag)
        action = output.mean.clamp(-self.action_limit, self.action_limit)
        nominal_target, state = self.motion.joint_targets(
            state,
            measured.joint_position,
            measured.projected_gravity,
            measured.base_angular_velocity,
            output.velocity,
        )
        remembered = Memory(state, action, history, torch.zeros_like(memory.is_fresh))
        return StepResult(nominal_target + action * self._action_scale, output.gate, remembered)
