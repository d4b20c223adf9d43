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
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.progress import Progress

from evaluation.reporting.reports import (
    METRICS_FILE,
    REPORT_FILE,
    check_output,
    metrics,
    render,
    write_metrics,
    write_results,
)
from evaluation.reporting.statistics import Figure, mean_figure
from evaluation.speed.measurements import (
    WINDOWS,
    measure_environment,
    measure_latency,
    measure_training,
    plain_rates,
    planner_rates,
    single_planner_rates,
)
from highlevel.registry import load_task
from lowlevel.control.controller import Controller, content_hash
from lowlevel.export import export_controller
from lowlevel.presets import PRESETS
from lowlevel.runs.command_line import command_line
from lowlevel.runs.processes import available_cores
from lowlevel.runs.progress import ProgressReport
from lowlevel.trainer import Trainer, TrainingConfig
from robots.errors import PilotError


@dataclass(frozen=True)
class Arguments:
    """Measure the speed of simulation, learning, controller and planner on this machine."""

    output: Path = Path("runs/evaluation/benchmark")
    """Folder for report.md and metrics.json; files of the same name there are replaced."""
    robots: int = PRESETS["simple"].environment.num_robots
    """Robots of the batched simulation."""
    planner_robots: int = 64
    """Robots of the batched planner environment."""
    cores: int = available_cores()
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
    with command_line("benchmark", "interrupted, nothing was written"):
        _run(parsed)


def _run(arguments: Arguments) -> None:
    for name in ("robots", "planner_robots", "cores", "seconds", "ticks", "updates"):
        if getattr(arguments, name) <= 0:
            raise PilotError(f"--{name.replace('_', '-')} must be positive")
    load_task(arguments.task)
    check_output(arguments.output)
    print(f"measuring on {arguments.cores} cores", flush=True)
    with tempfile.TemporaryDirectory() as folder, ProgressReport() as progress:
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


def measure_everything(arguments: Arguments, folder: Path, progress: Progress) -> tuple[dict[str, Figure], str]:
    """All figures, and the content hash of the controller, of random weights, that they belong to."""
    task = progress.add_task("training", total=6)

    def next_is(name: str) -> None:
        progress.update(task, description=name, advance=1)

    config = _training(arguments)
    torch.set_num_threads(arguments.cores)
    trainer = Trainer(config, folder)
    figures = measure_training(trainer, arguments.updates, "training")
    # The same task: what the map costs, and not what obstacles do.
    perceptive = Trainer(replace(config, network=PRESETS["vision"].network), folder)
    figures |= measure_training(perceptive, arguments.updates, "perceptive_training")
    next_is("environment")
    figures |= measure_environment(trainer.environment, arguments.seconds)
    next_is("plain environments")
    rates = plain_rates(config, arguments.cores, arguments.seconds)
    figures["plain_subproc_steps_per_second"] = mean_figure(rates, "1/s")
    next_is("controller")
    export_controller(trainer, folder / "controller")
    torch.set_num_threads(1)
    figures |= measure_latency(folder / "controller", arguments.ticks)
    next_is("planner")
    controller = Controller.load(folder / "controller")
    rates = planner_rates(arguments.task, controller, arguments.planner_robots, arguments.cores, arguments.seconds)
    figures["planner_decisions_per_second"] = mean_figure(rates, "1/s")
    next_is("single planners")
    rates = single_planner_rates(arguments.task, folder / "controller", arguments.cores, arguments.seconds)
    figures["planner_subproc_decisions_per_second"] = mean_figure(rates, "1/s")
    progress.update(task, advance=1)
    for ratio, (ours, baseline) in RATIOS.items():
        figures[ratio] = _ratio(figures[ours], figures[baseline])
    return figures, content_hash(folder / "controller")


def _training(arguments: Arguments) -> TrainingConfig:
    """The blind training with the benchmark's robots and cores, in its first stage without a gait prior."""
    config = PRESETS["simple"]
    environment = replace(config.environment, num_robots=arguments.robots, num_threads=arguments.cores)
    first = next(stage for stage in config.stages if stage.prior is None)
    return replace(config, environment=environment, stages=(first,))


RATIOS: dict[str, tuple[str, str]] = {
    "environment_over_plain_subproc": ("environment_steps_per_second", "plain_subproc_steps_per_second"),
    "training_over_physics": ("training_steps_per_second", "physics_steps_per_second"),
    "perceptive_training_over_physics": ("perceptive_training_steps_per_second", "physics_steps_per_second"),
    "planner_over_subproc": ("planner_decisions_per_second", "planner_subproc_decisions_per_second"),
}


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
    "training_steps_per_second": "training end to end, blind network",
    "training_update_share": "share of it spent in updates",
    "training_over_physics": "training, blind network, over physics alone",
    "perceptive_training_steps_per_second": "training end to end, perceptive network",
    "perceptive_training_update_share": "share of it spent in updates",
    "perceptive_training_over_physics": "training, perceptive network, over physics alone",
    "controller_tick_onnx_p50": "controller tick, one core, ONNX Runtime, median",
    "controller_tick_onnx_p99": "controller tick, one core, ONNX Runtime, 99th percentile",
    "controller_tick_torch_p50": "controller tick, one core, torch, median",
    "controller_tick_torch_p99": "controller tick, one core, torch, 99th percentile",
    "planner_decisions_per_second": "planner decisions, batched",
    "planner_subproc_decisions_per_second": "baseline: single robots in SubprocVecEnv",
    "planner_over_subproc": "planner over baseline",
}


def report_text(figures: dict[str, Figure], machine: dict[str, Any], arguments: Arguments) -> str:
    """``report.md``."""
    return render("speed", machine=machine, arguments=arguments, windows=WINDOWS, rows=_ROWS, figures=figures)


if __name__ == "__main__":
    main(sys.argv[1:])
