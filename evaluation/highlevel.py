"""``evaluate-highlevel``: how often a planner, or the scripted expert, completes a task, and why it fails."""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import torch
import tyro

from evaluation.protocols.conditions import CONDITIONS, condition_of
from evaluation.protocols.parallel import Run, Setting, run_all
from evaluation.protocols.policies import SCRIPTED, controller_for
from evaluation.protocols.sweeps import SweepResult, cells, sweep_figures, sweep_result, write_plots
from evaluation.reporting.plots import plot_bars
from evaluation.reporting.reports import (
    METRICS_FILE,
    REPORT_FILE,
    check_output,
    format_figure,
    markdown_table,
    metrics,
    render,
    write_json,
    write_metrics,
    write_results,
)
from evaluation.reporting.statistics import Figure, mean_figure, share_figure
from highlevel.episodes import EpisodeRecord
from highlevel.planner import planner_hash
from highlevel.registry import load_task
from highlevel.task import Task
from lowlevel.control.controller import content_hash
from lowlevel.runs.command_line import command_line
from lowlevel.runs.processes import available_cores
from lowlevel.runs.progress import ProgressReport
from lowlevel.world.randomization import RandomizationConfig
from robots.errors import PilotError
from robots.g1.model import ModelOptions, describe_foreign

EPISODES_FILE = "episodes.json"
LIFT_STAGE = "lift"
"""The stage whose passing counts as the partial success ``lift_up``, if a task has it."""
SHOWN_FAILURES = 20
"""Failed episodes that the report describes one by one."""
ROBOTS = 32
"""Robots side by side."""


@dataclass(frozen=True)
class Arguments:
    """Measure the success rate of a planner over fixed episodes."""

    planner: str
    """Planner folder, or "scripted" for the task's scripted expert."""
    task: str = "lift_box"
    """Name of the task."""
    controller: Path | None = None
    """Controller folder; by default the shipped one of the planner, and pilot-g1-simple for the expert."""
    robot: Path | None = None
    """MJCF of another model of the G1 to run on (docs/compare.md)."""
    condition: str = "nominal"
    """What the robot is like, a name of :data:`evaluation.protocols.conditions.CONDITIONS`: weak-waist (35 N m),
    late-40ms (targets), slippery (friction 0.4), other-gains (each off by up to 20 %) and so on."""
    episodes: int = 500
    """Episodes; episode i of a seed is the same for every planner."""
    seed: int = 0
    """Seed of the episodes."""
    controls: bool = False
    """Also run the task's negative controls, which must all fail."""
    control_episodes: int = 100
    """Episodes of each negative control."""
    sweeps: bool = False
    """Also map success over the conditions that the task names, such as mass and size."""
    sweep_episodes: int = 100
    """Episodes of each cell of a sweep."""
    output: Path = Path("runs/evaluation/highlevel")
    """Folder for report.md, metrics.json and plots; files of the same name there are replaced."""
    robots: int = ROBOTS
    """Robots side by side; the last digits of the figures depend on it."""
    threads: int = available_cores()
    """Threads to keep busy: of the physics, or, with controls or sweeps, of as many simulations."""


@dataclass(frozen=True)
class Evaluation:
    """Everything a report shows."""

    arguments: Arguments
    controller: str
    """Content hash."""
    planner: str | None
    """Content hash; None for the scripted expert."""
    stages: tuple[str, ...]
    records: list[EpisodeRecord]
    controls: dict[str, list[EpisodeRecord]]
    sweeps: list[SweepResult]
    seconds: float
    """Time the evaluation took [s]."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``evaluate-highlevel``."""
    parsed = tyro.cli(Arguments, args=arguments)
    with command_line("evaluate-highlevel", "interrupted, nothing was written"):
        _run(parsed)


def _run(arguments: Arguments) -> None:
    for name in ("episodes", "control_episodes", "sweep_episodes", "robots", "threads"):
        if getattr(arguments, name) < 1:
            raise PilotError(f"--{name.replace('_', '-')} must be at least 1")
    task = load_task(arguments.task)
    check_output(arguments.output)
    folder = controller_for(arguments.planner, arguments.controller)
    torch.set_num_threads(1)
    randomization_of(arguments.condition)
    print(f"evaluating {arguments.planner} on {task.name}, condition {arguments.condition}", flush=True)
    if arguments.robot is not None:
        print(describe_foreign(arguments.robot))
    evaluation = evaluate(arguments, folder)
    write_results(arguments.output, lambda output: write_report(output, evaluation))
    print(summary(evaluation))
    print(f"report: {arguments.output / REPORT_FILE}   figures: {arguments.output / METRICS_FILE}")


