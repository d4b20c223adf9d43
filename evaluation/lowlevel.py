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

from evaluation.baselines.onnx_policy import load_controller
from evaluation.protocols import tracking
from evaluation.protocols.arena import BATCH, Arena, batch_steps
from evaluation.protocols.skills import BARS, FLAT, SKILLS, UNLOADED_BEND, run_skills, skill_episodes
from evaluation.protocols.skills import EPISODES as SKILL_EPISODES
from evaluation.protocols.tracking import (
    COMPARED,
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
from evaluation.reporting.plots import plot_bars, plot_curves, plot_heat_map, plot_scatter
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
from lowlevel.commands import ARMS, CommandSpace
from lowlevel.control.controller import Controller, add_metrics
from lowlevel.control.whole_body import Supports, WholeBodyController
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
    """Controller folder, or the ONNX file of somebody else's policy that has a card (docs/compare.md)."""
    against: tuple[Path, ...] = ()
    """Controllers to compare with: same seeds, the same commands, which all of them support, and differences episode by
    episode."""
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
class Measured:
    """What one controller did."""

    figures: dict[str, Figure]
    table: CommandTable
    transient: np.ndarray
    """Mean errors over the time since a command began (steps, figures)."""


@dataclass(frozen=True)
class Evaluation:
    """Everything a report shows."""

    suite: str
    condition: str
    seed: int
    controller: str
    """Content hash, or the name on its card."""
    supports: Supports
    """What all of the controllers can be told."""
    ours: Measured
    others: dict[str, Measured]
    """What the other controllers did, by hash or name."""
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
    name, controller = load_controller(arguments.controller)
    if arguments.write_metrics and not isinstance(controller, Controller):
        raise PilotError(f"--write-metrics stores figures in a controller's folder, and {arguments.controller} is none")
    others = dict(load_controller(path) for path in arguments.against)
    if len(others) < len(arguments.against):
        raise PilotError("two of the controllers to compare with have the same name or are the same: leave one out")
    if arguments.write_metrics and not common_supports(controller, others).covers(controller.supports):
        raise PilotError("--write-metrics is for figures of all commands, and these controllers share only some")
    # Small matrix products only lose time to waking threads, and the physics wants the cores.
    torch.set_num_threads(1)
    print(f"evaluating {arguments.controller} on the {arguments.suite} suite", flush=True)
    evaluation = evaluate(controller, name, arguments, others)

    def write(folder: Path) -> None:
        write_report(folder, evaluation)
        if arguments.record:
            _record(controller, arguments, folder, evaluation.supports)

    write_results(arguments.output, write)
    if arguments.write_metrics and isinstance(controller, Controller):
        stored = controller.provenance.get("metrics", {})
        figures = {name: asdict(figure) for name, figure in evaluation.ours.figures.items()}
        entry = {"seed": arguments.seed, "figures": figures}
        add_metrics(arguments.controller, stored | {arguments.suite: entry})
    print(summary(evaluation))
    print(f"report: {arguments.output / REPORT_FILE}   figures: {arguments.output / METRICS_FILE}")


def evaluate(
    controller: WholeBodyController, name: str, arguments: Arguments, others: Mapping[str, WholeBodyController]
) -> Evaluation:
    """Run the protocol, the walking test and the skill tests with all controllers, the motion modes with the first."""
    began = time.monotonic()
    terrain = suite_terrain(arguments.suite)
    supports = common_supports(controller, others)
    arena = _arena(controller, terrain, arguments, supports)
    _require_common(supports, arena.space)
    space, tiles, seed = arena.space, len(terrain.tiles), arguments.seed
    protocol = protocol_episodes(space, arguments.episodes, seed, tiles)
    walks = walking_episodes(space, arguments.walk_episodes, seed, tiles)
    modes = mode_episodes(space, seed) if arena.experts else []
    skills = {skill.name: skill_episodes(skill, space, arguments.skill_episodes, seed) for skill in SKILLS}
    with ProgressReport() as progress:
        batches = (*[protocol, walks, *skills.values()] * (1 + len(others)), modes)
        total = sum(batch_steps(arena, episodes) for episodes in batches)
        task = progress.add_task("tracking", total=total)

        def advance(steps: int) -> None:
            progress.update(task, advance=steps)

        def measure(tested: WholeBodyController, whose: str) -> Measured:
            arena = _arena(tested, terrain, arguments, supports)
            progress.update(task, description=f"tracking{whose}")
            table, transient = run_tracking(arena, protocol, advance)
            progress.update(task, description=f"walking{whose}")
            figures = tracking_figures(table, terrain.tiles) | run_walking(arena, walks, advance)
            if arguments.skill_episodes:
                progress.update(task, description=f"skills{whose}")
                figures |= run_skills(_arena(tested, FLAT, arguments, supports), skills, advance)
            return Measured(figures, table, transient)

        ours = measure(controller, "")
        measured = {other: measure(tested, f" of {other}") for other, tested in others.items()}
        progress.update(task, description="experts")
        activations = run_modes(arena, modes, advance) if modes else np.zeros((0, 0))
    return Evaluation(
        suite=arguments.suite,
        condition=arguments.condition,
        seed=seed,
        controller=name,
        supports=supports,
        ours=ours,
        others=measured,
        modes=tuple(motion_modes(space)) if modes else (),
        activations=activations,
        tiles=terrain.tiles,
        period=arena.period,
        seconds=time.monotonic() - began,
    )


def _arena(tested: WholeBodyController, terrain: TerrainConfig, arguments: Arguments, supports: Supports) -> Arena:
    conditions, threads = conditions_of(arguments.condition), arguments.threads
    return Arena(tested, terrain, conditions, num_threads=threads, batch=arguments.robots, supports=supports)


def common_supports(controller: WholeBodyController, others: Mapping[str, WholeBodyController]) -> Supports:
    """What all of them can be told."""
    supports = controller.supports
    for other in others.values():
        supports = supports & other.supports
    return supports


def _require_common(supports: Supports, space: CommandSpace) -> None:
    for doing, bounds in (("stand", supports.standing), ("walk", supports.walking)):
        for name, apart in zip(space.names, (bounds.lower > bounds.upper).tolist(), strict=True):
            if apart:
                raise PilotError(f"the controllers have no {name} in common while they {doing}: compare fewer of them")


def _record(controller: WholeBodyController, arguments: Arguments, folder: Path, supports: Supports) -> None:
    from evaluation.pictures.recording import record_episodes  # the viewer's library is large and seldom needed here

    terrain = suite_terrain(arguments.suite)
    arena = _arena(controller, terrain, arguments, supports)
    episodes = protocol_episodes(arena.space, arguments.record, arguments.seed, len(terrain.tiles))
    record_episodes(arena, episodes, folder)


# -- report --------------------------------------------------------------------------------------------------


def write_report(folder: Path, evaluation: Evaluation) -> None:
    """Write ``report.md``, plots and ``metrics.json`` into ``folder``."""
    figures, paper = evaluation.ours.figures, PAPER[evaluation.suite]
    cases = {"all": "", "steady": "_steady", **{group: f"_{group}" for group in GROUPS}}
    panels = {name: {label: figures[name + suffix] for label, suffix in cases.items()} for name in TRACKING_FIGURES}
    panels["fall_rate"] = {label: figures["fall_rate" + suffix] for label, suffix in cases.items() if label != "steady"}
    evaluation.ours.table.write(folder / EPISODES_FILE, evaluation.tiles)
    plot_bars(folder / "tracking.png", panels, paper, columns=3)
    steps = np.arange(1, len(evaluation.ours.transient) + 1) * evaluation.period
    titles = [f"{name} [{unit}]" for name, (unit, _) in TRACKING_FIGURES.items()]
    since = "time since the command changed [s]"
    plot_curves(folder / "transient.png", steps, evaluation.ours.transient, titles, since)
    if evaluation.modes:
        experts = [f"expert {number}" for number in range(1, evaluation.activations.shape[1] + 1)]
        heat = "mean expert activation"
        plot_heat_map(folder / "experts.png", evaluation.activations, evaluation.modes, experts, heat)
    if evaluation.others:
        plot_scatter(folder / "comparison.png", _paired_episodes(evaluation))
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
            others={name: _plain(other.figures) for name, other in evaluation.others.items()},
            differences={name: _plain(rows) for name, rows in _differences(evaluation).items()},
            seconds=round(evaluation.seconds, 1),
        ),
    )


