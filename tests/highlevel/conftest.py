"""Small environments on the untrained controller."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from highlevel.environment import ROBOT_BLOCKS, CommandEnvironment, PhysicsConfig
from highlevel.learning.config import PPOConfig
from highlevel.learning.demonstrations import Source
from highlevel.registry import load_task
from lowlevel.world.randomization import RandomizationConfig


@pytest.fixture
def coarse_physics() -> PhysicsConfig:
    """Cheap physics for tests of everything but physics."""
    return PhysicsConfig(timestep=0.005, solver_iterations=12, num_threads=1)


@pytest.fixture
def source() -> Source:
    """Where demonstrations of lift-box come from, by default."""
    task = load_task("lift_box")
    blocks = (*task.object_blocks, *ROBOT_BLOCKS, *task.added_blocks)
    return Source("lift_box", blocks, task.action, PPOConfig().discount, "0" * 16)


@pytest.fixture
def make_environment(untrained_controller: Path, coarse_physics: PhysicsConfig) -> Callable[..., CommandEnvironment]:
    torch.set_num_threads(1)

    def make(num_envs: int = 2, seed: int = 0, randomization: RandomizationConfig | None = None) -> CommandEnvironment:
        task = load_task("lift_box")
        return CommandEnvironment(task, untrained_controller, num_envs, seed, coarse_physics, randomization)

    return make
