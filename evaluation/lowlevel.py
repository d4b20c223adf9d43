"""``evaluate-lowlevel``: the paper's table of tracking errors for one frozen controller."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from evaluation.harness import BATCH, Arena, batch_steps
from evaluation.plots import plot_bars, plot_curves, plot_heat_map
from evaluation.reports import (
    METRICS_FILE,
    REPORT_FILE,
    check_output,
    format_figure,
    markdown_table,
    metrics,
    run_command,
    write_metrics,
    write_results,
)
from evaluation.skills import EPISODES as SKILL_EPISODES
from evaluation.skills import FLAT, SKILLS, run_skills, skill_episodes, skills_section
from evaluation.statistics import Figure
from evaluation.tracking import (
    COMMAND_INTERVAL,
    EPISODE_LENGTH,
    GROUPS,
    TRANSIENT,
    WALK_EPISODES,
    WALK_SPEED,
    WALK_TIME,
    TrackingResult,
    mode_episodes,
    motion_modes,
    protocol_episodes,
    run_modes,
    run_tracking,
    run_walking,
    suite_terrain,
    tracking_figures,
    walking_episodes,
)
from lowlevel.controller import Controller, add_metrics, content_hash
from lowlevel.measures import TRACKING_FIGURES
from lowlevel.progress import ProgressReport

PAPER: dict[str, dict[str, float]] = {
    "simple": dict(
        zip(TRACKING_FIGURES, (0.145, 0.099, 0.010, 0.057, 0.053, 0.055, 0.206), strict=False),
    ),
}
"""The paper's figures for each suite: on simple terrain those of its blind policy (Table II)."""


@dataclass(frozen=True)
class Arguments:
    """Measure the tracking errors of a frozen controller."""

    controller: Path
    """Controller folder."""
    suite: str = "simple"
    """Terrain: simple (flat, ±2 cm irregularities)."""
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
    threads: int = os.cpu_count() or 1
    """Physics threads."""
    record: int = 0
    """Also record this many of the first episodes for the rerun viewer."""
    write_metrics: bool = False
    """Also store the figures in the controller's own folder."""


@dataclass(frozen=True)
class Evaluation:
    """Everything a report shows."""

    suite: str
    seed: int
    controller: str
    """Content hash."""
    figures: dict[str, Figure]
    tracking: TrackingResult
    modes: tuple[str, ...]
    activations: np.ndarray
    """(modes, experts)"""
    tiles: tuple[str, ...]
    period: float
    """[s]"""
    seconds: float
    """Time the evaluation took [s]."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``evaluate-lowlevel``."""
    parsed = tyro.cli(Arguments, args=arguments)
    run_command("evaluate-lowlevel", lambda: _run(parsed))


def _run(arguments: Arguments) -> None:
    for name in ("episodes", "walk_episodes", "robots", "threads"):
        if getattr(arguments, name) < 1:
            raise ValueError(f"--{name.replace('_', '-')} must be at least 1")
    if arguments.skill_episodes < 0:
        raise ValueError("--skill-episodes must not be negative")
    if not 0 <= arguments.record <= min(arguments.robots, arguments.episodes):
        raise ValueError("--record must be between 0 and the number of episodes and of robots")
    suite_terrain(arguments.suite)
    check_output(arguments.output)
    controller = Controller.load(arguments.controller)
    # Small matrix products only lose time to waking threads, and the physics wants the cores.
    torch.set_num_threads(1)
    print(f"evaluating {arguments.controller} on the {arguments.suite} suite", flush=True)
    evaluation = evaluate(controller, content_hash(arguments.controller), arguments)

    def write(folder: Path) -> None:
        write_report(folder, evaluation)
        if arguments.record:
            _record(controller, arguments, folder)

    write_results(arguments.output, write)
    if arguments.write_metrics:
        stored = controller.provenance.get("metrics", {})
        figures = {name: asdict(figure) for name, figure in evaluation.figures.items()}
        entry = {"seed": arguments.seed, "figures": figures}
        add_metrics(arguments.controller, stored | {arguments.suite: entry})
    print(summary(evaluation))
    print(f"report: {arguments.output / REPORT_FILE}   figures: {arguments.output / METRICS_FILE}")


