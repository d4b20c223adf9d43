"""The planner's action: 21 numbers in [-1, 1] that become a bounded, rate-limited and feasible whole-body
command.

The paper names the planner's output, the command of 21 numbers, but neither its rate nor its bounds (IV-B-2).
The numbers here are choices. An absolute target behind a rate limiter keeps the task Markov as long as the
limited command is observed as the previous command, and it is; see
:class:`highlevel.environment.CommandEnvironment`. Feasibility comes last: near the limits of the posture, clamping can
move the torso's pitch by more than its rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.commands import ARMS, COMMAND_SIZE, HEIGHT, TORSO, VELOCITY, is_walking
from robots.g1.mirror import both_arms

_PER_ARM = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True)
class ActionConfig:
    """Range and largest rate of change of every part of the command."""

    velocity_lower: tuple[float, float, float] = (-0.3, -0.3, -0.8)
    """vx, vy [m/s], yaw rate [rad/s]."""
    velocity_upper: tuple[float, float, float] = (0.6, 0.3, 0.8)
    velocity_rate: tuple[float, float, float] = (1.0, 1.0, 2.0)
    """[m/s^2, m/s^2, rad/s^2]"""
    height: tuple[float, float] = (0.33, 0.76)
    """[m]"""
    height_rate: float = 0.4
    """[m/s]"""
    roll: float = 0.15
    """Half range [rad]."""
    pitch: tuple[float, float] = (-0.1, 1.4)
    """[rad]"""
    yaw: float = 0.3
    """Half range [rad]."""
    roll_yaw_rate: float = 0.5
    """[rad/s]"""
    pitch_rate: float = 1.2
    """[rad/s]"""
    arm_center: _PER_ARM = (-0.65, 0.25, 0.1, 0.4, -0.1, 0.2, 0.0)
    """Nominal hold pose of the left arm in Unitree's order, mirrored for the right one [rad]."""
    arm_half_range: _PER_ARM = (1.1, 0.5, 0.5, 1.1, 0.5, 1.1, 0.5)
    """Half range around it [rad]: from the arms at the sides over a grasp on the floor to a box held at the
    chest."""
    arm_rate: float = 2.0
    """[rad/s]"""
    decision_steps: int = 5
    """Control steps per decision: 10 Hz at 50 Hz control."""


class ActionMap:
    """Turns actions into commands and, for demonstrations, commands into actions.

    Args:
        config: ranges and rates.
        control_period: of the controller [s].
    """

    def __init__(self, config: ActionConfig, control_period: float) -> None:
        self.config = config
        arm_center = torch.tensor(both_arms(config.arm_center), dtype=torch.float32)
        arm_half = torch.tensor(config.arm_half_range).repeat(2)
        torso_lower = (-config.roll, config.pitch[0], -config.yaw)
        torso_upper = (config.roll, config.pitch[1], config.yaw)
        self.lower = _assemble(config.velocity_lower, config.height[0], torso_lower, (arm_center - arm_half).tolist())
        self.upper = _assemble(config.velocity_upper, config.height[1], torso_upper, (arm_center + arm_half).tolist())
        torso_rate = (config.roll_yaw_rate, config.pitch_rate, config.roll_yaw_rate)
        rate = _assemble(config.velocity_rate, config.height_rate, torso_rate, (config.arm_rate,) * 14)
        self.largest_change = rate * config.decision_steps * control_period
        """Largest change of the command in one decision (21,)."""

    def command(self, action: Tensor) -> Tensor:
        """The command (N, 21) that ``action`` (N, 21) asks for, clipped to the range."""
        return self.lower + 0.5 * (action.clamp(-1.0, 1.0) + 1.0) * (self.upper - self.lower)

    def action(self, command: Tensor) -> Tensor:
        """The action (N, 21), within [-1, 1], whose command is nearest to ``command`` (N, 21)."""
        return self.normalize(command).clamp(-1.0, 1.0)

    def normalize(self, command: Tensor) -> Tensor:
        """``command`` (N, 21) in units of the action; not clipped."""
        return 2.0 * (command - self.lower) / (self.upper - self.lower) - 1.0

    def limit(self, previous: Tensor, action: Tensor) -> Tensor:
        """The command (N, 21) to reach at the end of a decision that starts at ``previous`` (N, 21)."""
        wanted = self.command(action) - previous
        return previous + torch.clamp(wanted, -self.largest_change, self.largest_change)


def interpolate(previous: Tensor, goal: Tensor, fraction: float) -> Tensor:
    """The command (N, 21) after ``fraction`` of a decision, with velocities that mean standing still set to
    zero.

    Training never showed the controller a velocity between zero and the standing threshold.
    """
    command = previous + fraction * (goal - previous)
    command[:, VELOCITY] *= is_walking(command)[:, None]
    return command


def _assemble(
    velocity: tuple[float, float, float],
    height: float,
    torso: tuple[float, float, float],
    arms: list[float] | tuple[float, ...],
) -> Tensor:
    command = torch.zeros(COMMAND_SIZE)
    command[VELOCITY] = torch.tensor(velocity)
    command[HEIGHT] = height
    command[TORSO] = torch.tensor(torso)
    command[ARMS] = torch.tensor(arms)
    return command
