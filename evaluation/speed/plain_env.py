"""A plain single-robot MuJoCo environment, as one would write it first: the yardstick of the speed table."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np

from lowlevel.control.observation import CONTROL_PERIOD
from robots.g1.constants import DEFAULT_POSITION, NUM_JOINTS, gain_set
from robots.g1.model import ModelOptions, build_spec


class PlainMujocoEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Joint targets around the default pose in, positions and velocities out; no reward, no randomization.

    Args:
        gains: gain set of the actuators.
        timestep: physics step [s].
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's interface)

    def __init__(self, gains: str, timestep: float) -> None:
        self._model = build_spec(ModelOptions(gains=gain_set(gains), timestep=timestep)).compile()
        self._data = mujoco.MjData(self._model)
        self._decimation = round(CONTROL_PERIOD / timestep)
        size = self._model.nq + self._model.nv
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (NUM_JOINTS,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Stand upright in the default pose."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:7] = [0.0, 0.0, 0.78, 1.0, 0.0, 0.0, 0.0]
        self._data.qpos[7:] = DEFAULT_POSITION
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step; the episode ends when the robot is down."""
        self._data.ctrl[:] = DEFAULT_POSITION + 0.25 * action
        mujoco.mj_step(self._model, self._data, nstep=self._decimation)
        return self._observe(), 0.0, bool(self._data.qpos[2] < 0.4), False, {}

    def _observe(self) -> np.ndarray:
        return np.concatenate([self._data.qpos, self._data.qvel]).astype(np.float32)
