"""A teacher that also holds the torso up: what a slow integrator at the waist would add to another teacher's action.

Under a load before the chest a trained robot leans forwards by 0.2 rad, with its capture point 0.1 m ahead, although
0.06 rad more at the waist brings both back, and earns 7 of 40 units per second. That takes seconds to show, and PPO
credits an action with what follows within half a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.commands import ARMS, POSTURE
from lowlevel.environment import PilotEnvironment
from lowlevel.imitation.cloning import Teacher
from lowlevel.world.measures import torso_error
from robots.g1.constants import joint_index


@dataclass(frozen=True)
class UprightConfig:
    """The integrator."""

    rate: float = 1.0
    """[1/s]"""
    leak: float = 0.3
    """Rate at which it forgets [1/s]: what it adds comes to rest at 3.3 times an error that the student goes on making.
    Without it the waists of a whole clone wind up to the limit, and their divergence drowns all else."""
    limit: float = 0.24
    """Largest correction [rad]."""
    settling: float = 0.5
    """It works from so long after the slewed posture and arms have reached the command [s]."""


_ARRIVED_POSTURE, _ARRIVED_ARMS = 0.02, 0.05
"""How close the slewed command then is [m, rad]."""


class UprightTeacher:
    """Acts like ``inner``, and turns the waist's pitch joint until the torso is pitched as commanded."""

    def __init__(self, inner: Teacher, environment: PilotEnvironment, config: UprightConfig) -> None:
        self._inner, self._environment, self._config = inner, environment, config
        self._joint = joint_index("waist_pitch_joint")
        self._added = torch.zeros(environment.num_robots)
        """To the joint's target (N,) [rad]."""
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
        error = torso_error(environment.world.measure(), buffers.command)[:, 1]
        change = period * (config.rate * error + config.leak * self._added) * (self._settled > config.settling)
        self._added = (self._added - change).clamp(-config.limit, config.limit)
        action = self._inner.label(observation).clone()
        action[:, self._joint] += (self._added / environment.action_scale[self._joint]).to(action.device)
        return action

    def forget(self, robots: Tensor) -> None:
        self._inner.forget(robots)
        begins = robots.to(self._added.device)
        self._added[begins] = self._settled[begins] = 0.0
