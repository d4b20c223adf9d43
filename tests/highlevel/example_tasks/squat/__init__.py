"""The smallest task: sink to a height that is drawn for every episode. No objects, one stage."""

from __future__ import annotations

from typing import Any

import mujoco
import torch
from torch import Tensor

from highlevel.action import ActionConfig
from highlevel.environment import CommandEnvironment
from highlevel.task import Decision, ObservationBlock, Outcome, Start, Task
from lowlevel.commands import HEIGHT
from lowlevel.runs.draws import uniform
from lowlevel.world.measures import Measurement
from lowlevel.world.simulation import BatchSimulation

TOLERANCE = 0.03
"""Largest distance from the wanted height that counts as reached [m]."""


class Squat(Task):
    """Bring the pelvis to the wanted height."""

    name = "squat"
    stages = ("low",)
    action = ActionConfig()
    episode_length = 3.0
    fall_penalty = -5.0
    object_blocks = ()
    added_blocks = (ObservationBlock("wanted_height", 1, 0.1),)

    def describe(self) -> dict[str, Any]:
        return {"tolerance": TOLERANCE}

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Nothing but the robot."""

    def attach(self, simulation: BatchSimulation) -> None:
        count = simulation.num_robots
        self.wanted = torch.zeros(count)
        self.reached = torch.zeros(count, dtype=torch.bool)

    def reset(self, ids: Tensor, seed: int, episode: Tensor) -> Start:
        drawn = uniform(seed, episode, 0, 2)
        self.wanted[ids] = 0.6 + 0.05 * drawn[:, 0]
        self.reached[ids] = False
        return Start(position=torch.zeros(len(ids), 2), heading=2.0 * torch.pi * drawn[:, 1])

    def step(self, measured: Measurement, decision: Decision) -> Outcome:
        error = (measured.base_height - self.wanted).abs()
        self.reached = error < TOLERANCE
        return Outcome(reward=-error, success=self.reached, failure=torch.zeros_like(self.reached))

    def observe(self, measured: Measurement, time_left: Tensor) -> dict[str, Tensor]:
        return {"wanted_height": self.wanted[:, None]}

    @property
    def stage(self) -> Tensor:
        return self.reached.long()

    def failures(self, fallen: Tensor) -> list[str]:
        return ["fall" if fell else "too_high" for fell in fallen.tolist()]


class SquatExpert:
    """Commands the wanted height and nothing else."""

    def __init__(self, environment: CommandEnvironment) -> None:
        assert isinstance(environment.task, Squat)
        self._environment, self._task = environment, environment.task

    def act(self, observation: Tensor) -> Tensor:
        command = self._environment.controller.command_space.neutral().repeat(len(observation), 1)
        command[:, HEIGHT] = self._task.wanted
        return self._environment.action_map.action(command)

    def reset(self, ids: Tensor) -> None:
        """It remembers nothing."""


TASK, EXPERT = Squat, SquatExpert
