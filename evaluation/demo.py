"""``run-demo``: one autonomous episode, recorded for the rerun viewer or watched live."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro

from evaluation.pictures.recording import EpisodeRecording, Recorder
from evaluation.protocols.policies import SCRIPTED, controller_for, make_policy
from evaluation.reporting.reports import (
    REPORT_FILE,
    check_output,
    render,
    write_json,
    write_results,
)
from highlevel.action import interpolate
from highlevel.environment import CommandEnvironment, PhysicsConfig, StepResult
from highlevel.pictures.painter import NoOpenGLError, Painter, film_strip, following_camera, save_picture
from highlevel.pictures.visuals import VisualTwin
from highlevel.planner import planner_hash
from highlevel.registry import load_task
from highlevel.task import Decision, rows
from lowlevel.control.controller import content_hash
from lowlevel.runs.command_line import command_line
from lowlevel.runs.processes import available_cores
from lowlevel.runs.progress import ProgressReport
from lowlevel.world.measures import Measurement
from robots.errors import PilotError

RECORDING_FILE, OUTCOME_FILE, STRIP_FILE = "episode.rrd", "outcome.json", "stages.png"


@dataclass(frozen=True)
class Arguments:
    """Run one autonomous episode of a task and record it."""

    planner: str
    """Planner folder, or "scripted" for the task's scripted expert."""
    task: str = "lift_box"
    """Name of the task."""
    controller: Path | None = None
    """Controller folder; by default the shipped one of the planner, and pilot-g1-simple for the expert."""
    seed: int = 0
    """Seed of the episodes."""
    episode: int = 0
    """Number of the episode, as in an evaluation's report."""
    live: bool = False
    """Also show the episode in a rerun viewer while it runs."""
    pictures: bool = True
    """Also render a picture at the start, at every stage and at the end, and a strip of the stages, where OpenGL
    works."""
    output: Path = Path("runs/demo")
    """Folder for the recording, report.md and pictures; files of the same name there are replaced."""
    threads: int = available_cores()
    """Threads of the physics."""


@dataclass(frozen=True)
class EpisodeSummary:
    """How an episode went."""

    success: bool
    failure: str | None
    """Why it failed; None for a success."""
    duration: float
    """[s]"""
    stage_times: dict[str, float]
    """When each stage was passed [s]."""
    instants: dict[str, np.ndarray]
    """Coordinates of the scene at the start, at every stage and at the end."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``run-demo``."""
    parsed = tyro.cli(Arguments, args=arguments)
    with command_line("run-demo", "interrupted, nothing was written"):
        _run(parsed)


def _run(arguments: Arguments) -> None:
    if arguments.episode < 0 or arguments.threads < 1:
        raise PilotError("--episode must not be negative and --threads must be at least 1")
    load_task(arguments.task)
    check_output(arguments.output)
    folder = controller_for(arguments.planner, arguments.controller)
    torch.set_num_threads(1)
    print(f"running {arguments.planner} on {arguments.task}, episode {arguments.episode}", flush=True)
    summaries: list[EpisodeSummary] = []

    def write(output: Path) -> None:
        summary, twin = run_episode(arguments, folder, output / RECORDING_FILE)
        pictures = draw(twin, summary, output) if arguments.pictures else []
        (output / REPORT_FILE).write_text(report_text(arguments, summary, folder, pictures))
        outcome = {name: value for name, value in asdict(summary).items() if name != "instants"}
        write_json(output / OUTCOME_FILE, outcome | identities(arguments, folder))
        summaries.append(summary)

    write_results(arguments.output, write)
    print(outcome_text(summaries[0]))
    print(f"recording: {arguments.output / RECORDING_FILE}   report: {arguments.output / REPORT_FILE}")
    # It may lie in a virtual environment that is not active.
    print(f"watch it with: {Path(sys.executable).with_name('rerun')} {arguments.output / RECORDING_FILE}")


