"""What the action is a residual on: the slewed command, the gait clock, and the joint targets that they give.

The paper adds the policy's arm output to the commanded arm joints (III-B-2). Here legs and waist do the same around
the nominal-pose table, an addition to the paper. No gait is built: how the robot steps is the policy's. The training
environment and the frozen controller share this module.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lowlevel.commands import (
    ARMS,
    COMMAND_SIZE,
    HEIGHT,
    POSTURE,
    TORSO,
    VELOCITY,
    WALKING_POSTURE,
    clamp_posture,
    is_walking,
)
from robots.g1.arm_mass import ArmMass
from robots.g1.constants import ARM_JOINTS, GRAVITY, LOWER_JOINTS, Gains
from robots.g1.nominal_pose import NominalPose

CATCHING = 8.0 * math.pi
"""Phase from which on a robot catches itself [rad]."""


@dataclass(frozen=True)
class ReferenceConfig:
    """How fast the command is followed, and how fast the robot steps."""

    gait_frequency: float = 2.0
    """Steps of one foot per second [Hz]."""
    catching_frequency: float = 3.0
    """The same of a robot that steps because it topples [Hz]. One pushed to its side brings the free foot in first, and
    has toppled 1.6 times as far by the time that the other one has swung outwards at 2 Hz."""
    velocity_rate: float = 2.5
    """Slew rate of the velocity away from zero [m/s^2] and [rad/s^2]."""
    braking_rate: float = 1.5
    """Slew rate of the velocity towards zero [m/s^2] and [rad/s^2]: it takes two steps to stop."""
    height_rate: float = 0.5
    """Slew rate of the base height [m/s]."""
    torso_rate: tuple[float, float, float] = (1.2, 1.2, 2.0)
    """Slew rates of the torso's roll, pitch and yaw [rad/s]; yaw hardly moves the center of mass."""
    arm_rate: float = 8.0
    """Slew rate of the arm joints [rad/s]."""


class ReferenceState(NamedTuple):
    """One row per robot."""

    command: Tensor
    """Slewed command (N, 21)."""
    phase: Tensor
    """Gait phase (N,) [rad]: the left foot swings in (0, pi), the right one in (pi, 2 pi); 0 while standing. The same
    goes on beyond 2 pi while the robot stops, and from CATCHING on while it catches itself."""

    @classmethod
    def standing(cls, command: Tensor) -> ReferenceState:
        """At rest at ``command`` (N, 21)."""
        return cls(command, torch.zeros(len(command), device=command.device))

    @property
    def walking(self) -> Tensor:
        """Whether the gait clock runs (N,)."""
        return self.phase > 0.0

    @property
    def clock(self) -> Tensor:
        """Gait clock as the policy sees it (N, 2): sine and cosine of the phase, zero while standing."""
        return torch.stack([torch.sin(self.phase), torch.cos(self.phase)], -1) * self.walking[:, None]


