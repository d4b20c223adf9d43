"""``benchmark``: how fast everything is here, beside baselines that are measured in the same run.

A control step is one robot advanced by 0.02 s. The baseline of the simulation is Stable-Baselines3's
``SubprocVecEnv`` with one plain MuJoCo environment per core, which steps the same physics and only copies
positions and velocities, and so does less than the environment that it is compared with. The baseline of the
planner is ``SubprocVecEnv`` over single robots of the very same task.
"""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
import tyro
from rich.progress import Progress
from stable_baselines3.common.vec_env import SubprocVecEnv

from evaluation.baseline import PlainMujocoEnv
from evaluation.reports import (
    METRICS_FILE,
    REPORT_FILE,
    check_output,
    format_figure,
    markdown_table,
    metrics,
    progress_bar,
    run_command,
    write_metrics,
    write_results,
)
from evaluation.statistics import Figure, mean_figure, quantile_figure
from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.gym_env import PlannerEnv
from highlevel.task import load_task
from highlevel.vec_env import PlannerVecEnv
from lowlevel.controller import ONNX_FILE, Controller, Proprioception, content_hash
from lowlevel.environment import PilotEnvironment
from lowlevel.export import freeze
from lowlevel.presets import PRESETS
from lowlevel.terrain import MAP_SIZE
from lowlevel.trainer import Trainer, TrainingConfig
from robots.g1.constants import NUM_JOINTS

WINDOWS = 5
"""Measurements per rate; their spread gives the interval."""


@dataclass(frozen=True)
class Arguments:
    """Measure the speed of simulation, learning, controller and planner on this machine."""

    output: Path = Path("runs/evaluation/benchmark")
    """Folder for report.md and metrics.json; files of an earlier report there are replaced."""
    robots: int = PRESETS["flat"].environment.num_robots
    """Robots of the batched simulation."""
    planner_robots: int = 64
    """Robots of the batched planner environment."""
    cores: int = os.cpu_count() or 1
    """Physics threads, and processes of the baselines."""
    seconds: float = 10.0
    """Time per measured rate [s]; the whole benchmark takes about ten times as long."""
    ticks: int = 2000
    """Control steps of the latency measurement."""
    updates: int = 3
    """Training iterations."""
    task: str = "lift_box"
    """Task of the planner figures."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``benchmark``."""
    parsed = tyro.cli(Arguments, args=arguments)
    run_command("benchmark", lambda: _run(parsed))


def _run(arguments: Arguments) -> None:
    for name in ("robots", "planner_robots", "cores", "seconds", "ticks", "updates"):
        if getattr(arguments, name) <= 0:
            raise ValueError(f"--{name.replace('_', '-')} must be positive")
    load_task(arguments.task)
    check_output(arguments.output)
    print(f"measuring on {arguments.cores} cores", flush=True)
    with tempfile.TemporaryDirectory() as folder, progress_bar() as progress:
        figures, identity = measure_everything(arguments, Path(folder), progress)
    machine = describe_machine(arguments.cores)
    content = metrics(figures, seed=0, controller=identity, machine=machine, settings=_settings(arguments))
    text = report_text(figures, machine, arguments)

    def write(folder: Path) -> None:
        (folder / REPORT_FILE).write_text(text)
        write_metrics(folder, content)

    write_results(arguments.output, write)
    print(text)
    print(f"report: {arguments.output / REPORT_FILE}   figures: {arguments.output / METRICS_FILE}")


def measure_everything(
    arguments: Arguments, folder: Path, progress: Progress
) -> tuple[dict[str, Figure], str]:
    """All figures, and the content hash of the controller, of random weights, that they belong to."""
    task = progress.add_task("training", total=6)

    def next_is(name: str) -> None:
        progress.update(task, description=name, advance=1)

    flat = PRESETS["flat"]
    config = replace(
        flat, environment=replace(flat.environment, num_robots=arguments.robots, num_threads=arguments.cores)
    )
    torch.set_num_threads(arguments.cores)
    figures, trainer = measure_training(config, folder, arguments.updates)
    next_is("environment")
    figures |= measure_environment(trainer.environment, arguments.seconds)
    next_is("plain environments")
    rates = plain_rates(config, arguments.cores, arguments.seconds)
    figures["plain_subproc_steps_per_second"] = mean_figure(rates, "1/s")
    next_is("controller")
    freeze(trainer).save(folder / "controller")
    torch.set_num_threads(1)
    controller = Controller.load(folder / "controller")
    figures |= measure_latency(controller, folder / "controller" / ONNX_FILE, arguments.ticks)
    next_is("planner")
    rates = planner_rates(controller, arguments)
    figures["planner_decisions_per_second"] = mean_figure(rates, "1/s")
    next_is("single planners")
    rates = single_planner_rates(folder / "controller", arguments)
    figures["planner_subproc_decisions_per_second"] = mean_figure(rates, "1/s")
    progress.update(task, advance=1)
    for ratio, (ours, baseline) in RATIOS.items():
        figures[ratio] = _ratio(figures[ours], figures[baseline])
    return figures, content_hash(folder / "controller")


