"""The report of ``evaluate-lowlevel``: what was measured, as Markdown, plots and metrics.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from evaluation.protocols import crossing, tracking
from evaluation.protocols.skills import SKILL_FIGURES, SKILLS, UNLOADED_BEND
from evaluation.protocols.suites import Suite
from evaluation.protocols.tracking import COMPARED, FIGURES, GROUPS, CommandTable, paired_differences
from evaluation.reporting.plots import plot_bars, plot_curves, plot_heat_map, plot_overlays, plot_scatter
from evaluation.reporting.reports import (
    REPORT_FILE,
    format_figure,
    markdown_table,
    metrics,
    render,
    write_metrics,
)
from evaluation.reporting.statistics import Figure
from lowlevel.commands import ARMS
from lowlevel.control.whole_body import Supports
from lowlevel.world.measures import TRACKING_FIGURES

EPISODES_FILE = "episodes.csv"
"""Every command of the protocol with its figures."""


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

    suite: Suite
    name: str
    """Of the suite."""
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
    period: float
    """[s]"""
    seconds: float
    """Time the evaluation took [s]."""


def write_report(folder: Path, evaluation: Evaluation, strips: Mapping[str, str]) -> None:
    """Write ``report.md``, plots and ``metrics.json`` into ``folder``, which holds film ``strips`` by controller."""
    figures, paper = evaluation.ours.figures, evaluation.suite.paper
    cases = {"all": "", "steady": "_steady", **{group: f"_{group}" for group in GROUPS}}
    panels = {name: {label: figures[name + suffix] for label, suffix in cases.items()} for name in TRACKING_FIGURES}
    panels["fall_rate"] = {label: figures["fall_rate" + suffix] for label, suffix in cases.items() if label != "steady"}
    evaluation.ours.table.write(folder / EPISODES_FILE, evaluation.suite.terrain.tiles)
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
    if evaluation.suite.crosses:
        plot_overlays(folder / "crossing.png", _crossing_curves(evaluation), "size of the obstacle")
    (folder / REPORT_FILE).write_text(report_text(evaluation, strips))
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
            suite=evaluation.name,
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


def report_text(evaluation: Evaluation, strips: Mapping[str, str]) -> str:
    """``report.md``."""
    figures, groups = evaluation.ours.figures, {group: f"_{group}" for group in GROUPS}
    has_skills = "deep_bend_success" in figures
    return render(
        "tracking",
        **{name: getattr(evaluation, name) for name in ("suite", "name", "condition", "seed", "controller", "modes")},
        protocol=tracking,
        crossing=crossing,
        crossed=_crossing_table(figures) if evaluation.suite.crosses else "",
        figures=figures,
        paper=evaluation.suite.paper,
        strips=strips,
        comparison=_comparison(evaluation) if evaluation.others else "",
        told=_told(evaluation.supports),
        by_group=_breakdown(figures, groups),
        by_group_steady=_breakdown(figures, groups, "_steady"),
        by_tile=_breakdown(figures, {tile: f"_on_{tile}" for tile in evaluation.suite.terrain.tiles}),
        skills=[skill for skill in SKILLS if skill is not UNLOADED_BEND] if has_skills else [],
        skill_figures=SKILL_FIGURES,
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


def _crossing_table(figures: Mapping[str, Figure]) -> str:
    """Who crosses what: a row per kind of obstacle and part of the way, a column per level."""
    rows = []
    for kind in crossing.OBSTACLES:
        names = crossing.level_names(kind)
        rows.append([f"**{kind}**", *(name.removeprefix(f"{kind}_") for name in names)])
        parts = ("crosses", "climbs", "descends") if kind in crossing.TWO_WAYS else ("crosses",)
        rows += [[part, *(format_figure(figures[f"{part}_{name}"]) for name in names)] for part in parts]
    return markdown_table(["", *(f"level {number}" for number in range(1, len(crossing.LEVELS) + 1))], rows)


def _crossing_curves(evaluation: Evaluation) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Share that crosses over the size of the obstacle, by kind and controller."""
    tested = {evaluation.controller: evaluation.ours, **evaluation.others}
    panels = {}
    for kind, (text, size) in crossing.OBSTACLES.items():
        sizes, names = np.array([size(level) for level in crossing.LEVELS]), crossing.level_names(kind)
        curves = {
            name: (sizes, np.array([measured.figures[f"crosses_{level}"].value for level in names], dtype=float))
            for name, measured in tested.items()
        }
        panels[f"{kind} [{text.split('}')[1].strip()}]"] = curves
    return panels


def _plain(figures: Mapping[str, Figure]) -> dict[str, dict[str, object]]:
    return {name: asdict(figure) for name, figure in figures.items()}


def _breakdown(figures: Mapping[str, Figure], columns: Mapping[str, str], suffix: str = "") -> str:
    rows = [[name, *(format_figure(figures[name + part + suffix]) for part in columns.values())] for name in FIGURES]
    if not suffix:
        rates = ("fall_rate", "fall_rate_command")
        rows += [[name, *(format_figure(figures[name + part]) for part in columns.values())] for name in rates]
    counts = ["episodes", *(str(figures[f"fall_rate{part}"].n) for part in columns.values())]
    return markdown_table(["figure", *(label.replace("_", " ") for label in columns)], [*rows, counts])
