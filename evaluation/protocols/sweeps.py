"""Success over grids of conditions: the sweeps that a task names, as tables and heat maps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.reporting.plots import plot_heat_map
from evaluation.reporting.reports import format_figure, markdown_table
from evaluation.reporting.statistics import Figure, share_figure
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

    @property
    def axes(self) -> str:
        """What is varied, in words."""
        sweep = self.sweep
        return sweep.rows.label if sweep.columns is None else f"{sweep.rows.label} and {sweep.columns.label}"

    @property
    def table(self) -> str:
        """Of all cells, in Markdown."""
        rows = [
            [label, *(format_figure(figure) for figure in row)]
            for label, row in zip(self.row_labels, self.cells, strict=True)
        ]
        return markdown_table([self.sweep.rows.label, *self.column_labels], rows)

    @property
    def picture(self) -> str:
        """Name of the file of its heat map."""
        return f"sweep_{self.sweep.name}.png"


def cells(task: Task, sweep: Sweep) -> Iterator[Task]:
    """Fresh copies of ``task``, one per cell, row by row."""
    factory: Any = type(task)
    config: Any = task.config  # type: ignore[attr-defined]
    for value in sweep.rows.values:
        fixed = sweep.rows.fix(config, value)
        if sweep.columns is None:
            yield factory(fixed)
            continue
        for other in sweep.columns.values:
            yield factory(sweep.columns.fix(fixed, other))


def sweep_result(sweep: Sweep, records: Sequence[list[EpisodeRecord]]) -> SweepResult:
    """Success in every cell, of whose episodes ``records`` has a list each, row by row."""
    figures = [share_figure([record.success for record in cell]) for cell in records]
    width = 1 if sweep.columns is None else len(sweep.columns.values)
    return SweepResult(sweep, tuple(tuple(figures[i : i + width]) for i in range(0, len(figures), width)))


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
            folder / result.picture,
            values,
            result.row_labels,
            result.column_labels,
            "full success [%]",
            decimals=0,
            limits=(0.0, 100.0),
            axes=(result.sweep.rows.label, "" if columns is None else columns.label),
            colors="YlGn",
        )