def summary(evaluation: Evaluation) -> str:
    """The headline figures in one line."""
    figures = evaluation.ours.figures
    names = (*TRACKING_FIGURES, "fall_rate")
    return "  ".join(f"{name} {format_figure(figures[name]).split(' ')[0]}" for name in names)


def report_text(evaluation: Evaluation) -> str:
    """``report.md``."""
    figures, groups = evaluation.ours.figures, {group: f"_{group}" for group in GROUPS}
    has_skills = "deep_bend_success" in figures
    return render(
        "tracking",
        **{name: getattr(evaluation, name) for name in ("suite", "condition", "seed", "controller", "tiles", "modes")},
        protocol=tracking,
        figures=figures,
        paper=PAPER[evaluation.suite],
        comparison=_comparison(evaluation) if evaluation.others else "",
        told=_told(evaluation.supports),
        by_group=_breakdown(figures, groups),
        by_group_steady=_breakdown(figures, groups, "_steady"),
        by_tile=_breakdown(figures, {tile: f"_on_{tile}" for tile in evaluation.tiles}),
        skills=[skill for skill in SKILLS if skill is not UNLOADED_BEND] if has_skills else [],
        bars=BARS,
    )


UNPAIRED = ("fall_rate", "energy_per_meter", "fast_walk_speed", "fast_walk_success", "stop_success", "push_success")
"""Figures that controllers are compared by, but not episode by episode."""


