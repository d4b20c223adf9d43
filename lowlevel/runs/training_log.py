"""``log.jsonl`` of a run: one JSON object per line with a counter that grows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import IO

from lowlevel.runs.files import atomic_write

LOG_FILE = "log.jsonl"


def write_entry(file: IO[str], entry: Mapping[str, float]) -> None:
    """Append ``entry`` to an open log, six digits of every number."""
    file.write(json.dumps({name: float(f"{value:.6g}") for name, value in entry.items()}) + "\n")
    file.flush()


def drop_entries_after(path: Path, counter: str, last: int) -> None:
    """Remove the lines of the log at ``path`` that a killed run wrote after its last save, when ``counter`` was
    ``last``."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text().splitlines():
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:  # the line that was being written when the run was killed
            break
        if entry[counter] > last:
            break
        kept.append(line)
    atomic_write(path, lambda file: file.write("".join(f"{line}\n" for line in kept).encode()))
