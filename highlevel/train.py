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
from highlevel.registry import find_controller
from highlevel.trainer import BEST_FOLDER, PlannerTrainer
from lowlevel.runs.command_line import command_line
from lowlevel.runs.run_folder import RunFolder, resumed_run


@dataclass(frozen=True)
class Arguments:
    """Train a planner with Stable-Baselines3 PPO: demonstrations of the scripted expert, cloning, then PPO."""

    config: Annotated[PlannerTrainingConfig, tyro.conf.arg(name="")]
    output: Path = Path("runs/highlevel")
    """Parent folder of the run's folder."""
    name: str = ""
    """Name of the run's folder; task and time by default."""
    resume: Path | None = None
    """Folder of a run to continue with its own configuration; options given beside it replace parts of that."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``train-highlevel``."""
    given = sys.argv[1:] if arguments is None else arguments
    with command_line("train-highlevel", "interrupted before training began"):
        parsed = tyro.cli(Arguments, args=given, default=Arguments(config=_default_config(given)))
        trainer = _resumed(parsed.config, parsed.resume) if parsed.resume else _fresh(parsed)
        print(f"training in {trainer.run.path}", flush=True)
        trainer.train()
    if trainer.best_rate > 0:
        best = trainer.run.path / BEST_FOLDER
        print(f"best planner {best} with {trainer.best_rate:.1%} success on the selection episodes")
    elif trainer.best_rate == 0:
        print("no planner has succeeded in a selection episode yet")
    if not trainer.is_finished:
        print(f"train-highlevel: stopped; continue with --resume {trainer.run.path}", file=sys.stderr)
        sys.exit(130)


def _fresh(arguments: Arguments) -> PlannerTrainer:
    folder = arguments.output / (arguments.name or f"{arguments.config.task}-{time.strftime('%Y%m%d-%H%M%S')}")
    RunFolder(folder).require_unused()
    config = replace(arguments.config, controller=find_controller(arguments.config.controller).resolve())
    if config.demonstration_file is not None:
        config = replace(config, demonstration_file=config.demonstration_file.resolve())
    if config.warm_start is not None:
        config = replace(config, warm_start=config.warm_start.resolve())
    trainer = _trainer(config, folder)
    # What cannot be used is refused before anything is written.
    if config.demonstration_file is not None:
        Demonstrations.load(config.demonstration_file).source.require_like(trainer.source)
    if config.warm_start is not None:
        trainer.earlier_planner(config.warm_start)
    trainer.run.claim()
    trainer.run.describe(config)
    trainer.save()
    return trainer


def _default_config(given: list[str]) -> PlannerTrainingConfig:
    """A run that is continued decides the defaults of everything else."""
    run = resumed_run(given)
    if run is None:
        return PlannerTrainingConfig()
    config = run.config(PlannerTrainingConfig)
    controller, demonstrations, earlier = (
        None if path is None else Path(path)
        for path in (config.controller, config.demonstration_file, config.warm_start)
    )
    return replace(config, controller=controller, demonstration_file=demonstrations, warm_start=earlier)


def _resumed(config: PlannerTrainingConfig, folder: Path) -> PlannerTrainer:
    trainer = _trainer(config, folder)
    trainer.load()
    trainer.run.describe(config)
    return trainer


def _trainer(config: PlannerTrainingConfig, folder: Path) -> PlannerTrainer:
    # Physics and learning take turns on the same cores.
    torch.set_num_threads(config.num_threads)
    return PlannerTrainer(config, folder)


if __name__ == "__main__":
    main()
