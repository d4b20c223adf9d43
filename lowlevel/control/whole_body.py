"""What a whole-body controller is, whoever made it: everything that runs one goes by this alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from lowlevel.commands import VELOCITY, is_walking
from lowlevel.control.observation import Proprioception
from robots.g1.constants import Gains


@dataclass(frozen=True)
class Bounds:
    """Bounds of a command (21,)."""

    lower: Tensor
    upper: Tensor

    def __and__(self, other: Bounds) -> Bounds:
        return Bounds(torch.maximum(self.lower, other.lower), torch.minimum(self.upper, other.upper))


@dataclass(frozen=True)
class Supports:
    """What a controller can be told."""

    standing: Bounds
    walking: Bounds

    def cut(self, command: Tensor) -> Tensor:
        """The supported command that is nearest to each ``command`` (N, 21)."""
        velocity = command[:, VELOCITY].clamp(self.walking.lower[VELOCITY], self.walking.upper[VELOCITY])
        told = torch.cat([velocity, command[:, VELOCITY.stop :]], dim=1)
        walks = is_walking(told)[:, None]
        standing = told.clamp(self.standing.lower, self.standing.upper)
        return torch.where(walks, told.clamp(self.walking.lower, self.walking.upper), standing)

    def __and__(self, other: Supports) -> Supports:
        return Supports(self.standing & other.standing, self.walking & other.walking)


class WholeBodyController(Protocol):
    """Turns whole-body commands into PD targets, every 0.02 s, for any number of robots.

    Joints are in the order of :data:`robots.g1.constants.JOINT_NAMES`. Tensors are float32, on the CPU where they come
    from an evaluation.
    """

    @property
    def gains(self) -> Gains:
        """Those of the PD motors that follow its targets."""

    @property
    def supports(self) -> Supports:
        """What it can be told."""

    def reset(self, num_robots: int, ids: Tensor | None = None) -> None:
        """Forget everything about robots ``ids`` (n,), all ``num_robots`` by default."""

    def act(self, proprioception: Proprioception, elevation_map: Tensor, command: Tensor, flag: Tensor) -> Tensor:
        """PD targets (N, 29) [rad] for the next control period.

        ``elevation_map`` (N, 121) [m] is the vertical distance from the pelvis to the ground, ``command`` (N, 21) what
        the robot is told, ``flag`` (N, 1) the tracking flag I.
        """


@runtime_checkable
class HasExperts(Protocol):
    """Of a controller that is a mixture of experts."""

    @property
    def experts(self) -> int:
        """How many."""

    gate: Tensor
    """Activations of the last step (N, experts)."""
