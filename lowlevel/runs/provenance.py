"""The folder of a run: what made it (configuration, versions, revision, seed), and where its training state lies."""

from __future__ import annotations

import json
import platform
import subprocess
import zipfile
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from lowlevel.runs.configs import from_plain
from lowlevel.runs.files import atomic_write
from lowlevel.trainer import STATE_FILE, TrainingConfig
from robots.errors import PilotError

RUN_FILE = "run.json"
_PACKAGES = ("torch", "mujoco", "pin", "numpy", "stable-baselines3", "gymnasium")

Config = TypeVar("Config")


def describe_run(config: Any, **details: Any) -> dict[str, Any]:
    """Everything needed to repeat a run: its ``config`` (a dataclass), ``details`` beside it, and this program."""
    return {
        **details,
        "config": asdict(config, dict_factory=_plain_paths),
        "revision": git_revision(),
        "versions": {name: metadata.version(name) for name in _PACKAGES} | {"python": platform.python_version()},
    }


def _plain_paths(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {name: str(value) if isinstance(value, Path) else value for name, value in items}


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


def read_run_description(folder: Path) -> dict[str, Any]:
    """What :func:`write_run_description` wrote.

    Raises:
        PilotError: if the folder holds no run.
        PilotError: if the file is damaged.
    """
    path = folder / RUN_FILE
    if not path.is_file():
        raise PilotError(f"{folder} holds no {RUN_FILE}: give the folder of a training run")
    try:
        description = json.loads(path.read_text())
    except ValueError as error:
        raise PilotError(f"{path} is damaged: {error}") from error
    if not isinstance(description, dict):
        raise PilotError(f"{path} is damaged: it does not hold a JSON object")
    return description


def read_run_config(folder: Path, kind: type[Config]) -> Config:
    """The configuration, of class ``kind``, of an existing run; paths in it are text.

    Raises:
        PilotError: if the folder holds no run.
        PilotError: if the description is damaged or was written by another version.
    """
    description = read_run_description(folder)
    try:
        return from_plain(kind, description["config"])
    except (ValueError, KeyError, TypeError) as error:
        raise PilotError(f"{folder / RUN_FILE} does not describe a run of this version: {error}") from error


def read_training_config(folder: Path) -> TrainingConfig:
    """The configuration of an existing run of ``train-lowlevel``; raises as :func:`read_run_config`."""
    return read_run_config(folder, TrainingConfig)


def require_unused(folder: Path) -> None:
    """Check that a new run may use ``folder``.

    Raises:
        PilotError: if it holds another one, saved or not.
    """
    if (folder / STATE_FILE).exists():
        raise PilotError(f"{folder} already holds a run: continue it with --resume {folder}, or give another --name")
    if (folder / RUN_FILE).exists():
        raise PilotError(f"{folder} already holds a run that has saved nothing yet: give another --name")


def make_run_folder(folder: Path) -> None:
    """Make the folder of a new run, and claim it: of two runs that ask for it at the same time one gets it.

    Raises:
        PilotError: if that is impossible.
        PilotError: if another run was quicker.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PilotError(f"cannot make the folder {folder} ({error.strerror}): give another --output") from error
    try:
        (folder / RUN_FILE).touch(exist_ok=False)
    except FileExistsError as error:
        raise PilotError(f"another run has just begun in {folder}: give another --name") from error


def find_state(folder: Path) -> Path:
    """The file with the training state of an existing run.

    Raises:
        PilotError: if there is none.
        PilotError: if it is damaged.
    """
    path = folder / STATE_FILE
    if not path.is_file():
        is_run = (folder / RUN_FILE).is_file()
        advice = (
            "the run ended before its first save, so start a new one" if is_run else "give the folder of a training run"
        )
        raise PilotError(f"{folder} holds no {STATE_FILE}: {advice}")
    if not zipfile.is_zipfile(path):  # which is what torch.save writes
        raise PilotError(f"{path} is not a readable training state: it is damaged or truncated")
    return path
