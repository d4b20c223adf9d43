"""A teacher that also holds the robot up: what slow integrators at waist and ankles would add to another one's action.

Under a load before the chest a trained robot leans forwards, with its capture point up to 0.1 m ahead, although at
most 0.05 rad at the waist and 0.1 rad at the ankles bring both back. That takes seconds to show, and PPO
credits an action with what follows within half a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.commands import ARMS, POSTURE
from lowlevel.control.stepping import FARTHEST
from lowlevel.environment import PilotEnvironment
from lowlevel.imitation.cloning import Teacher
from lowlevel.world.measures import torso_error
from robots.g1.constants import joint_index


@dataclass(frozen=True)
class UprightConfig:
    """The integrators."""

    waist_rate: float = 1.0
    """Of the waist's pitch joint, per pitch error of the torso [1/s]."""
    ankle_rate: float = 3.0
    """Of both ankles' pitch joints, per distance that the capture point of a robot at rest is ahead [rad/(m s)]."""
    leak: float = 0.3
    """Rate at which they forget [1/s]: what they add comes to rest at a multiple of an error that the student goes on
    making. Without it the waists of a whole clone wind up to the limit, and their divergence drowns all else."""
    limit: float = 0.24
    """Largest correction [rad]."""
    settling: float = 0.5
    """They work from so long after the slewed posture and arms have reached the command [s]."""


_ARRIVED_POSTURE, _ARRIVED_ARMS = 0.02, 0.05
"""How close the slewed command then is [m, rad]."""


class UprightTeacher:
    """Acts like ``inner``, turns the waist until the torso is pitched as commanded, and the ankles of a robot at rest
    until it stands over its feet."""

    def __init__(self, inner: Teacher, environment: PilotEnvironment, config: UprightConfig) -> None:
        self._inner, self._environment, self._config = inner, environment, config
        self._waist = joint_index("waist_pitch_joint")
        self._ankles = [joint_index(f"{side}_ankle_pitch_joint") for side in ("left", "right")]
        self._rates = torch.tensor([-config.waist_rate, config.ankle_rate])
        self._added = torch.zeros(environment.num_robots, 2)
        """To the targets of waist and ankles (N, 2) [rad]."""
        self._settled = torch.zeros(environment.num_robots)
        """Time since the posture was reached (N,) [s]."""

    @torch.no_grad()
    def label(self, observation: dict[str, Tensor]) -> Tensor:
        environment, config = self._environment, self._config
        buffers, period = environment.buffers, environment.control_period
        apart = (buffers.reference.command - buffers.command).abs()
        arrived = apart[:, POSTURE].amax(dim=1) < _ARRIVED_POSTURE
        arrived &= apart[:, ARMS].amax(dim=1) < _ARRIVED_ARMS
        self._settled = torch.where(arrived, self._settled + period, 0.0)
        measured, rests = environment.world.measure(), ~buffers.reference.walking
        errors = torch.stack([torso_error(measured, buffers.command)[:, 1], measured.capture_point[:, 0]], dim=1)
        # A robot that was pushed catches itself, and knows how to.
        balances = rests & (measured.capture_point.norm(dim=1) < FARTHEST)
        settled = self._settled > config.settling
        works = torch.stack([settled, settled & balances], dim=1)
        change = period * (self._rates * errors - config.leak * self._added) * works
        self._added = (self._added + change).clamp(-config.limit, config.limit)
        self._added[:, 1] *= rests
        action, scale = self._inner.label(observation).clone(), environment.action_scale
        action[:, self._waist] += (self._added[:, 0] / scale[self._waist]).to(action.device)
        action[:, self._ankles] += (self._added[:, 1:] / scale[self._ankles]).to(action.device)
        return action

    def forget(self, robots: Tensor) -> None:
        self._inner.forget(robots)
        begins = robots.to(self._added.device)
        self._added[begins], self._settled[begins] = 0.0, 0.0
