"""``train-lowlevel``: train a PILOT controller."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

from lowlevel import distributed
from lowlevel.export import export_controller
from lowlevel.presets import PRESETS
from lowlevel.provenance import describe_run, read_training_config, write_run_description
from lowlevel.trainer import STATE_FILE, Trainer, TrainingConfig, read_training_state


@dataclass(frozen=True)
class Arguments:
    """Train a PILOT controller for the Unitree G1."""

    config: Annotated[TrainingConfig, tyro.conf.arg(name="")]
    preset: str = "flat"
    """Named configuration to start from, a key of lowlevel.presets.PRESETS."""
    output: Path = Path("runs/lowlevel")
    """Parent folder of the run's folder."""
    name: str = ""
    """Name of the run's folder; preset and time by default."""
    resume: Path | None = None
    """Folder of a run to continue with its own configuration; options given beside it replace parts of that."""
    warm_start: Path | None = None
    """Folder of a run whose networks, optimisers and curriculum a new run starts from."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``train-lowlevel``."""
    try:
        _run(sys.argv[1:] if arguments is None else arguments)
    except (ValueError, FileNotFoundError, FileExistsError, OSError) as error:
        sys.exit(f"train-lowlevel: {error}")


def _run(arguments: list[str]) -> None:
    chosen = _choose(arguments)
    if chosen.preset not in PRESETS:
        raise ValueError(f"unknown preset {chosen.preset!r}; choose one of {', '.join(PRESETS)}")
    config = read_training_config(chosen.resume) if chosen.resume else PRESETS[chosen.preset]
    parsed = tyro.cli(
        Arguments,
        args=arguments,
        default=Arguments(config=config, preset=chosen.preset),
        description="Train a PILOT controller. Defaults below are those of the chosen preset or resumed run.",
    )
    device = distributed.start(parsed.config.device)
    # Physics and learning take turns on the same cores.
    torch.set_num_threads(max(1, parsed.config.environment.num_threads))
    try:
        trainer = _resumed(parsed) if parsed.resume else _fresh(parsed, device)
        if distributed.rank() == 0:
            write_run_description(trainer.folder, describe_run(parsed.config, parsed.preset))
            print(f"training in {trainer.folder}", flush=True)
        trainer.train()
        if distributed.rank() == 0:
            export_controller(trainer, trainer.folder / "controller")
            print(
                f"{trainer.steps} steps in {trainer.trained_seconds / 3600:.2f} h; the controller lies in "
                f"{trainer.folder / 'controller'}"
            )
    finally:
        distributed.stop()


def _choose(arguments: list[str]) -> argparse.Namespace:
    """Preset and resumed run decide the defaults of everything else, so they are read first."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--preset", default="flat")
    parser.add_argument("--resume", type=Path, default=None)
    return parser.parse_known_args(arguments)[0]


def _fresh(parsed: Arguments, device: torch.device) -> Trainer:
    folder = parsed.output / (parsed.name or f"{parsed.preset}-{time.strftime('%Y%m%d-%H%M%S')}")
    if (folder / STATE_FILE).exists():
        raise FileExistsError(
            f"{folder} already holds a run: continue it with --resume {folder}, or give another --name"
        )
    trainer = Trainer(replace(parsed.config, device=str(device)), folder)
    if parsed.warm_start:
        trainer.load_learning(read_training_state(_state_path(parsed.warm_start)))
    folder.mkdir(parents=True, exist_ok=True)
    return trainer


def _resumed(parsed: Arguments) -> Trainer:
    assert parsed.resume is not None
    path = _state_path(parsed.resume)
    trainer = Trainer(parsed.config, parsed.resume)
    trainer.load(path)
    return trainer


def _state_path(folder: Path) -> Path:
    path = folder / STATE_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no {STATE_FILE}: give the folder of a training run")
    return path


if __name__ == "__main__":
    main()
