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

from lowlevel.export import export_controller
from lowlevel.presets import PRESETS
from lowlevel.runs import distributed
from lowlevel.runs.checks import require_finite
from lowlevel.runs.command_line import command_line
from lowlevel.runs.run_folder import RunFolder, resumed_run
from lowlevel.trainer import Trainer, TrainingConfig
from robots.errors import PilotError


@dataclass(frozen=True)
class Arguments:
    """Train a PILOT controller for the Unitree G1."""

    config: Annotated[TrainingConfig, tyro.conf.arg(name="")]
    preset: str = "simple"
    """Named configuration to start from, a key of lowlevel.presets.PRESETS."""
    output: Path = Path("runs/lowlevel")
    """Parent folder of the run's folder."""
    name: str = ""
    """Name of the run's folder; preset and time by default."""
    blind: Path | None = None
    """Folder of a run without vision, with whose networks a new run with vision begins."""
    resume: Path | None = None
    """Folder of a run to continue with its own configuration; options given beside it replace parts of that."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``train-lowlevel``."""
    with command_line("train-lowlevel", "interrupted; what was saved by then can be continued with --resume"):
        _run(sys.argv[1:] if arguments is None else arguments)


def _run(arguments: list[str]) -> None:
    parsed = tyro.cli(
        Arguments,
        args=arguments,
        default=_defaults(arguments),
        description="Train a PILOT controller. Defaults below are those of the chosen preset or earlier run.",
    )
    device = distributed.start(parsed.config.device)
    # Physics and learning take turns on the same cores.
    torch.set_num_threads(max(1, parsed.config.environment.num_threads))
    try:
        trainer = _resumed(parsed) if parsed.resume else _fresh(parsed, device)
        if distributed.rank() == 0:
            trainer.run.describe(parsed.config, preset=parsed.preset)
            print(f"training in {trainer.run.path}", flush=True)
        trainer.train()
        if distributed.rank() == 0:
            outcome = f"no controller yet: the stage {trainer.stage.name!r} has a gait prior"
            if trainer.stage.prior is None:
                export_controller(trainer, trainer.run.path / "controller")
                outcome = f"the controller lies in {trainer.run.path / 'controller'}"
            print(f"{trainer.steps} steps in {trainer.trained_seconds / 3600:.2f} h; {outcome}")
        if trainer.steps < parsed.config.total_steps:
            print(f"train-lowlevel: stopped; continue with --resume {trainer.run.path}", file=sys.stderr)
            sys.exit(130)
    finally:
        distributed.stop()


def _defaults(arguments: list[str]) -> Arguments:
    """Preset and earlier run decide the defaults of everything else, so they are read first."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--preset")
    chosen, run = parser.parse_known_args(arguments)[0], resumed_run(arguments)
    if run is not None:
        if chosen.preset is not None:
            raise PilotError("--resume takes the configuration of the run it continues: leave --preset out")
        return Arguments(config=run.config(TrainingConfig), preset=run.description().get("preset", "unknown"))
    preset = chosen.preset or Arguments.preset
    if preset not in PRESETS:
        raise PilotError(f"unknown preset {preset!r}; choose one of {', '.join(PRESETS)}")
    return Arguments(config=PRESETS[preset], preset=preset)


def _fresh(parsed: Arguments, device: torch.device) -> Trainer:
    if parsed.config.network.vision and parsed.blind is None:
        raise PilotError("networks that see begin with those of a blind run: name its folder with --blind")
    folder = parsed.output / (parsed.name or f"{parsed.preset}-{time.strftime('%Y%m%d-%H%M%S')}")
    if distributed.rank() == 0:  # other ranks may come when this one has made the folder
        RunFolder(folder).require_unused()
    trainer = Trainer(replace(parsed.config, device=str(device)), folder)
    if parsed.blind is not None:
        trainer.begin_seeing(RunFolder(parsed.blind))
    if distributed.rank() == 0:
        trainer.run.claim()
    return trainer


def _resumed(parsed: Arguments) -> Trainer:
    assert parsed.resume is not None
    if parsed.blind is not None:
        raise PilotError("--blind is for a new run: leave it out beside --resume")
    trainer = Trainer(parsed.config, parsed.resume)
    trainer.load()
    for network in (trainer.ppo.actor, trainer.ppo.critic):
        for name, weight in network.state_dict().items():
            require_finite(f"weight {name!r} of the run in {parsed.resume}", weight)
    return trainer


if __name__ == "__main__":
    main()
