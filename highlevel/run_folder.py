"""The folder of a training run: what made it, how far it has come, and what it logged.

===============================  ======================================================
``run.json``                     configuration, versions, revision
``demonstrations.npz``           successful episodes of the scripted expert
``cloned/``                      planner after behaviour cloning
``best/``                        planner with the highest success rate on the selection episodes
``training_state.pt``            everything needed to continue
``log.jsonl``, ``tensorboard/``  figures
===============================  ======================================================
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch.utils.tensorboard import SummaryWriter

from highlevel.learning.config import PlannerTrainingConfig
from lowlevel.runs.files import atomic_write
from lowlevel.runs.provenance import describe_run, find_state, make_run_folder, read_run_config, write_run_description
from lowlevel.runs.training_log import LOG_FILE, drop_entries_after, write_entry
from lowlevel.trainer import STATE_FILE, read_training_state

DEMONSTRATIONS_FILE = "demonstrations.npz"
CLONED_FOLDER, BEST_FOLDER, TENSORBOARD_FOLDER = "cloned", "best", "tensorboard"


def create_run(folder: Path, config: PlannerTrainingConfig) -> None:
    """Make the folder of a new run and write down what makes it."""
    make_run_folder(folder)
    write_run_description(folder, describe_run(config))


def read_config(folder: Path) -> PlannerTrainingConfig:
    """The configuration of an existing run.

    Raises:
        PilotError: if the folder holds no run, or its description is damaged or was written by another version.
    """
    config = read_run_config(folder, PlannerTrainingConfig)
    controller, demonstrations = (
        None if path is None else Path(path) for path in (config.controller, config.demonstration_file)
    )
    return replace(config, controller=controller, demonstration_file=demonstrations)


def write_state(folder: Path, state: dict[str, Any]) -> None:
    """Write the training state; a crash while writing leaves the previous one intact."""
    atomic_write(folder / STATE_FILE, lambda file: torch.save(state, file))


def read_state(folder: Path) -> dict[str, Any]:
    """The training state.

    Raises:
        PilotError: if the run ended before it saved one, or it is damaged.
    """
    return read_training_state(find_state(folder))


def log_figures(folder: Path, figures: dict[str, float], decisions: int, seconds: float) -> None:
    """Append the finite ``figures`` to ``log.jsonl`` and TensorBoard, after so many ``decisions`` and ``seconds``."""
    figures = {name: value for name, value in figures.items() if math.isfinite(value)}
    with SummaryWriter(str(folder / TENSORBOARD_FOLDER)) as writer:
        for name, value in figures.items():
            writer.add_scalar(name, value, decisions)
    with (folder / LOG_FILE).open("a") as file:
        write_entry(file, {"decisions": decisions, "seconds": seconds, **figures})


def drop_log_after(folder: Path, decisions: int) -> None:
    """Remove from ``log.jsonl`` and TensorBoard what a killed run wrote after its last save, ``decisions`` into
    training."""
    drop_entries_after(folder / LOG_FILE, "decisions", decisions)
    SummaryWriter(str(folder / TENSORBOARD_FOLDER), purge_step=decisions + 1).close()
