"""From a training run to a frozen controller folder: ``python -m lowlevel.export --run RUN --controller FOLDER``."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from lowlevel.controller import Controller, ControllerConfig, actor_sizes
from lowlevel.environment import PilotEnvironment
from lowlevel.networks import NetworkConfig, PilotActor
from lowlevel.observation import FRAME, normalised_columns
from lowlevel.provenance import find_state, git_revision, read_run_description, read_training_config
from lowlevel.trainer import Trainer
from robots.g1.constants import DEFAULT_POSITION, GAINS, JOINT_NAMES


def controller_config(environment: PilotEnvironment, network: NetworkConfig) -> ControllerConfig:
    """The conventions of an environment, as a controller carries them."""
    gains = GAINS[environment.config.gains]
    return ControllerConfig(
        joint_names=JOINT_NAMES,
        default_position=tuple(DEFAULT_POSITION.tolist()),
        joint_lower=tuple(environment.simulation.joint_lower.tolist()),
        joint_upper=tuple(environment.simulation.joint_upper.tolist()),
        stiffness=tuple(gains.stiffness.tolist()),
        damping=tuple(gains.damping.tolist()),
        action_scale=tuple(gains.action_scale.tolist()),
        action_limit=environment.config.action_limit,
        control_period=environment.control_period,
        command_space=environment.command_space,
        nominal=environment.config.nominal,
        network=network,
        pose_axes=environment.motion.pose.axes,
    )


def freeze(trainer: Trainer, revision: str | None = None) -> Controller:
    """The current policy of a run as a controller on the CPU, detached from the run.

    ``revision`` of the code that trained it: this one by default.
    """
    config = controller_config(trainer.environment, trainer.config.network)
    actor = PilotActor(actor_sizes(), config.network, ~normalised_columns(FRAME))
    actor.load_state_dict({name: tensor.cpu() for name, tensor in trainer.ppo.actor.state_dict().items()})
    provenance: dict[str, Any] = {
        "training": asdict(trainer.config),
        "steps": trainer.steps,
        "hours": trainer.trained_seconds / 3600.0,
        "curriculum": trainer.curriculum.state_dict(),
        "revision": git_revision() if revision is None else revision,
        "torch": torch.__version__,
    }
    return Controller(config, actor, trainer.environment.motion.pose, provenance)


def export_controller(trainer: Trainer, folder: Path, revision: str | None = None) -> None:
    """Freeze the current policy of ``trainer`` into a controller ``folder``; ``revision`` as in :func:`freeze`."""
    freeze(trainer, revision).save(folder)


def export_run(run: Path, controller: Path) -> None:
    """Freeze the last saved state of a training ``run``, which may still be going on, into a ``controller`` folder."""
    config = read_training_config(run)
    small = replace(config, environment=replace(config.environment, num_robots=config.ppo.minibatches), device="cpu")
    trainer = Trainer(small, run)
    trainer.load(find_state(run), with_environment=False)
    trainer.config = config  # provenance tells of the run, not of the small environment it was rebuilt in
    export_controller(trainer, controller, read_run_description(run).get("revision"))
    print(f"{trainer.steps} steps; the controller lies in {controller}")


if __name__ == "__main__":
    try:
        tyro.cli(export_run)
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"lowlevel.export: {error}")
