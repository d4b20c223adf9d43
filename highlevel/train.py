"""``train-highlevel``: train a planner for a task on a frozen controller."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

from highlevel.learning.config import PlannerTrainingConfig
from highlevel.learning.demonstrations import Demonstrations
from highlevel.registration import find_controller
from highlevel.run_folder import BEST_FOLDER, create_run, read_config
from highlevel.trainer import PlannerTrainer
from lowlevel.runs.command_line import command_line
from lowlevel.runs.provenance import require_unused
from robots.errors import PilotError


@dataclass(frozen=True)
class Arguments:
    """Train a planner with Stable-Baselines3 PPO: demonstrations of the scripted expert, cloning, then PPO."""

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
    with command_line("train-highlevel", "interrupted before training began"):
        trainer = _resumed(given, parsed.resume) if parsed.resume else _fresh(parsed)
        print(f"training in {trainer.folder}", flush=True)
        trainer.run()
    if trainer.best_rate >= 0:
        best = trainer.folder / BEST_FOLDER
        print(f"best planner {best} with {trainer.best_rate:.1%} success on the selection episodes")
    if not trainer.is_finished:
        print(f"train-highlevel: stopped; continue with --resume {trainer.folder}", file=sys.stderr)
        sys.exit(130)


def _fresh(arguments: Arguments) -> PlannerTrainer:
    folder = arguments.output / (arguments.name or f"{arguments.config.task}-{time.strftime('%Y%m%d-%H%M%S')}")
    require_unused(folder)
    config = replace(arguments.config, controller=find_controller(arguments.config.controller).resolve())
    if config.demonstration_file is not None:
        config = replace(config, demonstration_file=config.demonstration_file.resolve())
    trainer = _trainer(config, folder)
    if config.demonstration_file is not None:
        # A file that cannot be used is refused before anything is written.
        Demonstrations.load(config.demonstration_file).source.require_like(trainer.source)
    create_run(folder, config)
    trainer.save()
    return trainer


def _resumed(given: list[str], folder: Path) -> PlannerTrainer:
    others = [word for word in given if word.startswith("--") and word.partition("=")[0] != "--resume"]
    if others:
        raise PilotError("--resume takes the configuration of the run it continues: leave the other options out")
    trainer = _trainer(read_config(folder), folder)
    trainer.load()
    return trainer


def _trainer(config: PlannerTrainingConfig, folder: Path) -> PlannerTrainer:
    # Physics and learning take turns on the same cores.
    torch.set_num_threads(config.num_threads)
    return PlannerTrainer(config, folder)


if __name__ == "__main__":
    main()
