"""What every evaluation leaves behind: ``metrics.json``, ``report.md`` and plots, all of them or none."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jinja2

from evaluation.reporting.statistics import Figure
from lowlevel.runs.run_folder import git_revision
from robots.errors import PilotError

METRICS_FILE, REPORT_FILE = "metrics.json", "report.md"

_TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    autoescape=False,
)


def check_output(folder: Path) -> None:
    """Find out before hours of work whether results can be written to ``folder``; creates nothing.

    Raises:
        PilotError: if they cannot.
    """
    existing = folder.absolute()
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise PilotError(f"cannot write to {folder}: {existing} is not a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise PilotError(f"cannot write to {folder}: no permission to write in {existing}")


def write_results(folder: Path, write: Callable[[Path], None]) -> None:
    """Let ``write`` fill an empty folder and move its files into ``folder``, untouched by failures."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        write(staging)
        folder.mkdir(exist_ok=True)
        for file in sorted(staging.iterdir()):
            os.replace(file, folder / file.name)
    finally:
        shutil.rmtree(staging)


def metrics(
    figures: Mapping[str, Figure],
    seed: int,
    controller: str | None,
    planner: str | None = None,
    **details: Any,
) -> dict[str, Any]:
    """Contents of ``metrics.json``; ``controller`` and ``planner`` are content hashes."""
    return {
        "figures": {name: asdict(figure) for name, figure in figures.items()},
        "seed": seed,
        "controller": controller,
        "planner": planner,
        "revision": git_revision(),
        **details,
    }


def write_metrics(folder: Path, content: Mapping[str, Any]) -> None:
    """Write ``metrics.json``."""
    write_json(folder / METRICS_FILE, content)


def write_json(path: Path, content: Any) -> None:
    """Write JSON; raises ValueError if a number is not finite."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")


def markdown_table(header: list[str], rows: list[list[str]]) -> str:
    """A table whose first column is text and whose others are numbers."""
    rule = ["---"] + ["---:"] * (len(header) - 1)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [header, rule, *rows]) + "\n"


def render(template: str, **values: Any) -> str:
    """Markdown from ``templates/<template>.md.j2``, in which figures can be filtered by ``figure`` (with digits)."""
    return _TEMPLATES.get_template(f"{template}.md.j2").render(**values)


def format_figure(figure: Figure, digits: int = 3) -> str:
    """Value and interval, such as ``0.145 [0.140, 0.151]``."""
    if figure.value is None:
        return "–"
    text = f"{figure.value:.{digits}f}"
    if figure.ci95 is not None:
        text += f" [{figure.ci95[0]:.{digits}f}, {figure.ci95[1]:.{digits}f}]"
    return text


_TEMPLATES.filters["figure"] = format_figure