def evaluate(arguments: Arguments, controller: Path) -> Evaluation:
    """Run the episodes and, if wanted, negative controls and sweeps, each from the first episode of the seed on."""
    began = time.monotonic()
    task = load_task(arguments.task)
    if arguments.sweeps and not task.sweeps:
        raise PilotError(f"the task {task.name!r} has no sweeps: leave out --sweeps")
    names = control_names(task) if arguments.controls else ()
    sweeps = task.sweeps if arguments.sweeps else ()
    grids = [list(cells(task, sweep)) for sweep in sweeps]
    runs = [
        Run("episodes", task, arguments.episodes),
        *(Run(name.replace("_", " "), with_control(task, name), arguments.control_episodes) for name in names),
        *(
            Run(sweep.name.replace("_", " "), variant, arguments.sweep_episodes)
            for sweep, grid in zip(sweeps, grids, strict=True)
            for variant in grid
        ),
    ]
    setting = Setting(
        arguments.planner,
        controller,
        arguments.seed,
        arguments.robots,
        arguments.robot,
        randomization_of(arguments.condition),
    )
    with ProgressReport() as progress:
        bar = progress.add_task("episodes", total=sum(run.count for run in runs))
        results = run_all(
            runs,
            setting,
            arguments.threads,
            lambda name, over: progress.update(bar, completed=over, description=name),
        )
    remaining = iter(results)
    records = next(remaining)
    controls = {name: next(remaining) for name in names}
    swept = [sweep_result(sweep, [next(remaining) for _ in grid]) for sweep, grid in zip(sweeps, grids, strict=True)]
    identity = None if arguments.planner == SCRIPTED else planner_hash(arguments.planner)
    return Evaluation(
        arguments=arguments,
        controller=content_hash(controller),
        planner=identity,
        stages=task.stages,
        records=records,
        controls=controls,
        sweeps=swept,
        seconds=time.monotonic() - began,
    )


def randomization_of(condition: str) -> RandomizationConfig | None:
    """Of the robots under a ``condition``; None for what the model has.

    Raises:
        PilotError: if it is unknown or changes more than the robot's feet and motors.
    """
    chosen = condition_of(condition)
    if chosen == CONDITIONS["nominal"]:
        return None
    if chosen.push_speed > 0.0 or chosen.options != ModelOptions():
        raise PilotError(
            f"the condition {condition} is for evaluate-lowlevel alone: it changes more than feet and motors"
        )
    return chosen.randomization


def control_names(task: Task) -> tuple[str, ...]:
    """Names of a task's negative controls: the values of ``config.control`` beside ``none``.

    Raises:
        PilotError: if the task has no negative controls.
    """
    config: Any = getattr(task, "config", None)
    hint = get_type_hints(type(config)).get("control") if config is not None else None
    names = tuple(name for name in get_args(hint) if name != "none")
    if not names:
        raise PilotError(f"the task {task.name!r} has no negative controls: leave out --controls")
    return names


def with_control(task: Task, name: str) -> Task:
    """A fresh copy of ``task`` under a negative control."""
    config: Any = task.config  # type: ignore[attr-defined]
    factory: Any = type(task)
    controlled: Task = factory(replace(config, control=name))
    return controlled


# -- figures -------------------------------------------------------------------------------------------------


def success_figures(records: list[EpisodeRecord], stages: tuple[str, ...]) -> dict[str, Figure]:
    """``full``, ``lift_up``, ``fall_rate``, the share that passed each stage, time to success, and return."""
    figures = {
        "full": share_figure([record.success for record in records]),
        "fall_rate": share_figure([record.failure == "fall" for record in records]),
        "success_time": mean_figure([record.duration for record in records if record.success], "s"),
        "return": mean_figure([record.total_reward for record in records], "1"),
    }
    for number, stage in enumerate(stages, start=1):
        figures[f"stage_{stage}"] = share_figure([record.stage >= number for record in records])
    if LIFT_STAGE in stages:
        figures["lift_up"] = figures[f"stage_{LIFT_STAGE}"]
    return figures


