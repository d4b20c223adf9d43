"""One robot as a Gymnasium environment: the planner's decision is the step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.registry import find_controller, load_task
from highlevel.task import Task
from lowlevel.commands import COMMAND_SIZE
from lowlevel.control.controller import Controller
from robots.errors import PilotError


def spaces(environment: CommandEnvironment) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Observation and action space of one robot, both float32."""
    observation = gymnasium.spaces.Box(-np.inf, np.inf, (environment.observation_size,), np.float32)
    return observation, gymnasium.spaces.Box(-1.0, 1.0, (COMMAND_SIZE,), np.float32)


class PlannerEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task on one robot under the frozen controller.

    Args:
        task: name of a task, or a task.
        controller: folder of the controller, or a controller; pilot-g1-simple by default.
        physics: accuracy and threads.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's interface)

    def __init__(
        self,
        task: str | Task,
        controller: Controller | Path | str | None = None,
        physics: PhysicsConfig | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            raise PilotError("this environment does not render: record an episode with run-demo instead")
        self.render_mode = None
        self.environment = CommandEnvironment(
            load_task(task) if isinstance(task, str) else task,
            controller if isinstance(controller, Controller) else find_controller(controller),
            physics=PhysicsConfig(num_threads=1) if physics is None else physics,
        )
        self.observation_space, self.action_space = spaces(self.environment)
        self._is_over = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin the first episode of ``seed``, or the next episode; without any seed so far, of a random one."""
        super().reset(seed=seed)
        if seed is None and self.environment.measured is None:
            # Workers that nobody seeds must not all run the same episodes.
            seed = int(self.np_random.integers(2**31))
        observation = self.environment.reset(seed)
        self._is_over = False
        return observation[0].numpy(), {"episode_number": int(self.environment.episode[0])}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One decision of 0.1 s. Nothing is ever truncated: running out of time, which is observed, terminates."""
        if self._is_over:
            raise RuntimeError("the episode is over: call reset() before step()")
        action_tensor = torch.as_tensor(np.asarray(action, dtype=np.float32))[None]
        result = self.environment.step(action_tensor, auto_reset=False)
        self._is_over = bool(result.done[0])
        info: dict[str, Any] = {"stage": int(result.final_stage[0])}
        if self._is_over:
            info["is_success"] = bool(result.success[0])
            info["failure"] = result.failures.get(0)
        return (
            result.final_observation[0].numpy(),
            float(result.reward[0]),
            self._is_over,
            False,
            info,
        )
