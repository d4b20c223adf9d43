"""One robot as a Gymnasium environment: the planner's decision is the step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch

from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.pictures.painter import Painter, following_camera
from highlevel.pictures.visuals import VisualTwin
from highlevel.registry import find_controller, load_task
from highlevel.task import Task
from lowlevel.commands import COMMAND_SIZE
from lowlevel.control.controller import Controller
from lowlevel.runs.draws import require_seed

PICTURE_SIZE = (640, 480)
"""Width and height of rendered pictures [pixels]."""


def spaces(environment: CommandEnvironment) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Observation and action space of one robot, both float32."""
    observation = gymnasium.spaces.Box(-np.inf, np.inf, (environment.observation_size,), np.float32)
    return observation, gymnasium.spaces.Box(-1.0, 1.0, (COMMAND_SIZE,), np.float32)


class PlannerEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task on one robot under the frozen controller.

    Every step's info holds the "stage" reached and whether the episode "is_success" by then; the last one's also the
    "failure", None for a success.

    Args:
        task: name of a task, or a task.
        controller: folder of the controller, or a controller; pilot-g1-simple by default.
        physics: accuracy and threads.
        render_mode: "rgb_array", or None for no pictures.

    Raises:
        TypeError: if the render mode is another one.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's interface)

    def __init__(
        self,
        task: str | Task,
        controller: Controller | Path | str | None = None,
        physics: PhysicsConfig | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise TypeError(f"there is no render mode {render_mode!r}: it must be 'rgb_array' or None")
        self.render_mode = render_mode
        self.environment = CommandEnvironment(
            load_task(task) if isinstance(task, str) else task,
            controller if isinstance(controller, Controller) else find_controller(controller),
            physics=PhysicsConfig(num_threads=1) if physics is None else physics,
        )
        self.observation_space, self.action_space = spaces(self.environment)
        self._is_over = True
        self._picture: tuple[VisualTwin, Painter] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin the first episode of ``seed``, or the next episode; without any seed so far, of a random one.

        Raises:
            ValueError: if there are ``options``, of which it has none.
            PilotError: if the seed is negative or above 2^63 - 1.
        """
        if options:
            raise ValueError(f"there is no option {next(iter(options))!r} to reset with")
        if seed is not None:
            require_seed(seed)
        super().reset(seed=seed)
        if seed is None and self.environment.measured is None:
            # Workers that nobody seeds must not all run the same episodes.
            seed = int(self.np_random.integers(2**31))
        observation = self.environment.reset(seed)
        self._is_over = False
        return observation[0].numpy(), {"episode_number": int(self.environment.episode[0])}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One decision of 0.1 s. Nothing is ever truncated: running out of time, which is observed, terminates.

        Raises:
            RuntimeError: if the episode is over.
            ValueError: if the action has another shape, or is not finite.
        """
        if self._is_over:
            raise RuntimeError("the episode is over: call reset() before step()")
        numbers = np.asarray(action, dtype=np.float32)
        if numbers.shape != self.action_space.shape:
            raise ValueError(f"the action has the shape {numbers.shape}, but it must be {self.action_space.shape}")
        result = self.environment.step(torch.as_tensor(numbers)[None], auto_reset=False)
        self._is_over = bool(result.done[0])
        info: dict[str, Any] = {"stage": int(result.final_stage[0]), "is_success": bool(result.success[0])}
        if self._is_over:
            info["failure"] = result.failures.get(0)
        return (
            result.final_observation[0].numpy(),
            float(result.reward[0]),
            self._is_over,
            False,
            info,
        )

    def render(self) -> np.ndarray | None:
        """The scene as it is now (480, 640, 3), 8 bits per color; None without a render mode.

        Raises:
            NoOpenGLError: if this machine cannot render.
        """
        if self.render_mode is None:
            return None
        simulation = self.environment.simulation
        if self._picture is None:
            twin = VisualTwin(self.environment.task.add_to)
            self._picture = twin, Painter(twin.model, *PICTURE_SIZE)
        twin, painter = self._picture
        twin.adopt_sizes(simulation, 0)
        twin.follow(simulation, 0)
        mujoco.mj_forward(twin.model, twin.data)
        return painter.draw(twin.data, following_camera(twin.model, twin.data))

    def close(self) -> None:
        """Free what pictures took."""
        if self._picture is not None:
            self._picture[1].close()
            self._picture = None
