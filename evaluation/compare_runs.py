"""Training curves of several low-level runs side by side: ``python -m evaluation.compare_runs RUN RUN ...``."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from evaluation.reporting.plots import plot_overlays
from lowlevel.runs.command_line import command_line
from lowlevel.runs.run_folder import LOG_FILE
from robots.errors import PilotError

PANELS = {
    "curriculum/steps_between_falls": "steps between falls",
    "reward/total": "reward [1/s]",
    "tracking/E_v": "E_v [m/s]",
    "tracking/E_omega": "E_omega [rad/s]",
    "tracking/E_h": "E_h [m]",
    "tracking/E_r": "E_r [rad]",
    "tracking/E_p": "E_p [rad]",
    "tracking/E_y": "E_y [rad]",
}
"""Logged figure to panel title; all are measured under exploration noise and the curriculum of the moment."""


@dataclass(frozen=True)
class Arguments:
    """Draw the training curves of runs over their environment steps."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of the runs; a curve is named after its folder."""
    output: Path = Path("runs/comparison.png")
    """Picture to write."""
    window: int = 10
    """Updates over which curves are averaged."""


def read_curves(run: Path, window: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Environment steps (T,) of a run's log and the figures of :data:`PANELS` (T,), averaged over ``window`` updates.

    Raises:
        PilotError: if the folder holds no log of a low-level run, or one shorter than the window.
    """
    path = run / LOG_FILE
    if not path.is_file():
        raise PilotError(f"{path} is missing: give folders of train-lowlevel's runs")
    try:
        entries = [json.loads(line) for line in path.read_text().splitlines()]
    except ValueError as error:
        raise PilotError(f"{path} is damaged: {error}") from error
    entries = [entry for entry in entries if all(name in entry for name in PANELS)]
    if len(entries) < window:
        raise PilotError(f"{path} has {len(entries)} updates, fewer than the window of {window}")
    kernel = np.full(window, 1.0 / window)
    steps = np.convolve([entry["steps"] for entry in entries], kernel, mode="valid")
    curves = {name: np.convolve([entry[name] for entry in entries], kernel, mode="valid") for name in PANELS}
    return steps, curves


def _run(arguments: Arguments) -> None:
    if not arguments.runs:
        raise PilotError("give the folders of at least one run")
    if arguments.window < 1:
        raise PilotError("--window must be at least 1")
    if not arguments.output.suffix:
        raise PilotError(f"{arguments.output} names no picture: give a file such as comparison.png")
    curves = {run.name: read_curves(run, arguments.window) for run in arguments.runs}
    if len(curves) < len(set(arguments.runs)):
        raise PilotError("two of the folders have the same name, which curves are told apart by: rename one")
    panels = {
        title: {name: (steps / 1e6, figures[key]) for name, (steps, figures) in curves.items()}
        for key, title in PANELS.items()
    }
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    plot_overlays(arguments.output, panels, "million environment steps")
    print(f"curves of {len(curves)} runs: {arguments.output}")


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``python -m evaluation.compare_runs``."""
    parsed = tyro.cli(Arguments, args=arguments)
    with command_line("evaluation.compare_runs", "interrupted, nothing was written"):
        _run(parsed)


if __name__ == "__main__":
    main(sys.argv[1:])
