"""``evaluate-lowlevel``: the paper's table of tracking errors for one frozen controller."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro

from evaluation.baselines.onnx_policy import load_controller, load_controllers
from evaluation.protocols.arena import BATCH, Arena, batch_steps
from evaluation.protocols.conditions import condition_of
from evaluation.protocols.fairness import common_supports, require_common
from evaluation.protocols.skills import EPISODES as SKILL_EPISODES
from evaluation.protocols.skills import FLAT, SKILLS, run_skills, skill_episodes
from evaluation.protocols.suites import suite_of
from evaluation.protocols.tracking import (
    WALK_EPISODES,
    mode_episodes,
    motion_modes,
    run_modes,
    run_walking,
    tracking_figures,
    walking_episodes,
)
from evaluation.reporting.reports import (
    METRICS_FILE,
    REPORT_FILE,
    check_output,
    write_results,
)
from evaluation.tracking_report import Evaluation, Measured, summary, write_report
from lowlevel.control.whole_body import Supports, WholeBodyController
from lowlevel.runs.command_line import command_line
from lowlevel.runs.processes import available_cores
from lowlevel.runs.progress import ProgressReport
from lowlevel.world.terrain import TerrainConfig
from robots.errors import PilotError
from robots.g1.model import describe_foreign


@dataclass(frozen=True)
class Arguments:
    """Measure the tracking errors of a frozen controller."""

    controller: Path
    """Controller folder, or the ONNX file of somebody else's policy that has a card (docs/compare.md)."""
    against: tuple[Path, ...] = ()
    """Controllers to compare with: same seeds, the same commands, which all of them support, and differences episode by
    episode."""
    robot: Path | None = None
    """MJCF of another model of the G1 to run on (docs/compare.md)."""
    suite: str = "simple"
    """Terrain: simple (flat and slabs that differ by ±2 cm, half of the episodes each), flat, slabs, or full (flat,
    rough, slopes, stairs and platforms in five levels each, all to be crossed)."""
    condition: str = "nominal"
    """What is other than in the protocol, a name of :data:`evaluation.protocols.conditions.CONDITIONS`: late-40ms
    (targets), slippery (friction 0.4), other-gains (each off by up to 20 %), weak-motors (80 % of the torque limits),
    pushes-0.8 (m/s) and so on. ``evaluate-robustness`` runs all of them."""
    episodes: int = 500
    """Episodes of 20 s."""
    seed: int = 0
    """Seed of commands, starts, friction and noise; episode i is the same for every controller."""
    output: Path = Path("runs/evaluation/lowlevel")
    """Folder for report.md, metrics.json and plots; files of the same name there are replaced."""
    walk_episodes: int = WALK_EPISODES
    """Episodes of the walking test: 10 s at 0.5 m/s."""
    skill_episodes: int = SKILL_EPISODES
    """Episodes of each skill test: deep bend, bend and walk with a box, stop, push; 0 leaves them out."""
    robots: int = BATCH
    """Robots side by side; the last digits of the figures depend on it."""
    threads: int = available_cores()
    """Physics threads."""
    record: int = 0
    """Also record this many of the first episodes for the rerun viewer."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``evaluate-lowlevel``."""
    parsed = tyro.cli(Arguments, args=arguments)
    with command_line("evaluate-lowlevel", "interrupted, nothing was written"):
        _run(parsed)


def _run(arguments: Arguments) -> None:
    for name in ("episodes", "walk_episodes", "robots", "threads"):
        if getattr(arguments, name) < 1:
            raise PilotError(f"--{name.replace('_', '-')} must be at least 1")
    if arguments.skill_episodes < 0:
        raise PilotError("--skill-episodes must not be negative")
    if not 0 <= arguments.record <= min(arguments.robots, arguments.episodes):
        raise PilotError("--record must be between 0 and the number of episodes and of robots")
    suite_of(arguments.suite)
    condition_of(arguments.condition)
    check_output(arguments.output)
    name, controller = load_controller(arguments.controller)
    others = load_controllers(arguments.against)
    # Small matrix products only lose time to waking threads, and the physics wants the cores.
    torch.set_num_threads(1)
    print(f"evaluating {arguments.controller} on the {arguments.suite} suite", flush=True)
    if arguments.robot is not None:
        print(describe_foreign(arguments.robot))
    evaluation = evaluate(controller, name, arguments, others)

    def write(folder: Path) -> None:
        # Pictures are of our robot.
        drawn = {name: controller, **others} if others and arguments.robot is None else {}
        strips = _strips(folder, drawn, evaluation.supports)
        write_report(folder, evaluation, strips)
        if arguments.record:
            _record(controller, arguments, folder, evaluation.supports)

    write_results(arguments.output, write)
    print(summary(evaluation))
    print(f"report: {arguments.output / REPORT_FILE}   figures: {arguments.output / METRICS_FILE}")