def evaluate(controller: Controller, identity: str, arguments: Arguments) -> Evaluation:
    """Run the protocol, the walking test, the motion modes and the skill tests."""
    began = time.monotonic()
    terrain = suite_terrain(arguments.suite)
    space, tiles, seed = controller.config.command_space, len(terrain.tiles), arguments.seed
    arena = Arena(controller, terrain, num_threads=arguments.threads, batch=arguments.robots)
    protocol = protocol_episodes(space, arguments.episodes, seed, tiles)
    walks = walking_episodes(space, arguments.walk_episodes, seed, tiles)
    modes = mode_episodes(space, seed)
    skills = {skill.name: skill_episodes(skill, space, arguments.skill_episodes, seed) for skill in SKILLS}
    with ProgressReport() as progress:
        total = sum(batch_steps(arena, episodes) for episodes in (protocol, walks, modes, *skills.values()))
        task = progress.add_task("tracking", total=total)

        def advance(steps: int) -> None:
            progress.update(task, advance=steps)

        tracking = run_tracking(arena, protocol, advance)
        progress.update(task, description="walking")
        walking = run_walking(arena, walks, advance)
        progress.update(task, description="experts")
        activations = run_modes(arena, modes, advance)
        figures = tracking_figures(tracking, terrain.tiles) | walking
        if arguments.skill_episodes:
            progress.update(task, description="skills")
            flat = Arena(controller, FLAT, num_threads=arguments.threads, batch=arguments.robots)
            figures |= run_skills(flat, skills, advance)
    return Evaluation(
        suite=arguments.suite,
        seed=seed,
        controller=identity,
        figures=figures,
        tracking=tracking,
        modes=tuple(motion_modes(space)),
        activations=activations,
        tiles=terrain.tiles,
        period=arena.period,
        seconds=time.monotonic() - began,
    )


def _record(controller: Controller, arguments: Arguments, folder: Path) -> None:
    from evaluation.recording import record_episodes  # the viewer's library is large and seldom needed here

    terrain = suite_terrain(arguments.suite)
    arena = Arena(controller, terrain, num_threads=arguments.threads, batch=arguments.robots)
    space = controller.config.command_space
    episodes = protocol_episodes(space, arguments.record, arguments.seed, len(terrain.tiles))
    record_episodes(arena, episodes, folder)


# -- report --------------------------------------------------------------------------------------------------


def write_report(folder: Path, evaluation: Evaluation) -> None:
    """Write ``report.md``, plots and ``metrics.json`` into ``folder``."""
    figures, paper = evaluation.figures, PAPER[evaluation.suite]
    cases = {"all": "", "steady": "_steady", **{group: f"_{group}" for group in GROUPS}}
    panels = {
        name: {label: figures[name + suffix] for label, suffix in cases.items()}
        for name in (*TRACKING_FIGURES, "fall_rate")
    }
    plot_bars(folder / "tracking.png", panels, paper, columns=3)
    steps = np.arange(1, len(evaluation.tracking.transient) + 1) * evaluation.period
    titles = [f"{name} [{unit}]" for name, (unit, _) in TRACKING_FIGURES.items()]
    plot_curves(
        folder / "transient.png",
        steps,
        evaluation.tracking.transient,
        titles,
        "time since the command changed [s]",
    )
    experts = [f"expert {number}" for number in range(1, evaluation.activations.shape[1] + 1)]
    plot_heat_map(folder / "experts.png", evaluation.activations, evaluation.modes, experts, "mean expert activation")
    (folder / REPORT_FILE).write_text(report_text(evaluation))
    activations = {
        mode: [None if np.isnan(value) else float(value) for value in row]
        for mode, row in zip(evaluation.modes, evaluation.activations, strict=True)
    }
    write_metrics(
        folder,
        metrics(
            figures,
            evaluation.seed,
            evaluation.controller,
            suite=evaluation.suite,
            expert_activations=activations,
            seconds=round(evaluation.seconds, 1),
        ),
    )


