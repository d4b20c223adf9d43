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

from evaluation.protocols import tracking
from evaluation.protocols.arena import BATCH, Arena, batch_steps
from evaluation.protocols.skills import BARS, FLAT, SKILLS, UNLOADED_BEND, run_skills, skill_episodes
from evaluation.protocols.skills import EPISODES as SKILL_EPISODES
from evaluation.protocols.tracking import (
    FIGURES,
    GROUPS,
    SUITES,
    WALK_EPISODES,
    CommandTable,
    conditions_of,
    mode_episodes,
    motion_modes,
    paired_differences,
    protocol_episodes,
    run_modes,
    run_tracking,
    run_walking,
    suite_terrain,
    tracking_figures,
    walking_episodes,
)
from evaluation.reporting.plots import plot_bars, plot_curves, plot_heat_map
from evaluation.reporting.reports import (
    METRICS_FILE,
    REPORT_FILE,
    check_output,
    format_figure,
    markdown_table,
    metrics,
    render,
    write_metrics,
    write_results,
)
from evaluation.reporting.statistics import Figure
from lowlevel.control.controller import Controller, add_metrics, content_hash
from lowlevel.runs.command_line import command_line
from lowlevel.runs.progress import ProgressReport
from lowlevel.world.measures import TRACKING_FIGURES
from lowlevel.world.terrain import TerrainConfig
from robots.errors import PilotError

_BLIND = dict(zip(TRACKING_FIGURES, (0.145, 0.099, 0.010, 0.057, 0.053, 0.055, 0.206), strict=False))
EPISODES_FILE = "episodes.csv"
"""Every command of the protocol with its figures."""

PAPER: dict[str, dict[str, float]] = dict.fromkeys(SUITES, _BLIND)
"""The paper's figures for each suite: on simple terrain those of its blind policy (Table II)."""


@dataclass(frozen=True)
class Arguments:
    """Measure the tracking errors of a frozen controller."""

    controller: Path
    """Controller folder."""
    against: tuple[Path, ...] = ()
    """Folders of controllers to compare with: same commands, same seeds, differences episode by episode."""
    suite: str = "simple"
    """Terrain: simple (flat and slabs that differ by ±2 cm, half of the episodes each), flat, or slabs."""
    condition: str = "nominal"
    """What is other than in the protocol: late-20ms, late-40ms (latency of the targets), slippery (friction 0.4),
    other-gains (every stiffness and damping off by up to 20 %), weak-motors (80 % of the torque limits), weak-waist
    (35 N m at waist roll and pitch)."""
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
    condition: str
    seed: int
    controller: str
    """Content hash."""
    figures: dict[str, Figure]
    table: CommandTable
    transient: np.ndarray
    """Mean errors over the time since a command began (steps, figures)."""
    differences: dict[str, dict[str, Figure]]
    """Ours minus the other's, by content hash of the other controller and by figure."""
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
    suite_terrain(arguments.suite)
    conditions_of(arguments.condition)
    if arguments.write_metrics and arguments.condition != "nominal":
        raise PilotError("--write-metrics is for figures under the nominal condition: leave one of the two out")
    check_output(arguments.output)
    controller = Controller.load(arguments.controller)
    others = {content_hash(folder): Controller.load(folder) for folder in arguments.against}
    # Small matrix products only lose time to waking threads, and the physics wants the cores.
    torch.set_num_threads(1)
    print(f"evaluating {arguments.controller} on the {arguments.suite} suite", flush=True)
    evaluation = evaluate(controller, content_hash(arguments.controller), arguments, others)

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


def evaluate(
    controller: Controller, identity: str, arguments: Arguments, others: Mapping[str, Controller]
) -> Evaluation:
    """Run the protocol, the walking test, the motion modes and the skill tests, and the protocol with ``others``."""
    began = time.monotonic()
    terrain = suite_terrain(arguments.suite)
    space, tiles, seed = controller.command_space, len(terrain.tiles), arguments.seed
    conditions = conditions_of(arguments.condition)

    def arena_of(tested: Controller, tiles: TerrainConfig) -> Arena:
        return Arena(tested, tiles, conditions, num_threads=arguments.threads, batch=arguments.robots)

    arena = arena_of(controller, terrain)
    protocol = protocol_episodes(space, arguments.episodes, seed, tiles)
    walks = walking_episodes(space, arguments.walk_episodes, seed, tiles)
    modes = mode_episodes(space, seed)
    skills = {skill.name: skill_episodes(skill, space, arguments.skill_episodes, seed) for skill in SKILLS}
    with ProgressReport() as progress:
        batches = (*[protocol] * (1 + len(others)), walks, modes, *skills.values())
        total = sum(batch_steps(arena, episodes) for episodes in batches)
        task = progress.add_task("tracking", total=total)

        def advance(steps: int) -> None:
            progress.update(task, advance=steps)

        table, transient = run_tracking(arena, protocol, advance)
        differences = {}
        for name, other in others.items():
            progress.update(task, description=f"tracking of {name}")
            differences[name] = paired_differences(table, run_tracking(arena_of(other, terrain), protocol, advance)[0])
        progress.update(task, description="walking")
        walking = run_walking(arena, walks, advance)
        progress.update(task, description="experts")
        activations = run_modes(arena, modes, advance)
        figures = tracking_figures(table, terrain.tiles) | walking
        if arguments.skill_episodes:
            progress.update(task, description="skills")
            figures |= run_skills(arena_of(controller, FLAT), skills, advance)
    return Evaluation(
        suite=arguments.suite,
        condition=arguments.condition,
        seed=seed,
        controller=identity,
        figures=figures,
        table=table,
        transient=transient,
        differences=differences,
        modes=tuple(motion_modes(space)),
        activations=activations,
        tiles=terrain.tiles,
        period=arena.period,
        seconds=time.monotonic() - began,
    )