def failure_figures(records: list[EpisodeRecord]) -> dict[str, Figure]:
    """Share of episodes that ended in each kind of failure, the most frequent first."""
    names = Counter(record.failure for record in records if record.failure is not None)
    return {name: share_figure([record.failure == name for record in records]) for name, _ in names.most_common()}


def all_figures(evaluation: Evaluation) -> dict[str, Figure]:
    """All figures of ``metrics.json``; those of a control end in its name."""
    figures = success_figures(evaluation.records, evaluation.stages)
    failures = failure_figures(evaluation.records)
    figures |= {f"failure_{name}": figure for name, figure in failures.items()}
    for control, records in evaluation.controls.items():
        controlled = success_figures(records, evaluation.stages)
        for name in ("full", "lift_up", "fall_rate"):
            if name in controlled:
                figures[f"{name}_{control}"] = controlled[name]
    return figures | sweep_figures(evaluation.sweeps)


# -- report --------------------------------------------------------------------------------------------------


def write_report(folder: Path, evaluation: Evaluation) -> None:
    """Write ``report.md``, plot, ``metrics.json`` and ``episodes.json`` into ``folder``."""
    arguments, figures = evaluation.arguments, all_figures(evaluation)
    stages = {stage: figures[f"stage_{stage}"] for stage in evaluation.stages}
    panels = {"share that passed a stage": stages | {"success": figures["full"]}}
    failures = failure_figures(evaluation.records)
    if failures:
        panels["share that failed by"] = failures
    plot_bars(folder / "stages.png", panels, columns=2)
    write_plots(folder, evaluation.sweeps)
    (folder / REPORT_FILE).write_text(report_text(evaluation, figures))
    write_json(folder / EPISODES_FILE, [asdict(record) for record in evaluation.records])
    content = metrics(
        figures,
        arguments.seed,
        evaluation.controller,
        evaluation.planner or SCRIPTED,
        task=arguments.task,
        condition=arguments.condition,
        seconds=round(evaluation.seconds, 1),
    )
    write_metrics(folder, content)


def summary(evaluation: Evaluation) -> str:
    """The headline in one line."""
    figures = all_figures(evaluation)
    parts = [f"full {format_figure(figures['full'])}"]
    if "lift_up" in figures:
        parts.append(f"lift-up {format_figure(figures['lift_up'])}")
    parts.append(f"falls {format_figure(figures['fall_rate'])}")
    return "  ".join([*parts, f"over {len(evaluation.records)} episodes"])


HEADLINE = {
    "full success": "full",
    "lift-up": "lift_up",
    "falls": "fall_rate",
    "time to success [s]": "success_time",
}
"""Label of the report to figure."""


def report_text(evaluation: Evaluation, figures: dict[str, Figure]) -> str:
    """``report.md``."""
    failed = [record for record in evaluation.records if record.failure is not None]
    failures = {
        name: (figure, [record.number for record in failed if record.failure == name])
        for name, figure in failure_figures(evaluation.records).items()
    }
    return render(
        "success",
        task=evaluation.arguments.task.replace("_", " ").capitalize(),
        seed=evaluation.arguments.seed,
        planner=evaluation.planner,
        controller=evaluation.controller,
        count=len(evaluation.records),
        robot=evaluation.arguments.robot,
        condition=evaluation.arguments.condition,
        headline=HEADLINE,
        stages=evaluation.stages,
        figures=figures,
        failures=failures,
        failed_episodes=_failed_episodes(failed[:SHOWN_FAILURES], evaluation.stages),
        controls={name: sum(record.success for record in records) for name, records in evaluation.controls.items()},
        sweeps=evaluation.sweeps,
    )


def _failed_episodes(failed: list[EpisodeRecord], stages: tuple[str, ...]) -> str:
    """A table with a line per failed episode: what it was like, and how far it came."""
    if not failed:
        return ""
    conditions = list(failed[0].conditions)
    rows = []
    for record in failed:
        times = [f"{time:.1f}" for time in record.stage_times]
        times += ["-"] * (len(stages) - len(times))
        what = [f"{record.conditions[name]:.2f}" for name in conditions]
        cause = str(record.failure).replace("_", " ")
        rows.append([str(record.number), *what, *times, f"{cause} at {record.duration:.1f}"])
    return markdown_table(["episode", *conditions, *(f"{stage} [s]" for stage in stages), "end [s]"], rows)


if __name__ == "__main__":
    main(sys.argv[1:])