def summary(evaluation: Evaluation) -> str:
    """The headline figures in one line."""
    values = [
        f"{name} {format_figure(evaluation.figures[name]).split(' ')[0]}" for name in (*TRACKING_FIGURES, "fall_rate")
    ]
    return "  ".join(values)


def report_text(evaluation: Evaluation) -> str:
    """``report.md``."""
    figures = evaluation.figures
    survival, speed = figures["walk_half_mps_survival"], figures["walk_half_mps_speed"]
    energy, action_rate = figures["energy_per_metre"], figures["action_rate"]
    episodes = len(evaluation.tracking.tiles)
    return "\n".join(
        [
            f"# Tracking on the {evaluation.suite} suite",
            "",
            f"Controller `{evaluation.controller}`, {episodes} episodes of {EPISODE_LENGTH:.0f} s with a new "
            f"command every {COMMAND_INTERVAL:.0f} s, seed {evaluation.seed}, terrain "
            f"{', '.join(evaluation.tiles)}. Means over episodes with 95 % bootstrap intervals over episodes "
            f"(Wilson intervals for shares). Steady figures leave out the first {TRANSIENT:.0f} s after a "
            "change of command. A fallen episode counts in full at the error it had until its fall.",
            "",
            markdown_table(
                ["figure", "unit", "ours", "ours, steady", "paper, blind"], _main_rows(figures, evaluation.suite)
            ),
            "![tracking](tracking.png)",
            "",
            f"Travelling costs {format_figure(energy, 0)} J per metre: the sum of |torque times joint speed| over all "
            "steps whose command asks for translation, by the way made good in the commanded direction. From one "
            f"control step to the next a joint's target moves by {format_figure(action_rate, 4)} rad on average.",
            "",
            "## By kind of command",
            "",
            "Walk and work: full velocity range with moderate postures and moving arms. Stand and work: full "
            "height, torso and arm ranges. Walk only: full velocity range, neutral posture (I = 0).",
            "",
            _breakdown(figures, {group: f"_{group}" for group in GROUPS}),
            "Steady:",
            "",
            _breakdown(figures, {group: f"_{group}_steady" for group in GROUPS}),
            "![transient](transient.png)",
            "",
            "## By terrain",
            "",
            _breakdown(figures, {tile: f"_on_{tile}" for tile in evaluation.tiles}),
            "## Walking",
            "",
            f"Commanded to walk at {WALK_SPEED} m/s for {WALK_TIME:.0f} s, a share of "
            f"{format_figure(survival)} of {survival.n} episodes does not fall; the mean forward speed is "
            f"{format_figure(speed)} m/s. A share of {format_figure(figures['walk_half_mps_success'])} "
            "neither falls nor stays below half the commanded speed.",
            "",
            *([skills_section(figures)] if "deep_bend_success" in figures else []),
            "## Experts",
            "",
            "Mean activation of each expert in six motion modes, after the transient; blank where no robot stayed up.",
            "",
            "![experts](experts.png)",
            "",
        ]
    )


def _main_rows(figures: Mapping[str, Figure], suite: str) -> list[list[str]]:
    paper = PAPER[suite]
    names = [*TRACKING_FIGURES, "fall_rate"]
    return [
        [
            name,
            figures[name].unit,
            format_figure(figures[name]),
            format_figure(figures[f"{name}_steady"]),
            f"{paper[name]:.3f}" if name in paper else "–",
        ]
        for name in names
    ]


def _breakdown(figures: Mapping[str, Figure], columns: Mapping[str, str]) -> str:
    names = [*TRACKING_FIGURES, "fall_rate"]
    rows = [[name, *(format_figure(figures[name + suffix]) for suffix in columns.values())] for name in names]
    counts = ["episodes", *(str(figures[f"fall_rate{suffix}"].n) for suffix in columns.values())]
    return markdown_table(["figure", *(label.replace("_", " ") for label in columns)], [*rows, counts])


if __name__ == "__main__":
    main(sys.argv[1:])