def _record(controller: Controller, arguments: Arguments, folder: Path) -> None:
    from evaluation.pictures.recording import record_episodes  # the viewer's library is large and seldom needed here

    terrain = suite_terrain(arguments.suite)
    conditions = conditions_of(arguments.condition)
    arena = Arena(controller, terrain, conditions, num_threads=arguments.threads, batch=arguments.robots)
    space = controller.command_space
    episodes = protocol_episodes(space, arguments.record, arguments.seed, len(terrain.tiles))
    record_episodes(arena, episodes, folder)


# -- report --------------------------------------------------------------------------------------------------


def write_report(folder: Path, evaluation: Evaluation) -> None:
    """Write ``report.md``, plots and ``metrics.json`` into ``folder``."""
    figures, paper = evaluation.figures, PAPER[evaluation.suite]
    cases = {"all": "", "steady": "_steady", **{group: f"_{group}" for group in GROUPS}}
    panels = {name: {label: figures[name + suffix] for label, suffix in cases.items()} for name in TRACKING_FIGURES}
    panels["fall_rate"] = {label: figures["fall_rate" + suffix] for label, suffix in cases.items() if label != "steady"}
    evaluation.table.write(folder / EPISODES_FILE, evaluation.tiles)
    plot_bars(folder / "tracking.png", panels, paper, columns=3)
    steps = np.arange(1, len(evaluation.transient) + 1) * evaluation.period
    titles = [f"{name} [{unit}]" for name, (unit, _) in TRACKING_FIGURES.items()]
    plot_curves(
        folder / "transient.png",
        steps,
        evaluation.transient,
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
            condition=evaluation.condition,
            expert_activations=activations,
            differences={
                other: {name: asdict(figure) for name, figure in rows.items()}
                for other, rows in evaluation.differences.items()
            },
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
    figures, groups = evaluation.figures, {group: f"_{group}" for group in GROUPS}
    has_skills = "deep_bend_success" in figures
    return render(
        "tracking",
        **{name: getattr(evaluation, name) for name in ("suite", "condition", "seed", "controller", "tiles")},
        protocol=tracking,
        figures=figures,
        paper=PAPER[evaluation.suite],
        differences=_comparison(evaluation.differences),
        by_group=_breakdown(figures, groups),
        by_group_steady=_breakdown(figures, groups, "_steady"),
        by_tile=_breakdown(figures, {tile: f"_on_{tile}" for tile in evaluation.tiles}),
        skills=[skill for skill in SKILLS if skill is not UNLOADED_BEND] if has_skills else [],
        bars=BARS,
    )


def _comparison(differences: Mapping[str, Mapping[str, Figure]]) -> str:
    """The table of other controllers; empty without any."""
    if not differences:
        return ""
    names = list(next(iter(differences.values())))
    rows = [[name, *(format_figure(figures[name]) for figures in differences.values())] for name in names]
    return markdown_table(["figure", *(f"against `{name}`" for name in differences)], rows)


def _breakdown(figures: Mapping[str, Figure], columns: Mapping[str, str], suffix: str = "") -> str:
    rows = [[name, *(format_figure(figures[name + part + suffix]) for part in columns.values())] for name in FIGURES]
    if not suffix:
        rates = ("fall_rate", "fall_rate_command")
        rows += [[name, *(format_figure(figures[name + part]) for part in columns.values())] for name in rates]
    counts = ["episodes", *(str(figures[f"fall_rate{part}"].n) for part in columns.values())]
    return markdown_table(["figure", *(label.replace("_", " ") for label in columns)], [*rows, counts])


if __name__ == "__main__":
    main(sys.argv[1:])
