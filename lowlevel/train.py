"""``train-lowlevel``: train a PILOT controller."""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

from lowlevel import distributed
from lowlevel.export import export_controller
from lowlevel.presets import PRESETS
from lowlevel.provenance import describe_run, write_run_description
from lowlevel.trainer import STATE_FILE, Trainer, TrainingConfig


@dataclass(frozen=True)
class Arguments:
    """Train a PILOT controller for the Unitree G1."""

    config: Annotated[TrainingConfig, tyro.conf.arg(name="")]
    output: Path = Path("runs/lowlevel")
    """Parent folder of the run's folder."""
    name: str = ""
    """Name of the run's folder; preset and time by default."""
    resume: Path | None = None
    """Folder of a run to continue; its own configuration is used and all other options must be left out."""
    warm_start: Path | None = None
    """Folder of a run whose networks, optimisers and curriculum a new run starts from."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``train-lowlevel``."""
    try:
        _run(sys.argv[1:] if arguments is None else arguments)
    except (ValueError, FileNotFoundError, FileExistsError, OSError) as error:
        sys.exit(f"train-lowlevel: {error}")


def _run(arguments: list[str]) -> None:
    preset_parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    preset_parser.add_argument("--preset", default="flat")
    chosen, rest = preset_parser.parse_known_args(arguments)
    if chosen.preset not in PRESETS:
        raise ValueError(f"unknown preset {chosen.preset!r}; choose one of {', '.join(PRESETS)}")
    parsed = tyro.cli(
        Arguments,
        args=rest,
        default=Arguments(config=PRESETS[chosen.preset]),
        description=f"Train a PILOT controller. --preset is one of {', '.join(PRESETS)} (now: {chosen.preset}); "
        "the defaults below are that preset's.",
    )
    device = distributed.start(parsed.config.device)
    # Physics and learning take turns on the same cores.
    torch.set_num_threads(max(1, parsed.config.environment.num_threads))
    try:
        trainer = _resumed(parsed.resume) if parsed.resume else _fresh(parsed, chosen.preset, device)
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


def _fresh(parsed: Arguments, preset: str, device: torch.device) -> Trainer:
    folder = parsed.output / (parsed.name or f"{preset}-{time.strftime('%Y%m%d-%H%M%S')}")
    if (folder / STATE_FILE).exists():
        raise FileExistsError(f"{folder} already holds a run: continue it with --resume {folder}, or give another --name")
    folder.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(parsed.config, folder)
    if parsed.warm_start:
        path = _state_path(parsed.warm_start)
        trainer.load_learning(torch.load(path, map_location="cpu", weights_only=True))
    if distributed.rank() == 0:
        write_run_description(folder, describe_run(parsed.config, preset))
    return trainer


def _resumed(folder: Path) -> Trainer:
    from lowlevel.provenance import read_training_config

    path = _state_path(folder)
    trainer = Trainer(read_training_config(folder), folder)
    trainer.load(path)
    return trainer


def _state_path(folder: Path) -> Path:
    path = folder / STATE_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no {STATE_FILE}: give the folder of a training run")
    return path


if __name__ == "__main__":
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    main()
