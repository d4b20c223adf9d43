"""Crash-safe writes."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO


def atomic_write(path: Path, writer: Callable[[BinaryIO], Any]) -> None:
    """Let ``writer`` fill a temporary file in the same folder, flush it to disk, then move it to ``path``."""
    path = Path(path)
    # One fixed name: what a killed process leaves behind is overwritten by the next write.
    temporary = path.with_name(f".{path.name}.partial")
    try:
        with temporary.open("wb") as file:
            writer(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
