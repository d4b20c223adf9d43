"""What a task is to the planner's environment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import torch
from torch import Tensor

from highlevel.action import ActionConfig
from lowlevel.world.measures import Measurement
from lowlevel.world.simulation import BatchSimulation


@dataclass(frozen=True)
class ObservationBlock:
    """A named part of the observation and the scale [its unit] that brings it to about one."""

    name: str
    size: int
    scale: float


@dataclass(frozen=True)
class Start:
    """Where robots begin an episode, standing upright."""

    position: Tensor
    """(n, 2) on the ground [m]."""
    heading: Tensor
    """(n,) [rad]"""


@dataclass(frozen=True)
class Outcome:
    """What one control step brought to N robots."""

    reward: Tensor
    """(N,)"""
    success: Tensor
    """The episode is over and won (N,)."""
    failure: Tensor
    """The episode is over and lost (N,)."""


@dataclass(frozen=True)
class Decision:
    """What the planner decided and what became of it; the commands of one option (N, 21) each."""

    previous: Tensor
    """The command it started from."""
    goal: Tensor
    """The limited and feasible command at its end."""
    change: Tensor
    """Their difference in units of the largest change of one decision."""


@dataclass(frozen=True)
class SweepAxis:
    """One quantity of a task's configuration and the values that an evaluation gives it."""

    label: str
    """With the unit."""
    values: tuple[float, ...]
    fix: Callable[[Any, float], Any]
    """The configuration with the quantity fixed at a value."""


@dataclass(frozen=True)
class Sweep:
    """Success over a grid of conditions, everything else drawn as always."""

    name: str
    rows: SweepAxis
    columns: SweepAxis | None = None

    @property
    def size(self) -> int:
        """Number of cells."""
        return len(self.rows.values) * (1 if self.columns is None else len(self.columns.values))


class Task(ABC):
    """A task for N robots at once. The environment owns the robots, the task owns everything else in the
    scene.

    The order of calls: :meth:`add_to` once, :meth:`attach` once, then :meth:`reset` for robots that begin an
    episode and :meth:`step` for all of them after every control step; the observations at any time. A task remembers
    the episodes of its robots, so that it belongs to one environment.
    """

    name: str
    stages: tuple[str, ...]
    """Names of the stages of an episode, in order; the last one is success."""
    action: ActionConfig
    episode_length: float
    """Longest episode [s]."""
    fall_penalty: float
    """Reward for a fall, not positive."""
    object_blocks: tuple[ObservationBlock, ...]
    """What the paper's planner sees of the object; it comes first in the observation."""
    added_blocks: tuple[ObservationBlock, ...]
    """Additions to the paper's observation; they come last."""
    sweeps: tuple[Sweep, ...] = ()
    """Conditions over which an evaluation can map success; the task then has a ``config`` and is made from one."""
    is_taken: bool = False
    """Whether an environment has taken it over."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """The task's configuration as plain data, for provenance."""

    @abstractmethod
    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add objects, contacts and sensors to the scene."""

    @abstractmethod
    def attach(self, simulation: BatchSimulation) -> None:
        """Take possession of the compiled scene."""

    @abstractmethod
    def reset(self, ids: Tensor, seed: int, episode: Tensor) -> Start:
        """Place the objects of robots ``ids`` (n,) for ``episode`` (n,) and say where the robots stand.

        All randomness comes from :func:`lowlevel.runs.draws.uniform` with ``seed`` and ``episode``. The robots
        have already been reset; the environment moves them and calls ``forward`` afterwards.
        """

    @abstractmethod
    def step(self, measured: Measurement, decision: Decision) -> Outcome:
        """Judge one control step."""

    @abstractmethod
    def observe(self, measured: Measurement, time_left: Tensor) -> dict[str, Tensor]:
        """What is seen of each of the :attr:`object_blocks`, in the pelvis frame, and the :attr:`added_blocks`.

        ``time_left`` (N,) is a share of the episode. Each value is (N, size of its block), in physical units.
        """

    @property
    @abstractmethod
    def stage(self) -> Tensor:
        """Number of stages that each robot has passed in its episode (N,) integers."""

    @abstractmethod
    def failures(self, fallen: Tensor) -> list[str]:
        """How each robot's episode would be classified if it ended now (N names), given who has ``fallen``
        (N,)."""

    def conditions(self) -> dict[str, Tensor]:
        """What was drawn for each robot's episode (N,), by name and unit; reports show it beside a failure."""
        return {}


def rows(count: int) -> Tensor:
    """Indices of all of ``count`` robots."""
    return torch.arange(count)
