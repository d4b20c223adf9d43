"""From a training run to a frozen controller folder: ``python -m lowlevel.export --run RUN --controller FOLDER``."""

from __future__ import annotations

import copy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from lowlevel.commands import KINDS
from lowlevel.control.controller import ControllerConfig, PolicyConfig, actor_sizes, build_step, save_controller
from lowlevel.control.observation import FRAME, normalized_columns
from lowlevel.environment import PilotEnvironment
from lowlevel.networks.actor import PilotActor
from lowlevel.runs.command_line import command_line
from lowlevel.runs.run_folder import RunFolder, git_revision
from lowlevel.trainer import Trainer, TrainingConfig
from lowlevel.world.terrain import tile_shares
from robots.errors import PilotError
from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, GAINS, JOINT_NAMES


def controller_config(environment: PilotEnvironment) -> ControllerConfig:
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
    )


def export_controller(trainer: Trainer, folder: Path, revision: str | None = None) -> None:
    """Freeze the current policy of ``trainer`` into a controller ``folder``.

    ``revision`` of the code that trained it: this one by default.

    Raises:
        PilotError: if the run is in a stage with a gait prior, which no controller has.
    """
    if trainer.stage.prior is not None:
        raise PilotError(f"no controller has the gait prior of the stage {trainer.stage.name!r}: train on")
    environment = trainer.environment
    config, pose = controller_config(environment), environment.reference.pose
    policy = PolicyConfig(environment.reference.config, trainer.config.network, pose.axes)
    actor = PilotActor(actor_sizes(), policy.network, ~normalized_columns(FRAME))
    actor.load_state_dict({name: tensor.cpu() for name, tensor in trainer.ppo.actor.state_dict().items()})
    correction = copy.deepcopy(environment.correction).cpu()
    if not trainer.stage.arms_act:
        actor.silence(ARM_JOINTS)
    provenance: dict[str, Any] = {
        "training": asdict(trainer.config),
        "steps": trainer.steps,
        "hours": trainer.trained_seconds / 3600.0,
        "stage": trainer.stage.name,
        "curriculum": trainer.curriculum.figures(torch.ones(len(KINDS)), tile_shares(trainer.stage.terrain)),
        "revision": git_revision() if revision is None else revision,
        "torch": torch.__version__,
    }
    save_controller(folder, config, policy, build_step(config, policy, actor, correction, pose, "cpu"), provenance)


def export_run(run: Path, controller: Path) -> None:
    """Freeze the last saved state of a training ``run``, which may still be going on, into a ``controller`` folder."""
    config = RunFolder(run).config(TrainingConfig)
    small = replace(config, environment=replace(config.environment, num_robots=config.ppo.minibatches), device="cpu")
    trainer = Trainer(small, run)
    trainer.load(with_environment=False)
    trainer.config = config  # provenance tells of the run, not of the small environment it was rebuilt in
    export_controller(trainer, controller, trainer.run.description().get("revision"))
    print(f"{trainer.steps} steps; the controller lies in {controller}")


if __name__ == "__main__":
    with command_line("lowlevel.export", "interrupted"):
        tyro.cli(export_run)