def evaluate(
    controller: WholeBodyController, name: str, arguments: Arguments, others: Mapping[str, WholeBodyController]
) -> Evaluation:
    """Run the protocol, the walking test and the skill tests with all controllers, the motion modes with the first."""
    began = time.monotonic()
    suite = suite_of(arguments.suite)
    supports = common_supports([controller, *others.values()])
    arena = _arena(controller, suite.terrain, arguments, supports)
    require_common(supports, arena.space)
    space, seed = arena.space, arguments.seed
    protocol = condition_of(arguments.condition).disturbed(suite.episodes(space, arguments.episodes, seed))
    walk_terrain = FLAT if suite.crosses else suite.terrain
    walks = walking_episodes(space, arguments.walk_episodes, seed, len(walk_terrain.tiles))
    modes = mode_episodes(space, seed) if arena.experts else []
    skills = {skill.name: skill_episodes(skill, space, arguments.skill_episodes, seed) for skill in SKILLS}
    with ProgressReport() as progress:
        batches = (*[protocol, walks, *skills.values()] * (1 + len(others)), modes)
        total = sum(batch_steps(arena, episodes) for episodes in batches)
        task = progress.add_task("tracking", total=total)

        def advance(steps: int) -> None:
            progress.update(task, advance=steps)

        def measure(tested: WholeBodyController, whose: str) -> Measured:
            arena = _arena(tested, suite.terrain, arguments, supports)
            progress.update(task, description=f"tracking{whose}")
            table, transient, figures = suite.run(arena, protocol, advance)
            figures |= tracking_figures(table, suite.terrain.tiles)
            progress.update(task, description=f"walking{whose}")
            figures |= run_walking(_arena(tested, walk_terrain, arguments, supports), walks, advance)
            if arguments.skill_episodes:
                progress.update(task, description=f"skills{whose}")
                figures |= run_skills(_arena(tested, FLAT, arguments, supports), skills, advance)
            return Measured(figures, table, transient)

        ours = measure(controller, "")
        measured = {other: measure(tested, f" of {other}") for other, tested in others.items()}
        progress.update(task, description="experts")
        activations = run_modes(arena, modes, advance) if modes else np.zeros((0, 0))
    return Evaluation(
        suite=suite,
        name=arguments.suite,
        condition=arguments.condition if arguments.robot is None else f"{arguments.condition}, robot {arguments.robot}",
        seed=seed,
        controller=name,
        supports=supports,
        ours=ours,
        others=measured,
        modes=tuple(motion_modes(space)) if modes else (),
        activations=activations,
        period=arena.period,
        seconds=time.monotonic() - began,
    )


def _arena(tested: WholeBodyController, terrain: TerrainConfig, arguments: Arguments, supports: Supports) -> Arena:
    condition = condition_of(arguments.condition)
    return Arena(
        tested,
        terrain,
        condition.randomization,
        num_threads=arguments.threads,
        batch=arguments.robots,
        supports=supports,
        options=replace(condition.options, mjcf=arguments.robot),
    )


def _strips(folder: Path, controllers: Mapping[str, WholeBodyController], supports: Supports) -> dict[str, str]:
    """Draw every controller in commands that all of them support; file names by controller, none without OpenGL."""
    from evaluation.gallery import draw  # OpenGL is seldom needed here
    from highlevel.pictures.painter import NoOpenGLError, save_picture

    files = {}
    for number, (name, controller) in enumerate(controllers.items(), start=1):
        try:
            pixels, _ = draw(controller, 0, supports, "flat")
        except NoOpenGLError as error:
            print(error)
            return {}
        files[name] = f"strip-{number}.png"
        save_picture(folder / files[name], pixels)
    return files


def _record(controller: WholeBodyController, arguments: Arguments, folder: Path, supports: Supports) -> None:
    from evaluation.pictures.recording import record_episodes  # the viewer's library is large and seldom needed here

    suite = suite_of(arguments.suite)
    arena = _arena(controller, suite.terrain, arguments, supports)
    episodes = suite.episodes(arena.space, arguments.record, arguments.seed)
    record_episodes(arena, episodes, folder)


if __name__ == "__main__":
    main(sys.argv[1:])
