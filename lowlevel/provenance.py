"""What made a run: configuration, versions, revision and seed, written beside the results."""

from __future__ import annotations

import json
import platform
import subprocess
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

from lowlevel.files import atomic_write
from lowlevel.plain import from_plain
from lowlevel.trainer import TrainingConfig

RUN_FILE = "run.json"
_PACKAGES = ("torch", "mujoco", "pin", "numpy", "stable-baselines3", "gymnasium")


def describe_run(config: TrainingConfig, preset: str) -> dict[str, Any]:
    """Everything needed to repeat the run."""
    return {
        "preset": preset,
        "config": asdict(config),
        "revision": git_revision(),
        "versions": {name: metadata.version(name) for name in _PACKAGES} | {"python": platform.python_version()},
    }


def git_revision() -> str:
    """Commit of the source tree, with ``-dirty`` if it has uncommitted changes; ``unknown`` outside a checkout."""
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return described.stdout.strip()


def write_run_description(folder: Path, description: dict[str, Any]) -> None:
    """Write ``run.json``."""
    text = json.dumps(description, indent=2)
    atomic_write(folder / RUN_FILE, lambda file: file.write(text.encode()))


def read_training_config(folder: Path) -> TrainingConfig:
    """The configuration of an existing run.

    Raises:
        FileNotFoundError: if the folder holds no run.
        ValueError: if the description is damaged or was written by another version.
    """
    path = folder / RUN_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no {RUN_FILE}: give the folder of a training run")
    try:
        return from_plain(TrainingConfig, json.loads(path.read_text())["config"])
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} does not describe a run of this version: {error}") from error
