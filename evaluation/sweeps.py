"""Success over grids of conditions: the sweeps that a task names, as tables and heat maps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.plots import plot_heat_map
from evaluation.reports import format_figure, markdown_table
from evaluation.statistics import Figure, share_figure
from highlevel.episodes import EpisodeRecord
from highlevel.task import Sweep, Task


@dataclass(frozen=True)
class SweepResult:
    """Full success in every cell of a sweep."""

    sweep: Sweep
    cells: tuple[tuple[Figure, ...], ...]
    """Rows of cells."""

    @property
    def row_labels(self) -> list[str]:
        return [f"{value:g}" for value in self.sweep.rows.values]

    @property
    def column_labels(self) -> list[str]:
        columns = self.sweep.columns
        return ["full success"] if columns is None else [f"{value:g}" for value in columns.values]


def cells(task: Task, sweep: Sweep) -> Iterator[tuple[int, Task]]:
    """Fresh copies of ``task``, one per cell, row by row, each with the number of its row."""
    factory: Any = type(task)
    config: Any = task.config  # type: ignore[attr-defined]
    for row, value in enumerate(sweep.rows.values):
        fixed = sweep.rows.fix(config, value)
        if sweep.columns is None:
            yield row, factory(fixed)
            continue
        for other in sweep.columns.values:
            yield row, factory(sweep.columns.fix(fixed, other))


def run_sweep(task: Task, sweep: Sweep, run: Callable[[Task], list[EpisodeRecord]]) -> SweepResult:
    """Run every cell's episodes with ``run``."""
    rows: list[list[Figure]] = [[] for _ in sweep.rows.values]
    for row, variant in cells(task, sweep):
        rows[row].append(share_figure([record.success for record in run(variant)]))
    return SweepResult(sweep, tuple(tuple(row) for row in rows))


def sweep_figures(results: list[SweepResult]) -> dict[str, Figure]:
    """``full_<sweep>_<row>[_<column>]`` for every cell."""
    figures = {}
    for result in results:
        for row, label in zip(result.cells, result.row_labels, strict=True):
            for figure, column in zip(row, result.column_labels, strict=True):
                suffix = "" if result.sweep.columns is None else f"_{column}"
                figures[f"full_{result.sweep.name}_{label}{suffix}"] = figure
    return figures


def write_plots(folder: Path, results: list[SweepResult]) -> None:
    """One heat map [%] per sweep."""
    for result in results:
        values = np.array([[100.0 * (figure.value or 0.0) for figure in row] for row in result.cells])
        columns = result.sweep.columns
        plot_heat_map(
            folder / _picture(result),
            values,
            result.row_labels,
            result.column_labels,
            "full success [%]",
            decimals=0,
            limits=(0.0, 100.0),
            axes=(result.sweep.rows.label, "" if columns is None else columns.label),
            colors="YlGn",
        )


def report_lines(results: list[SweepResult]) -> list[str]:
    """Section of the report."""
    count = results[0].cells[0][0].n
    note = f"Full success over {count} episodes a cell, the same ones in every cell but for what it fixes."
    lines = ["## Sweeps", "", note, ""]
    for result in results:
        rows = [
            [label, *(format_figure(figure) for figure in row)]
            for label, row in zip(result.row_labels, result.cells, strict=True)
        ]
        lines += [
            f"### {_axes(result.sweep).capitalize()}",
            "",
            markdown_table([result.sweep.rows.label, *result.column_labels], rows),
            f"![{result.sweep.name}]({_picture(result)})",
            "",
        ]
    return lines


def _axes(sweep: Sweep) -> str:
    return sweep.rows.label if sweep.columns is None else f"{sweep.rows.label} and {sweep.columns.label}"


def _picture(result: SweepResult) -> str:
    return f"sweep_{result.sweep.name}.png"
