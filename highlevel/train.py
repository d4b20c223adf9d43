"""``train-highlevel``: train a planner for a task on a frozen controller."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

from highlevel.registration import find_controller
from highlevel.trainer import (
    BEST_FOLDER,
    STATE_FILE,
    PlannerTrainer,
    PlannerTrainingConfig,
    read_run_description,
    write_run_description,
)


@dataclass(frozen=True)
class Arguments:
    """Train a planner with Stable-Baselines3 PPO: demonstrations of the scripted expert, cloning, then
    PPO."""

    config: Annotated[PlannerTrainingConfig, tyro.conf.arg(name="")]
    output: Path = Path("runs/highlevel")
    """Parent folder of the run's folder."""
    name: str = ""
    """Name of the run's folder; task and time by default."""
    resume: Path | None = None
    """Folder of a run to continue; its own configuration is used and all other options must be left out."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``train-highlevel``."""
    given = sys.argv[1:] if arguments is None else arguments
    parsed = tyro.cli(Arguments, args=given, default=Arguments(config=PlannerTrainingConfig()))
    try:
        if parsed.resume is not None and len(given) > 2:
            raise ValueError("--resume takes the configuration of the run it continues: leave the other options out")
        run(parsed)
    except (ValueError, FileNotFoundError, FileExistsError, OSError, RuntimeError) as error:
        sys.exit(f"train-highlevel: {error}")


def run(arguments: Arguments) -> PlannerTrainer:
    """Train as ``arguments`` say, and return the finished trainer."""
    trainer = _resumed(arguments.resume) if arguments.resume else _fresh(arguments)
    print(f"training in {trainer.folder}", flush=True)
    trainer.run()
    best = f"best planner {trainer.folder / BEST_FOLDER} with {trainer.best_rate:.1%} success on the selection episodes"
    print(f"{best if trainer.best_rate >= 0 else 'no planner yet'}; results lie in {trainer.folder}")
    return trainer


def _fresh(arguments: Arguments) -> PlannerTrainer:
    folder = arguments.output / (arguments.name or f"{arguments.config.task}-{time.strftime('%Y%m%d-%H%M%S')}")
    if (folder / STATE_FILE).exists():
        raise FileExistsError(
            f"{folder} already holds a run: continue it with --resume {folder}, or give another --name"
        )
    config = replace(arguments.config, controller=find_controller(arguments.config.controller).resolve())
    # Physics and learning take turns on the same cores.
    torch.set_num_threads(config.num_threads)
    trainer = PlannerTrainer(config, folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_run_description(folder, config)
    trainer.save()
    return trainer


def _resumed(folder: Path) -> PlannerTrainer:
    config = read_run_description(folder)
    torch.set_num_threads(config.num_threads)
    trainer = PlannerTrainer(config, folder)
    trainer.load()
    return trainer


if __name__ == "__main__":
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    main()
