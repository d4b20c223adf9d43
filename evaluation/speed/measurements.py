"""Measurements of the speed table: every function sets something up, runs it for a while, and returns figures."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import SubprocVecEnv

from evaluation.reporting.statistics import Figure, mean_figure, quantile_figure
from evaluation.speed.plain_env import PlainMujocoEnv
from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.gym_env import PlannerEnv
from highlevel.registry import load_task
from highlevel.vec_env import PlannerVecEnv
from lowlevel.control.controller import Controller, Proprioception
from lowlevel.control.elevation_map import MAP_SIZE
from lowlevel.environment import PilotEnvironment
from lowlevel.trainer import Trainer, TrainingConfig
from robots.g1.constants import NUM_JOINTS

WINDOWS = 5
"""Measurements per rate; their spread gives the interval."""


def window_rates(step: Callable[[], int], seconds: float, windows: int = WINDOWS) -> list[float]:
    """Units of work per second in each window, after one warm-up; ``step`` returns its units."""
    step()
    rates = []
    for _ in range(windows):
        began, done = time.perf_counter(), 0
        while (elapsed := time.perf_counter() - began) < seconds / windows or not done:
            done += step()
        rates.append(done / elapsed)
    return rates


# -- low level -----------------------------------------------------------------------------------------------


def measure_training(trainer: Trainer, updates: int, name: str) -> dict[str, Figure]:
    """End-to-end training, as figures that begin with ``name``."""
    trainer.observation = trainer.environment.reset(spread_episodes=True)
    trainer.iterate()
    rates, shares = [], []
    for _ in range(updates):
        began, before = time.perf_counter(), trainer.steps
        collected = trainer.iterate()["speed/collection_seconds"]
        elapsed = time.perf_counter() - began
        rates.append((trainer.steps - before) / elapsed)
        shares.append(1.0 - collected / elapsed)
    return {
        f"{name}_steps_per_second": mean_figure(rates, "1/s"),
        f"{name}_update_share": mean_figure(shares, "1"),
    }


def measure_environment(environment: PilotEnvironment, seconds: float) -> dict[str, Figure]:
    """The environment with zero actions, physics steps alone as seen from within it, and what is not MuJoCo's."""
    count = environment.num_robots
    action = torch.zeros(count, NUM_JOINTS)
    simulation = environment.simulation

    def step() -> int:
        environment.step(action)
        return count

    environment_rates, physics_rates, shares = [], [], []
    for _ in range(WINDOWS):
        step()
        stepped, reset = simulation.step_seconds, simulation.reset_seconds
        done, began = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < seconds / WINDOWS or not done:
            done += step()
        stepping, resetting = simulation.step_seconds - stepped, simulation.reset_seconds - reset
        environment_rates.append(done / elapsed)
        physics_rates.append(done / stepping)
        shares.append(1.0 - (stepping + resetting) / elapsed)
    return {
        "physics_steps_per_second": mean_figure(physics_rates, "1/s"),
        "environment_steps_per_second": mean_figure(environment_rates, "1/s"),
        "environment_python_share": mean_figure(shares, "1"),
    }


def plain_rates(config: TrainingConfig, processes: int, seconds: float) -> list[float]:
    """Control steps per second of one plain environment per process."""
    environment = config.environment
    make = partial(PlainMujocoEnv, environment.gains, environment.timestep)
    return _subproc_rates([make] * processes, seconds)


def _subproc_rates(makers: list[Callable[[], Any]], seconds: float) -> list[float]:
    environments = SubprocVecEnv(makers)
    try:
        environments.reset()
        action = np.zeros((len(makers), *environments.action_space.shape), dtype=np.float32)  # type: ignore[misc]

        def step() -> int:
            environments.step(action)
            return len(makers)

        return window_rates(step, seconds)
    finally:
        environments.close()


def measure_latency(folder: Path, ticks: int) -> dict[str, Figure]:
    """A control step of one robot on one core, in both runtimes."""
    measured: dict[str, Callable[[], object]] = {}
    for runtime in ("torch", "onnx"):
        controller = Controller.load(folder, runtime=runtime)
        controller.reset(1)
        state = Proprioception(
            torch.tensor(controller.config.default_position)[None],
            torch.zeros(1, NUM_JOINTS),
            torch.zeros(1, 3),
            torch.tensor([[0.0, 0.0, -1.0]]),
        )
        command = controller.command_space.neutral()[None]
        elevation = torch.full((1, MAP_SIZE), 0.76)
        measured[f"controller_tick_{runtime}"] = partial(controller.act, state, elevation, command, torch.ones(1, 1))
    figures = {}
    for name, call in measured.items():
        for _ in range(20):
            call()
        latencies = []
        for _ in range(ticks):
            began = time.perf_counter()
            call()
            latencies.append(1e3 * (time.perf_counter() - began))
        figures[f"{name}_p50"] = quantile_figure(latencies, 0.50, "ms")
        figures[f"{name}_p99"] = quantile_figure(latencies, 0.99, "ms")
    return figures


# -- high level ----------------------------------------------------------------------------------------------


def planner_rates(task: str, controller: Controller, robots: int, cores: int, seconds: float) -> list[float]:
    """Decisions per second of the batched environment, with actions of zero."""
    physics = PhysicsConfig(num_threads=cores)
    batched = PlannerVecEnv(CommandEnvironment(load_task(task), controller, robots, physics=physics))
    batched.seed(0)
    batched.reset()
    action = np.zeros((robots, *batched.action_space.shape), dtype=np.float32)  # type: ignore[misc]

    def step() -> int:
        batched.step(action)
        return robots

    return window_rates(step, seconds)


def single_planner(task: str, controller: Path) -> PlannerEnv:
    """One robot on one thread, for a process of its own."""
    torch.set_num_threads(1)
    return PlannerEnv(task, controller)


def single_planner_rates(task: str, controller: Path, processes: int, seconds: float) -> list[float]:
    """Decisions per second of one single environment per process, with actions of zero."""
    return _subproc_rates([partial(single_planner, task, controller)] * processes, seconds)
