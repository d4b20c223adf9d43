"""One control step of a frozen controller as a pure function, so that torch and ONNX Runtime can both compute it.

Whatever a controller remembers between steps goes in and comes out; nothing else is kept anywhere.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lowlevel.commands import CommandSpace
from lowlevel.control.observation import (
    FRAME,
    FRAME_SIZE,
    HISTORY_LENGTH,
    FrameView,
    Proprioception,
    build,
    columns,
    map_observation,
    push_history,
    start_history,
)
from lowlevel.control.reference import Reference, ReferenceState
from lowlevel.control.stepping import swing_first
from lowlevel.control.velocity_correction import VelocityCorrection
from lowlevel.networks.actor import CAPTURE_POINT, PilotActor
from robots.g1.constants import NUM_JOINTS

Memory = dict[str, Tensor]
"""What a controller carries from one control step to the next: name to tensor, one row per robot."""


class StepResult(NamedTuple):
    """What a control step returns for N robots."""

    targets: Tensor
    """PD targets (N, 29) [rad]."""
    gate: Tensor
    """Probability of each expert (N, E)."""
    memory: Memory
    """For the next step."""


class ControlStep(nn.Module):
    """Measurements, command and memory in; joint targets and memory out.

    It remembers the slewed command "reference" (N, 21), the gait "phase" (N,) [rad], the last "action" (N, 29) in
    action scales, and the "history" (N, 6, FRAME_SIZE) of frames, oldest first. A history of zeros means that the
    robot has not acted yet: it starts with the next frame.
    """

    def __init__(
        self,
        actor: PilotActor,
        correction: VelocityCorrection,
        reference: Reference,
        space: CommandSpace,
        action_scale: Tensor,
        action_limit: float,
    ) -> None:
        """``action_scale`` (29,) [rad]; actions are clipped to +- ``action_limit`` of it."""
        super().__init__()
        self.actor, self.correction = actor, correction
        self.reference = reference
        self.action_limit = action_limit
        self._space = space
        self._action_scale = action_scale

    @property
    def experts(self) -> int:
        """Entries of the gate."""
        network = self.actor.config
        return network.experts if network.mixture else 1

    def first_memory(self, num_robots: int) -> Memory:
        """The memory of robots that have not acted yet and stand."""
        device = self._action_scale.device
        return {
            "reference": self._space.neutral(device).repeat(num_robots, 1),
            "phase": torch.zeros(num_robots, device=device),
            "action": torch.zeros(num_robots, NUM_JOINTS, device=device),
            "history": torch.zeros(num_robots, HISTORY_LENGTH + 1, FRAME_SIZE, device=device),
        }

    def forward(
        self, measured: Proprioception, elevation_map: Tensor, command: Tensor, flag: Tensor, memory: Memory
    ) -> StepResult:
        """One control period, with ``elevation_map`` (N, 121) [m], ``command`` (N, 21) and ``flag`` (N, 1)."""
        command = self.reference.clamp(command)
        state = self.reference.advance(ReferenceState(memory["reference"], memory["phase"]), command)
        view = FrameView(measured, command, memory["action"], state, self._space)
        frame = build(FRAME, self.correction.tell(view))
        # Gravity is a unit vector in every frame that was ever measured.
        last_gravity = memory["history"][:, -1, columns(FRAME, "projected_gravity")]
        is_first = (last_gravity == 0.0).all(dim=1)[:, None, None]
        history = torch.where(is_first, start_history(frame), push_history(memory["history"], frame))
        output = self.actor(history.flatten(1), map_observation(elevation_map), flag)
        action = output.mean.clamp(-self.action_limit, self.action_limit)
        targets = self.reference.joint_targets(state) + action * self._action_scale
        phase = self.reference.begin_step(state, swing_first(output.motion[:, CAPTURE_POINT])).phase
        remembered = {"reference": state.command, "phase": phase, "action": action, "history": history}
        return StepResult(targets, output.gate, remembered)