RATIOS: dict[str, tuple[str, str]] = {
    "environment_over_plain_subproc": ("environment_steps_per_second", "plain_subproc_steps_per_second"),
    "planner_over_subproc": ("planner_decisions_per_second", "planner_subproc_decisions_per_second"),
}


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


def measure_training(config: TrainingConfig, folder: Path, updates: int) -> tuple[dict[str, Figure], Trainer]:
    """End-to-end training with the full network, and the trainer."""
    trainer = Trainer(config, folder)
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
        "training_steps_per_second": mean_figure(rates, "1/s"),
        "training_update_share": mean_figure(shares, "1"),
    }, trainer


class _TimedSimulation:
    """A simulation that adds up the time spent in physics."""

    def __init__(self, simulation: Any) -> None:
        self._simulation = simulation
        self.seconds = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._simulation, name)

    def step(self, targets: torch.Tensor) -> None:
        began = time.perf_counter()
        self._simulation.step(targets)
        self.seconds += time.perf_counter() - began


def measure_environment(environment: PilotEnvironment, seconds: float) -> dict[str, Figure]:
    """The environment with zero actions, and physics alone as seen from within it."""
    count = environment.num_robots
    action = torch.zeros(count, NUM_JOINTS)
    simulation = environment.simulation
    timed = _TimedSimulation(simulation)
    environment.simulation = timed  # type: ignore[assignment]

    def step() -> int:
        environment.step(action)
        return count

    environment_rates, physics_rates, shares = [], [], []
    try:
        for _ in range(WINDOWS):
            step()
            timed.seconds, done, began = 0.0, 0, time.perf_counter()
            while (elapsed := time.perf_counter() - began) < seconds / WINDOWS or not done:
                done += step()
            environment_rates.append(done / elapsed)
            physics_rates.append(done / timed.seconds)
            shares.append(1.0 - timed.seconds / elapsed)
    finally:
        environment.simulation = simulation
    return {
        "physics_steps_per_second": mean_figure(physics_rates, "1/s"),
        "environment_steps_per_second": mean_figure(environment_rates, "1/s"),
        "environment_python_share": mean_figure(shares, "1"),
    }


def plain_rates(config: TrainingConfig, processes: int, seconds: float) -> list[float]:
    """Control steps per second of one plain environment per process."""
    environment = config.environment
    make = partial(PlainMujocoEnv, environment.gains, environment.timestep, environment.decimation)
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


def measure_latency(controller: Controller, onnx: Path, ticks: int) -> dict[str, Figure]:
    """One robot on one core: a whole control step in torch, and the policy network alone in both runtimes."""
    space = controller.config.command_space
    state = Proprioception(
        torch.tensor(controller.config.default_position)[None],
        torch.zeros(1, NUM_JOINTS),
        torch.zeros(1, 3),
        torch.tensor([[0.0, 0.0, -1.0]]),
    )
    elevation, command, flag = torch.full((1, MAP_SIZE), 0.76), space.neutral()[None], torch.ones(1, 1)
    controller.reset(1)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(onnx), options, providers=["CPUExecutionProvider"])
    history = torch.randn(1, controller.actor.sizes.history, generator=torch.Generator().manual_seed(0))
    inputs = {"history": history.numpy(), "elevation_map": elevation.numpy(), "flag": flag.numpy()}
    wanted = {value.name for value in session.get_inputs()}
    inputs = {name: value for name, value in inputs.items() if name in wanted}

    def network() -> None:
        with torch.no_grad():
            controller.actor(history, elevation, flag)

    measured = {
        "controller_tick": lambda: controller.act(state, elevation, command, flag),
        "network_torch": network,
        "network_onnx": lambda: session.run(["action"], inputs),
    }
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