def run_episode(arguments: Arguments, controller: Path, recording: Path) -> tuple[EpisodeSummary, VisualTwin]:
    """Run the episode and write the ``recording``; also returns the scene's visual double."""
    control_steps = 0
    stage_times: dict[str, float] = {}
    instants: dict[str, np.ndarray] = {}

    def see(measured: Measurement, decision: Decision) -> None:
        nonlocal control_steps
        in_decision = control_steps % task.action.decision_steps + 1
        control_steps += 1
        seconds = control_steps * environment.control_period
        passed = int(task.stage[0])
        for stage in task.stages[len(stage_times) : passed]:
            stage_times[stage] = seconds
            instants[stage] = environment.simulation.robot_data(0).qpos.copy()
        elevation = environment.world.elevation(measured)
        fraction = in_decision / task.action.decision_steps
        film.add(
            time=seconds,
            simulation=environment.simulation,
            row=0,
            measured=measured,
            command=interpolate(decision.previous, decision.goal, fraction),
            gate=environment.controller.gate,
            elevation=elevation,
            stage=f"towards {task.stages[passed]}" if passed < len(task.stages) else "done",
        )

    task = load_task(arguments.task)
    physics = PhysicsConfig(num_threads=arguments.threads)
    environment = CommandEnvironment(task, controller, physics=physics)
    policy = make_policy(arguments.planner, environment, controller)
    observation = environment.reset(arguments.seed)
    for _ in range(arguments.episode):
        observation = environment.reset()
    policy.reset(rows(1))
    instants["start"] = environment.simulation.robot_data(0).qpos.copy()

    def add_surroundings(spec: mujoco.MjSpec) -> None:
        environment.world.terrain.add_to(spec)
        task.add_to(spec)

    twin = VisualTwin(add_surroundings)
    twin.adopt_sizes(environment.simulation, 0)
    result: StepResult | None = None
    with Recorder(recording, arguments.live) as recorder, ProgressReport() as progress:
        bar = progress.add_task("episode", total=environment.max_decisions)
        film = EpisodeRecording(recorder, twin, environment.controller.experts)
        while result is None or not bool(result.done[0]):
            result = environment.step(policy.act(observation), auto_reset=False, observers=(see,))
            observation = result.observation
            progress.update(bar, advance=1)
        progress.update(bar, completed=environment.max_decisions)
    instants["end"] = environment.simulation.robot_data(0).qpos.copy()
    summary = EpisodeSummary(
        success=bool(result.success[0]),
        failure=result.failures.get(0),
        duration=float(result.duration[0]),
        stage_times=stage_times,
        instants=instants,
    )
    return summary, twin


def draw(twin: VisualTwin, summary: EpisodeSummary, output: Path) -> list[str]:
    """Draw all instants, and those of the stages side by side; returns the names of the pictures.

    There are none if this machine cannot render.
    """
    names: list[str] = []
    stages: list[np.ndarray] = []
    try:
        with Painter(twin.model) as painter:
            for number, (instant, position) in enumerate(summary.instants.items()):
                twin.data.qpos[:] = position
                mujoco.mj_forward(twin.model, twin.data)
                pixels = painter.draw(twin.data, following_camera(twin.model, twin.data))
                names.append(f"{number}_{instant}.png")
                save_picture(output / names[-1], pixels)
                if instant in summary.stage_times:
                    stages.append(pixels)
        if stages:
            names.insert(0, STRIP_FILE)
            save_picture(output / STRIP_FILE, film_strip(stages))
    except NoOpenGLError as error:
        print(error)
    return names


def identities(arguments: Arguments, controller: Path) -> dict[str, str | int]:
    """What made the episode."""
    scripted = arguments.planner == SCRIPTED
    return {
        "task": arguments.task,
        "seed": arguments.seed,
        "episode": arguments.episode,
        "controller": content_hash(controller),
        "planner": SCRIPTED if scripted else planner_hash(arguments.planner),
    }


def outcome_text(summary: EpisodeSummary) -> str:
    """The outcome in one line."""
    if summary.success:
        return f"success after {summary.duration:.1f} s"
    last = f"after the stage {list(summary.stage_times)[-1]!r}" if summary.stage_times else "before the first stage"
    return f"failure ({summary.failure}) after {summary.duration:.1f} s, {last}"


def report_text(arguments: Arguments, summary: EpisodeSummary, controller: Path, pictures: list[str]) -> str:
    """``report.md``."""
    return render(
        "demo",
        task=arguments.task.replace("_", " ").capitalize(),
        outcome=outcome_text(summary),
        made_by=identities(arguments, controller),
        recording=RECORDING_FILE,
        stage_times=summary.stage_times,
        pictures=pictures,
    )


if __name__ == "__main__":
    main(sys.argv[1:])
