"""``evaluate-robustness``: how much worse controllers track, and how often they fall, when the robot is another."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro

from evaluation.baselines.onnx_policy import load_controllers
from evaluation.protocols.arena import BATCH, Arena, batch_steps
from evaluation.protocols.conditions import CONDITIONS, PUSH_TIMES, Condition
from evaluation.protocols.fairness import common_supports, require_common
from evaluation.protocols.suites import suite_of
from evaluation.protocols.tracking import tracking_figures
from evaluation.reporting.plots import plot_heat_map
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
from lowlevel.control.whole_body import WholeBodyController
from lowlevel.runs.command_line import command_line
from lowlevel.runs.processes import available_cores
from lowlevel.runs.progress import ProgressReport
from robots.errors import PilotError
from robots.g1.model import describe_foreign

SUITE = suite_of("flat")
SHOWN = ("fall_rate", "E_v", "E_omega", "E_h", "E_r", "E_p", "E_y", "E_arm")
"""Figures in the tables."""
WORST_RATIO = 3.0
"""Where the colors of the heat maps end."""


@dataclass(frozen=True)
class Arguments:
    """Run the tracking protocol under late targets, other friction, gains, masses, pushes and physics steps."""

    controller: Path
    """Controller folder, or the ONNX file of somebody else's policy that has a card (docs/compare.md)."""
    against: tuple[Path, ...] = ()
    """Controllers to compare with: the same commands, which all of them support."""
    robot: Path | None = None
    """MJCF of another model of the G1 to run on (docs/compare.md)."""
    episodes: int = 64
    """Episodes of 20 s under each condition."""
    seed: int = 0
    """Seed of commands, starts and noise; the same for every condition and controller."""
    output: Path = Path("runs/evaluation/robustness")
    """Folder for report.md, metrics.json and heat maps; files of the same name there are replaced."""
    robots: int = BATCH
    """Robots side by side; the last digits of the figures depend on it."""
    threads: int = available_cores()
    """Physics threads."""


Results = Mapping[str, Mapping[str, dict[str, Figure]]]
"""Figures by controller and condition."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``evaluate-robustness``."""
    parsed = tyro.cli(Arguments, args=arguments)
    with command_line("evaluate-robustness", "interrupted, nothing was written"):
        _run(parsed)


def _run(arguments: Arguments) -> None:
    for name in ("episodes", "robots", "threads"):
        if getattr(arguments, name) < 1:
            raise PilotError(f"--{name} must be at least 1")
    check_output(arguments.output)
    controllers = load_controllers((arguments.controller, *arguments.against))
    torch.set_num_threads(1)  # as evaluate-lowlevel does
    if arguments.robot is not None:
        print(describe_foreign(arguments.robot))
    results = evaluate(controllers, arguments)
    write_results(arguments.output, lambda folder: write_report(folder, results, arguments))
    print(f"report: {arguments.output / REPORT_FILE}   figures: {arguments.output / METRICS_FILE}")


def evaluate(controllers: Mapping[str, WholeBodyController], arguments: Arguments) -> Results:
    """Run the protocol with every controller under every condition."""
    supports = common_supports(list(controllers.values()))
    results: dict[str, dict[str, dict[str, Figure]]] = {}
    with ProgressReport() as progress:
        task = progress.add_task("robustness")
        for name, controller in controllers.items():
            results[name] = {}
            for key, condition in CONDITIONS.items():
                arena = Arena(
                    controller,
                    SUITE.terrain,
                    condition.randomization,
                    num_threads=arguments.threads,
                    batch=arguments.robots,
                    supports=supports,
                    options=replace(condition.options, mjcf=arguments.robot),
                )
                require_common(supports, arena.space)
                episodes = condition.disturbed(SUITE.episodes(arena.space, arguments.episodes, arguments.seed))
                total = len(controllers) * len(CONDITIONS) * batch_steps(arena, episodes)
                progress.update(task, total=total, description=f"{name}: {condition.group} {condition.label}")
                table, _, _ = SUITE.run(arena, episodes, lambda steps: progress.update(task, advance=steps))
                results[name][key] = tracking_figures(table, SUITE.terrain.tiles)
    return results


def ratios(figures: Mapping[str, dict[str, Figure]]) -> np.ndarray:
    """Every error under every condition over that of the protocol as it is (conditions, errors)."""
    errors = SHOWN[1:]

    def value(key: str, name: str) -> float:
        found = figures[key][name].value
        return np.nan if found is None else found

    return np.array([[value(key, name) / value("nominal", name) for name in errors] for key in CONDITIONS])


def write_report(folder: Path, results: Results, arguments: Arguments) -> None:
    """Write ``report.md``, ``metrics.json``, and heat maps into ``folder``."""
    labels = [_label(condition) for condition in CONDITIONS.values()]
    falls = 100.0 * np.array(
        [[figures[key]["fall_rate"].value or 0.0 for figures in results.values()] for key in CONDITIONS]
    )
    title = "episodes with a fall [%]"
    plot_heat_map(folder / "falls.png", falls, labels, list(results), title, 0, (0.0, 100.0), colors="YlOrRd")
    pictures = {}
    for number, (name, figures) in enumerate(results.items(), start=1):
        pictures[name] = f"errors-{number}.png"
        title = f"{name}: errors over those of the protocol"
        plot_heat_map(
            folder / pictures[name], ratios(figures), labels, SHOWN[1:], title, 2, (1.0, WORST_RATIO), colors="YlOrRd"
        )
    tables = {name: _table(figures) for name, figures in results.items()}
    values = {"arguments": arguments, "tables": tables, "pictures": pictures, "push_times": PUSH_TIMES}
    (folder / REPORT_FILE).write_text(render("robustness", **values))
    plain = {
        name: {key: {shown: asdict(figures[shown]) for shown in SHOWN} for key, figures in conditions.items()}
        for name, conditions in results.items()
    }
    first = next(iter(results))
    write_metrics(folder, metrics(results[first]["nominal"], arguments.seed, first, conditions=plain))


def _label(condition: Condition) -> str:
    return f"{condition.group}: {condition.label}"


def _table(figures: Mapping[str, dict[str, Figure]]) -> str:
    rows = [
        [_label(condition), *(format_figure(figures[key][name]) for name in SHOWN)]
        for key, condition in CONDITIONS.items()
    ]
    return markdown_table(["condition", *SHOWN], rows)


if __name__ == "__main__":
    main(sys.argv[1:])
