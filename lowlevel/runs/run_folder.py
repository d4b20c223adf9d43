"""The folder of a training run, the same at both levels: what made it, how far it has come, and what it logged.

===================================  ==========================================================================
``run.json``                         configuration, versions and revision, and those of every start before
``training_state.pt``                everything needed to continue
``log.jsonl``, ``tensorboard/``      figures
===================================  ==========================================================================
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import subprocess
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, TypeVar

import torch
from torch.utils.tensorboard import SummaryWriter

from lowlevel.runs.configs import from_plain
from lowlevel.runs.files import atomic_write
from robots.errors import PilotError

RUN_FILE, STATE_FILE, LOG_FILE, TENSORBOARD_FOLDER = "run.json", "training_state.pt", "log.jsonl", "tensorboard"
_PACKAGES = ("torch", "mujoco", "pin", "numpy", "stable-baselines3", "gymnasium")

Config = TypeVar("Config")


class RunFolder:
    """Reads and writes the files of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._writer: SummaryWriter | None = None

    def require_unused(self) -> None:
        """Check that a new run may use the folder.

        Raises:
            PilotError: if it holds another one, saved or not.
        """
        if (self.path / STATE_FILE).exists():
            raise PilotError(
                f"{self.path} already holds a run: continue it with --resume {self.path}, or give another --name"
            )
        if (self.path / RUN_FILE).exists():
            raise PilotError(f"{self.path} already holds a run that has saved nothing yet: give another --name")

    def claim(self) -> None:
        """Make the folder of a new run; of two runs that ask for it at the same time one gets it.

        Raises:
            PilotError: if that is impossible, or another run was quicker.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise PilotError(f"cannot make the folder {self.path} ({error.strerror}): give another --output") from error
        try:
            (self.path / RUN_FILE).touch(exist_ok=False)
        except FileExistsError as error:
            raise PilotError(f"another run has just begun in {self.path}: give another --name") from error

    # -- what made it -----------------------------------------------------------------------------------------

    def describe(self, config: Any, **details: Any) -> None:
        """Write down what makes the run from now on; what made it until now moves to "earlier"."""
        earlier = []
        if (self.path / RUN_FILE).is_file() and (self.path / RUN_FILE).stat().st_size > 0:
            before = self.description()
            earlier = [*before.pop("earlier", []), before]
        text = json.dumps(describe_run(config, **details) | {"earlier": earlier}, indent=2)
        atomic_write(self.path / RUN_FILE, lambda file: file.write(text.encode()))

    def description(self) -> dict[str, Any]:
        """What :meth:`describe` wrote.

        Raises:
            PilotError: if the folder holds no run, or the file is damaged.
        """
        path = self.path / RUN_FILE
        if not path.is_file():
            raise PilotError(f"{self.path} holds no {RUN_FILE}: give the folder of a training run")
        try:
            description = json.loads(path.read_text())
        except ValueError as error:
            raise PilotError(f"{path} is damaged: {error}") from error
        if not isinstance(description, dict):
            raise PilotError(f"{path} is damaged: it does not hold a JSON object")
        return description

    def config(self, kind: type[Config]) -> Config:
        """The configuration, of class ``kind``; paths in it are text.

        Raises:
            PilotError: if the folder holds no run, or its description is damaged or was written by another version.
        """
        description = self.description()
        try:
            return from_plain(kind, description["config"])
        except (ValueError, KeyError, TypeError) as error:
            raise PilotError(f"{self.path / RUN_FILE} does not describe a run of this version: {error}") from error

    # -- how far it has come ----------------------------------------------------------------------------------

    def save(self, state: Mapping[str, Any]) -> Path:
        """Write the training state; a crash while writing leaves the previous one intact."""
        path = self.path / STATE_FILE
        atomic_write(path, lambda file: torch.save(dict(state), file))
        return path

    def load(self) -> dict[str, Any]:
        """The training state; only tensors and plain values are ever unpickled.

        Raises:
            PilotError: if there is none, or it is damaged.
        """
        path = self.path / STATE_FILE
        if not path.is_file():
            is_run = (self.path / RUN_FILE).is_file()
            advice = "the run ended before its first save, so start a new one"
            raise PilotError(
                f"{self.path} holds no {STATE_FILE}: {advice if is_run else 'give the folder of a training run'}"
            )
        if not zipfile.is_zipfile(path):  # which is what torch.save writes
            raise PilotError(f"{path} is not a readable training state: it is damaged or truncated")
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except (RuntimeError, EOFError, OSError, ValueError, UnpicklingError) as error:
            first_line = str(error).splitlines()[0]
            raise PilotError(f"{path} is not a readable training state: {first_line}") from error

    # -- what it logged ---------------------------------------------------------------------------------------

    def log(self, figures: Mapping[str, float], seconds: float, counter: str, count: int) -> None:
        """Append the finite ``figures`` to ``log.jsonl`` and TensorBoard, at ``count`` of what ``counter`` names."""
        finite = {name: value for name, value in figures.items() if math.isfinite(value)}
        self.plot(finite, count)
        entry = {counter: count, "seconds": seconds, **finite}
        with (self.path / LOG_FILE).open("a") as file:
            file.write(json.dumps({name: float(f"{value:.6g}") for name, value in entry.items()}) + "\n")

    def plot(self, figures: Mapping[str, float], count: int) -> None:
        """Show ``figures`` in TensorBoard alone."""
        if self._writer is None:
            self._writer = SummaryWriter(str(self.path / TENSORBOARD_FOLDER))
        for name, value in figures.items():
            self._writer.add_scalar(name, value, count)

    def drop_log_after(self, counter: str, last: int) -> None:
        """Remove what a killed run logged after its last save, when ``counter`` was ``last``; before logging."""
        self._writer = SummaryWriter(str(self.path / TENSORBOARD_FOLDER), purge_step=last + 1)
        path = self.path / LOG_FILE
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


def resumed_run(arguments: Sequence[str]) -> RunFolder | None:
    """The run that ``--resume`` names among the ``arguments`` of a command, whose options it sets the defaults of."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", type=Path)
    path = parser.parse_known_args(list(arguments))[0].resume
    return None if path is None else RunFolder(path)


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
    """Commit of the source tree, with ``-dirty`` if it has uncommitted changes; ``unknown`` outside its checkout."""
    source = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=source, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        # Installed into another project's environment, the source lies in that one's checkout.
        if Path(git("rev-parse", "--show-toplevel")).resolve() != source:
            return "unknown"
        return git("describe", "--always", "--dirty", "--abbrev=12")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
