"""What a whole-body controller is, whoever made it: everything that runs one goes by this alone."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

from lowlevel.commands import CommandSpace
from lowlevel.control.observation import Proprioception
from robots.g1.constants import Gains


class WholeBodyController(Protocol):
    """Turns whole-body commands into PD targets, every 0.02 s, for any number of robots.

    Joints are in the order of :data:`robots.g1.constants.JOINT_NAMES`.
    """

    @property
    def gains(self) -> Gains:
        """Those of the PD motors that follow its targets."""

    @property
    def command_space(self) -> CommandSpace:
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