def planner_rates(controller: Controller, arguments: Arguments) -> list[float]:
    """Decisions per second of the batched environment."""
    physics = PhysicsConfig(num_threads=arguments.cores)
    environment = CommandEnvironment(
        load_task(arguments.task), controller, arguments.planner_robots, physics=physics
    )
    batched = PlannerVecEnv(environment)
    batched.seed(0)
    batched.reset()
    action = np.zeros((arguments.planner_robots, *batched.action_space.shape), dtype=np.float32)  # type: ignore[misc]

    def step() -> int:
        batched.step(action)
        return arguments.planner_robots

    return window_rates(step, arguments.seconds)


def single_planner(task: str, controller: Path) -> PlannerEnv:
    """One robot on one thread, for a process of its own."""
    torch.set_num_threads(1)
    return PlannerEnv(task, controller)


def single_planner_rates(controller: Path, arguments: Arguments) -> list[float]:
    """Decisions per second of one single environment per process."""
    make = partial(single_planner, arguments.task, controller)
    return _subproc_rates([make] * arguments.cores, arguments.seconds)


# -- report --------------------------------------------------------------------------------------------------


def _ratio(ours: Figure, baseline: Figure) -> Figure:
    assert ours.value is not None and baseline.value is not None
    return Figure(ours.value / baseline.value, "1", None, min(ours.n, baseline.n))


def _settings(arguments: Arguments) -> dict[str, Any]:
    return {name: value for name, value in asdict(arguments).items() if name != "output"}


def describe_machine(cores: int) -> dict[str, Any]:
    """Processor, cores used, and the versions that decide the speed."""
    processor = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.is_file():
        names = [line for line in information.read_text().splitlines() if line.startswith("model name")]
        processor = names[0].partition(":")[2].strip() if names else processor
    packages = ("torch", "mujoco", "numpy", "stable-baselines3", "onnxruntime")
    return {
        "processor": processor,
        "cores": cores,
        "cores_present": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in packages},
    }


_ROWS = {
    "physics_steps_per_second": "physics alone, batched",
    "environment_steps_per_second": "low-level environment, batched",
    "environment_python_share": "share of an environment step outside physics",
    "plain_subproc_steps_per_second": "baseline: plain MuJoCo environments in SubprocVecEnv",
    "environment_over_plain_subproc": "environment over baseline",
    "training_steps_per_second": "training end to end, full network",
    "training_update_share": "share of training spent in updates",
    "controller_tick_p50": "controller tick, one core, median",
    "controller_tick_p99": "controller tick, one core, 99th percentile",
    "network_torch_p50": "policy network, torch, median",
    "network_torch_p99": "policy network, torch, 99th percentile",
    "network_onnx_p50": "policy network, onnxruntime, median",
    "network_onnx_p99": "policy network, onnxruntime, 99th percentile",
    "planner_decisions_per_second": "planner decisions, batched",
    "planner_subproc_decisions_per_second": "baseline: single robots in SubprocVecEnv",
    "planner_over_subproc": "planner over baseline",
}


def report_text(figures: dict[str, Figure], machine: dict[str, Any], arguments: Arguments) -> str:
    """``report.md``."""
    rows = []
    for name, meaning in _ROWS.items():
        figure = figures[name]
        digits = 0 if (figure.value or 0.0) >= 100.0 else 2
        unit = "" if figure.unit == "1" else figure.unit
        rows.append([meaning, format_figure(figure, digits), unit, name])
    return "\n".join(
        [
            "# Speed",
            "",
            f"{machine['processor']}, {arguments.cores} of {machine['cores_present']} cores; "
            f"{arguments.robots} robots, planner {arguments.planner_robots} robots. Rates are means of "
            f"{WINDOWS} windows of {arguments.seconds / WINDOWS:g} s with 95 % bootstrap intervals. A "
            "control step is one robot advanced by 0.02 s; a decision is five of them.",
            "",
            markdown_table(["quantity", "value", "unit", "figure"], rows),
        ]
    )


if __name__ == "__main__":
    main(sys.argv[1:])