class Reference:
    """Advances reference states and turns them into joint targets; holds no per-robot state itself."""

    def __init__(
        self,
        config: ReferenceConfig,
        gains: Gains,
        control_period: float,
        device: torch.device | str = "cpu",
        pose: NominalPose | None = None,
    ) -> None:
        """``pose`` is the nominal-pose table, the package's own by default."""
        self.config = config
        self.pose = NominalPose.load(device) if pose is None else pose
        inverse_stiffness = 1.0 / torch.tensor(gains.stiffness, dtype=torch.float32, device=device)
        self._lower_compliance, self._arm_compliance = inverse_stiffness[LOWER_JOINTS], inverse_stiffness[ARM_JOINTS]
        self._arm_mass = ArmMass(device)
        rate = torch.empty(COMMAND_SIZE, device=device)
        rate[VELOCITY], rate[HEIGHT] = config.velocity_rate, config.height_rate
        rate[TORSO], rate[ARMS] = torch.tensor(config.torso_rate, device=device), config.arm_rate
        braking = torch.cat([torch.full((VELOCITY.stop,), config.braking_rate, device=device), rate[HEIGHT:]])
        self._largest_change, self._largest_braking = rate * control_period, braking * control_period
        self._lowest, self._highest = torch.tensor(WALKING_POSTURE, device=device).unbind(-1)
        self._phase_step = 2.0 * math.pi * config.gait_frequency * control_period
        self._catching_step = 2.0 * math.pi * config.catching_frequency * control_period

    def clamp(self, command: Tensor) -> Tensor:
        """See :func:`lowlevel.commands.clamp_posture`."""
        return clamp_posture(command, self.pose)

    def advance(self, state: ReferenceState, command: Tensor) -> ReferenceState:
        """One control step of slewing and gait clock towards ``command`` (N, 21).

        A robot told to stand finishes the step that it is in and makes one more: it follows its velocity command late,
        and one that still moves when the clock rests topples over its feet. It stops before it squats, and stands up
        before it walks.
        """
        goal = self._goal(state, command)
        wanted = goal - state.command
        largest = torch.where(wanted * state.command < 0.0, self._largest_braking, self._largest_change)
        change = wanted.clamp(-largest, largest)
        slewed = state.command + change
        walks = is_walking(goal) | is_walking(slewed)
        walking = (state.phase + self._phase_step) % (2.0 * math.pi)
        return ReferenceState(slewed, torch.where(walks, walking, self._stopping(state.phase)))

    def begin_step(self, state: ReferenceState, swing_first: Tensor) -> ReferenceState:
        """Let robots at rest make two steps.

        ``swing_first`` (N,): the foot to begin with, 1 left, -1 right, 0 for no step.
        """
        steps = (swing_first != 0.0) & ~state.walking
        beginning = CATCHING + torch.where(swing_first > 0.0, 0.0, 5.0 * math.pi) + self._catching_step
        return state._replace(phase=torch.where(steps, beginning, state.phase))

    def _can_walk(self, command: Tensor) -> Tensor:
        """Whether robots walk in the posture of ``command`` (N, 21), as (N, 1)."""
        posture = command[:, POSTURE]
        return (posture - posture.clamp(self._lowest, self._highest)).abs().amax(dim=1, keepdim=True) < 1e-3

    def _goal(self, state: ReferenceState, command: Tensor) -> Tensor:
        """What ``state`` may head for by now (N, 21): deep postures wait for the last step, velocity for posture."""
        moves = state.walking[:, None] | is_walking(command)[:, None]
        wanted = command[:, POSTURE]
        within = torch.where(moves, wanted.clamp(self._lowest, self._highest), wanted)
        return torch.cat([command[:, VELOCITY] * self._can_walk(state.command), within, command[:, ARMS]], dim=1)

    def _stopping(self, phase: Tensor) -> Tensor:
        """The next phase (N,) of robots that stop: from (0, pi) on to 4 pi, from (pi, 2 pi) on to 7 pi, then 0.

        Of those that catch themselves: from CATCHING, or from 5 pi beyond it, on for 2 pi.
        """
        turns = torch.where(phase < math.pi, 1.0, 2.0) * (phase < 2.0 * math.pi)
        stopping = phase + 2.0 * math.pi * turns + self._phase_step
        end = torch.where(stopping < 4.5 * math.pi, 4.0 * math.pi, 7.0 * math.pi)
        catching = phase + self._catching_step
        caught = CATCHING + torch.where(catching < CATCHING + 3.5 * math.pi, 2.0, 7.0) * math.pi
        catches = phase >= CATCHING
        following, end = torch.where(catches, catching, stopping), torch.where(catches, caught, end)
        return torch.where((phase > 0.0) & (following < end), following, 0.0)

    def joint_targets(self, state: ReferenceState) -> Tensor:
        """PD targets (N, 29) [rad] that hold the slewed posture, led by what gravity would make the joints sag.

        They may lie beyond the joint limits: a joint that rests at its limit needs such a target to push against it.
        """
        stance = self.pose.lookup(state.command[:, POSTURE])
        lower = stance.position + stance.torque * self._lower_compliance
        arms = state.command[:, ARMS]
        torque = self._arm_mass.holding_torque(arms, _gravity_in_torso(state.command[:, TORSO]))
        return torch.cat([lower, arms + torque * self._arm_compliance], dim=1)


def _gravity_in_torso(torso: Tensor) -> Tensor:
    """Gravity (N, 3) [m/s^2] in the frame of a torso at roll, pitch, yaw ``torso`` (N, 3) [rad]."""
    roll, pitch, _ = torso.unbind(-1)
    upright = torch.stack([-torch.sin(pitch), torch.cos(pitch) * torch.sin(roll), torch.cos(pitch) * torch.cos(roll)])
    return -GRAVITY * upright.T
