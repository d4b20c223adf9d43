"""All robots as one Stable-Baselines3 ``VecEnv``: one native physics call and one policy call per control
step."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from highlevel.environment import CommandEnvironment
from highlevel.gym_env import spaces


class PlannerVecEnv(VecEnv):
    """Stable-Baselines3's view of a :class:`~highlevel.environment.CommandEnvironment`.

    Episodes end with the entries that Stable-Baselines3 knows (``terminal_observation``, ``episode``,
    ``is_success``, and ``TimeLimit.truncated``, which is never true because the time left is observed) and ``stage``
    and ``failure``.
    """

    def __init__(self, environment: CommandEnvironment) -> None:
        self.environment = environment
        self.render_mode = None
        observation_space, action_space = spaces(environment)
        super().__init__(environment.num_envs, observation_space, action_space)
        self._actions = torch.zeros(self.num_envs, *action_space.shape)
        self._return = np.zeros(self.num_envs)
        self._length = np.zeros(self.num_envs, dtype=int)
        self._began = time.monotonic()

    def reset(self) -> VecEnvObs:
        """Begin new episodes everywhere; a seed set by :meth:`seed` takes effect now, once."""
        seed = self._seeds[0]
        observation = self.environment.reset(seed)
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._return[:], self._length[:] = 0.0, 0
        self._reset_seeds()
        self._reset_options()
        return observation.numpy()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed of the next reset. One seed numbers the episodes of all robots."""
        if seed is None:
            seed = int(np.random.default_rng().integers(2**31))
        self._seeds = [seed] * self.num_envs
        return self._seeds

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = torch.as_tensor(np.asarray(actions, dtype=np.float32))

    def step_wait(self) -> VecEnvStepReturn:
        result = self.environment.step(self._actions)
        reward, done = result.reward.numpy(), result.done.numpy()
        self._return += reward
        self._length += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]  # wrappers write into them
        over = np.flatnonzero(done)
        if len(over):
            final, elapsed = result.final_observation.numpy(), time.monotonic() - self._began
            for robot in over.tolist():
                infos[robot] = {
                    "terminal_observation": final[robot],
                    "TimeLimit.truncated": False,
                    "is_success": bool(result.success[robot]),
                    "stage": int(result.final_stage[robot]),
                    "failure": result.failures.get(robot),
                    "episode": {
                        "r": float(self._return[robot]),
                        "l": int(self._length[robot]),
                        "t": round(elapsed, 6),
                    },
                }
            self._return[over], self._length[over] = 0.0, 0
        return result.observation.numpy(), reward, done, infos

    def close(self) -> None:
        """Nothing to close: the batch ends with the environment."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The same attribute of the shared environment for every robot asked about."""
        value = self.render_mode if attr_name == "render_mode" else getattr(self.environment, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the shared environment; it cannot differ between robots."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"{attr_name!r} is shared by all robots: set it without indices")
        setattr(self.environment, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method of the shared environment once and hand its result to every robot asked about."""
        result = getattr(self.environment, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """No robot has a wrapper of its own."""
        return [False for _ in self._get_indices(indices)]
