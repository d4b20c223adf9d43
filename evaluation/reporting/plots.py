"""Plots of the evaluation reports, drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot

from evaluation.reporting.statistics import Figure

_RESOLUTION = 120


def plot_bars(
    path: Path,
    panels: Mapping[str, Mapping[str, Figure]],
    references: Mapping[str, float] | None = None,
    columns: int = 4,
) -> None:
    """One panel per quantity, one bar with its interval per case, ``references`` as dashed lines."""
    canvas, axes = _panels(len(panels), columns, height=2.8)
    for axis, (title, bars) in zip(axes, panels.items(), strict=False):
        known = [(label, figure) for label, figure in bars.items() if figure.value is not None]
        for place, (_, figure) in enumerate(known):
            value = figure.value or 0.0
            low, high = figure.ci95 or (value, value)
            spread = [[max(0.0, value - low)], [max(0.0, high - value)]]
            axis.bar(place, value, yerr=spread, capsize=3, color=f"C{place}")
        axis.set_xticks(range(len(known)), [label for label, _ in known], rotation=30, ha="right", fontsize=8)
        unit = next((figure.unit for _, figure in known), "")
        axis.set_title(title if unit in ("", "1") else f"{title} [{unit}]", fontsize=10)
        if references and title in references:
            axis.axhline(references[title], color="black", linestyle="--", linewidth=1, label="paper")
            axis.legend(fontsize=8)
    _save(canvas, path)


def plot_scatter(
    path: Path, panels: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]], columns: int = 4
) -> None:
    """One panel per quantity, in it one point per episode: ours across, of each other controller upwards."""
    canvas, axes = _panels(len(panels), columns, height=3.2)
    for axis, (title, cases) in zip(axes, panels.items(), strict=False):
        for label, (ours, theirs) in cases.items():
            axis.scatter(ours, theirs, s=6, alpha=0.5, label=label)
        largest = np.nanmax([0.0, *(np.nanmax(values, initial=0.0) for pair in cases.values() for values in pair)])
        axis.plot([0.0, largest], [0.0, largest], color="black", linewidth=1)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("ours", fontsize=8)
    axes[0].legend(fontsize=8)
    _save(canvas, path)


def plot_curves(
    path: Path,
    time: np.ndarray,
    curves: np.ndarray,
    titles: Sequence[str],
    label: str = "time [s]",
    columns: int = 4,
) -> None:
    """One panel per column of ``curves`` (T, panels) over ``time`` (T,)."""
    canvas, axes = _panels(len(titles), columns, height=2.4)
    for axis, title, curve in zip(axes, titles, curves.T, strict=False):
        axis.plot(time, curve, linewidth=1)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel(label, fontsize=8)
        axis.set_ylim(bottom=0.0)
    _save(canvas, path)


def plot_overlays(
    path: Path, panels: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]], label: str, columns: int = 4
) -> None:
    """One panel per title, in it one named curve (x (T,), y (T,)) per case; cases keep their colors."""
    canvas, axes = _panels(len(panels), columns, height=2.6)
    for axis, (title, curves) in zip(axes, panels.items(), strict=False):
        for name, (x, y) in curves.items():
            axis.plot(x, y, linewidth=1, label=name)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel(label, fontsize=8)
    axes[0].legend(fontsize=7)
    _save(canvas, path)


def plot_heat_map(
    path: Path,
    values: np.ndarray,
    rows: Sequence[str],
    columns: Sequence[str],
    title: str,
    decimals: int = 3,
    limits: tuple[float, float] | None = None,
    axes: tuple[str, str] = ("", ""),
    colors: str = "coolwarm",
) -> None:
    """``values`` (rows, columns) with their numbers written in; NaN stays blank.

    ``limits`` are those of the ``colors``, Matplotlib's name of a map; ``axes`` say what rows and columns are.
    """
    low, high = (None, None) if limits is None else limits
    canvas, axis = pyplot.subplots(figsize=(1.6 + 1.1 * len(columns), 1.4 + 0.5 * len(rows)))
    image = axis.imshow(values, cmap=colors, aspect="auto", vmin=low, vmax=high)
    axis.set_xticks(range(len(columns)), columns)
    axis.set_yticks(range(len(rows)), rows)
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            is_dark = np.mean(image.cmap(image.norm(value))[:3]) < 0.45
            ink = "white" if is_dark else "black"
            axis.text(column, row, f"{value:.{decimals}f}", ha="center", va="center", fontsize=9, color=ink)
    axis.set_ylabel(axes[0])
    axis.set_xlabel(axes[1])
    axis.set_title(title, fontsize=10)
    canvas.colorbar(image)
    _save(canvas, path)


def _panels(count: int, columns: int, height: float) -> tuple[pyplot.Figure, list[pyplot.Axes]]:
    """A canvas of ``count`` panels, each ``height`` [in] high, in rows of ``columns``."""
    rows = -(-count // columns)
    canvas, axes = pyplot.subplots(rows, columns, figsize=(3.2 * columns, height * rows), squeeze=False)
    for axis in axes.flat[count:]:
        axis.set_visible(False)
    return canvas, list(axes.flat[:count])


def _save(canvas: pyplot.Figure, path: Path) -> None:
    canvas.tight_layout()
    canvas.savefig(path, dpi=_RESOLUTION)
    pyplot.close(canvas)
