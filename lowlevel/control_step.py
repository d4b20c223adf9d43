"""One control step of a frozen controller as a pure function, so that torch and ONNX Runtime can both compute it.

Whatever a controller remembers between steps goes in and comes out; nothing else is kept anywhere.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lowlevel.commands import CommandSpace
from lowlevel.networks import PilotActor
from lowlevel.nominal import NominalMotion, NominalState
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

    reference: Tensor
    """Slewed command (N, 21)."""
    phase: Tensor
    """Gait phase (N,) [rad]."""
    walking: Tensor
    """Fade-in of the march (N,) in [0, 1]."""
    stepping: Tensor
    """Time for which a robot told to stand still marches to catch itself (N,) [s]."""
    settling: Tensor
    """Time for which a robot told to stand still keeps its posture (N,) [s]."""
    unbalance: Tensor
    """As :meth:`NominalMotion.joint_targets` found it last (N,) [rad]."""
    action: Tensor
    """Last action (N, 29), in action scales."""
    history: Tensor
    """Stacked frames (N, 6, FRAME_SIZE), oldest first."""
    is_fresh: Tensor
    """Robots that have not acted since their reset (N,) bool: their history starts with the next frame."""

    @classmethod
    def fresh(cls, num_robots: int, space: CommandSpace, device: torch.device | str = "cpu") -> Memory:
        """The memory of robots that have not acted yet."""

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(num_robots, *shape, device=device)

        return cls(
            reference=space.neutral(device).repeat(num_robots, 1),
            phase=zeros(),
            walking=zeros(),
            stepping=zeros(),
            settling=zeros(),
            unbalance=zeros(),
            action=zeros(NUM_JOINTS),
            history=zeros(HISTORY_LENGTH + 1, FRAME_SIZE),
            is_fresh=torch.ones(num_robots, dtype=torch.bool, device=device),
        )


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
        state = NominalState(memory.reference, memory.phase, memory.walking, memory.stepping, memory.settling)
        command = self.motion.clamp(command)
        state = self.motion.advance(state, command, memory.unbalance)
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
        nominal, unbalance = self.motion.joint_targets(
            state, measured.projected_gravity, measured.base_angular_velocity
        )
        remembered = Memory(
            state.reference,
            state.phase,
            state.walking,
            state.stepping,
            state.settling,
            unbalance,
            action,
            history,
            torch.zeros_like(memory.is_fresh),
        )
        return StepResult(nominal + action * self._action_scale, output.gate, remembered)
