"""Progress of long commands: a bar with the time left on a terminal, now and then a line in a log file."""

from __future__ import annotations

import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

LINE_INTERVAL = 30.0
"""Shortest time between two lines where there is no terminal [s]."""


class ProgressReport(Progress):
    """Rich's progress bar, and lines with the same contents where its output is no terminal."""

    def __init__(self, hidden: bool = False, console: Console | None = None) -> None:
        """``hidden``: show nothing, as all ranks but one do; ``console``: standard output by default."""
        self._figures = (TextColumn("{task.percentage:>5.1f}%"), TimeElapsedColumn(), TimeRemainingColumn())
        self._description = TextColumn("{task.description}")
        self._last_line = time.monotonic()
        super().__init__(BarColumn(), *self._figures, self._description, console=console, disable=hidden)

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """As rich has it; takes ``completed``, ``advance``, ``description`` and others."""
        super().update(task_id, **changes)
        if self.console.is_terminal or self.disable or time.monotonic() - self._last_line < LINE_INTERVAL:
            return
        self._last_line = time.monotonic()
        task = self._tasks[task_id]
        self.console.print(*(str(column(task)) for column in (*self._figures, self._description)), highlight=False)

    def say(self, text: str) -> None:
        """Print a line that stays, above the bar."""
        if not self.disable:
            self.console.print(text, highlight=False, markup=False)