def _differences(evaluation: Evaluation) -> dict[str, dict[str, Figure]]:
    """Ours minus theirs, by controller and figure."""
    ours = evaluation.ours.table
    return {name: paired_differences(ours, other.table) for name, other in evaluation.others.items()}


def _paired_episodes(evaluation: Evaluation) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Errors of the same episodes, ours and theirs, by figure and controller."""
    ours = evaluation.ours.table
    return {
        name: {
            other: (ours.by_episode(name), measured.table.by_episode(name))
            for other, measured in evaluation.others.items()
        }
        for name in FIGURES
        if name != "E_stumble"
    }


def _comparison(evaluation: Evaluation) -> str:
    """The table of all controllers."""
    columns = {"ours": evaluation.ours, **evaluation.others}
    differences = _differences(evaluation)
    rows = []
    for name in dict.fromkeys((*COMPARED, *UNPAIRED)):
        values = [format_figure(m.figures[name]) if name in m.figures else "–" for m in columns.values()]
        paired = [format_figure(rows[name]) if name in rows else "–" for rows in differences.values()]
        rows.append([name, *values, *paired])
    return markdown_table(["figure", *columns, *(f"ours - {name}" for name in differences)], rows)


def _told(supports: Supports) -> str:
    """The ranges that commands were cut to."""
    names = ("vx [m/s]", "vy [m/s]", "yaw rate [rad/s]", "height [m]", "roll [rad]", "pitch [rad]", "yaw [rad]")
    rows = []
    for doing, bounds in (("standing", supports.standing), ("walking", supports.walking)):
        ranges = [
            f"{low:.2f} to {high:.2f}" for low, high in zip(bounds.lower.tolist(), bounds.upper.tolist(), strict=True)
        ]
        arms = "told" if (bounds.upper - bounds.lower)[ARMS].min() > 0.0 else "at their default"
        rows.append([doing, *ranges[: ARMS.start], arms])
    return markdown_table(["", *names, "arms"], rows)


def _plain(figures: Mapping[str, Figure]) -> dict[str, dict[str, object]]:
    return {name: asdict(figure) for name, figure in figures.items()}


def _breakdown(figures: Mapping[str, Figure], columns: Mapping[str, str], suffix: str = "") -> str:
    rows = [[name, *(format_figure(figures[name + part + suffix]) for part in columns.values())] for name in FIGURES]
    if not suffix:
        rates = ("fall_rate", "fall_rate_command")
        rows += [[name, *(format_figure(figures[name + part]) for part in columns.values())] for name in rates]
    counts = ["episodes", *(str(figures[f"fall_rate{part}"].n) for part in columns.values())]
    return markdown_table(["figure", *(label.replace("_", " ") for label in columns)], [*rows, counts])


if __name__ == "__main__":
    main(sys.argv[1:])
