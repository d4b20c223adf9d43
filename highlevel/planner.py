"""The trained planner as a folder: observation in, action out, for any number of robots.

``planner.json``         task, controller, observation layout, action ranges, network, and where it comes from
``weights.safetensors``  normalizer and actor

Nothing in it is pickled.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from highlevel.action import ActionConfig
from highlevel.environment import CommandEnvironment
from highlevel.learning.policy import PlannerActor
from highlevel.task import ObservationBlock
from lowlevel.commands import COMMAND_SIZE
from lowlevel.control.controller import content_hash
from lowlevel.runs.frozen_folder import FrozenFolder
from robots.errors import PilotError

FORMAT_VERSION = 1
PLANNER_FILE, WEIGHTS_FILE = "planner.json", "weights.safetensors"


class PlannerError(PilotError):
    """A planner folder cannot be used; the message says why and what to do."""


_FOLDER = FrozenFolder(
    kind="planner",
    version=FORMAT_VERSION,
    description_file=PLANNER_FILE,
    weights_file=WEIGHTS_FILE,
    example="checkpoints/highlevel",
    error=PlannerError,
)


@dataclass(frozen=True)
class PlannerConfig:
    """Contents of ``planner.json`` that define behavior."""

    task: str
    """Name of the task."""
    task_config: dict[str, Any]
    """How the task was set up in training."""
    controller: str
    """Identity of the controller that the planner was trained on."""
    observation: tuple[ObservationBlock, ...]
    """Blocks of the observation, in order."""
    action: ActionConfig
    """What the action means."""
    hidden: tuple[int, ...]
    """Widths of the network's hidden layers."""


class Planner:
    """A frozen planner. It has no memory: :meth:`act` depends on the observation alone."""

    def __init__(self, config: PlannerConfig, actor: PlannerActor, provenance: dict[str, Any]) -> None:
        self.config = config
        self.provenance = provenance
        self.actor = actor.eval().requires_grad_(False)

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """Action (N, 21) in [-1, 1] for ``observation`` (N, D); deterministic."""
        return self.actor(observation).clamp(-1.0, 1.0)

    def reset(self, ids: Tensor) -> None:
        """Robots ``ids`` begin new episodes: nothing to forget."""

    @classmethod
    def load(cls, folder: Path | str, controller: Path | str | None = None) -> Planner:
        """Load a planner folder, and check that it belongs to the folder of a ``controller`` if one is given.

        Raises:
            PlannerError: if a file is missing, damaged, of another version, holds weights that are not finite, or
                belongs to another controller.
        """
        folder = Path(folder)
        config, provenance = _FOLDER.read_config(folder, PlannerConfig)
        tensors = _FOLDER.read_weights(folder)
        size = sum(block.size for block in config.observation)
        actor = PlannerActor(size, COMMAND_SIZE, config.hidden)
        try:
            actor.load_state_dict(tensors)
        except RuntimeError as error:
            reason = str(error).splitlines()[-1].strip()
            raise PlannerError(f"{folder / WEIGHTS_FILE} does not fit {PLANNER_FILE}: {reason}") from error
        planner = cls(config, actor, provenance)
        if controller is not None:
            planner.require_controller(controller)
        return planner

    def require_controller(self, folder: Path | str) -> None:
        """Check that the planner was trained on the controller in ``folder``.

        Raises:
            PlannerError: if it was trained on another one.
        """
        found = content_hash(folder)
        if found != self.config.controller:
            raise PlannerError(
                f"this planner was trained on controller {self.config.controller}, but {folder} is {found}: "
                "use the controller it was trained on, or train a planner for this one"
            )

    def require_environment(self, environment: CommandEnvironment) -> None:
        """Check that the planner's observation and action are those of ``environment``.

        Raises:
            PlannerError: if they are not.
        """
        task = environment.task
        if self.config.task != task.name:
            raise PlannerError(f"this planner is for task {self.config.task!r}, not {task.name!r}")
        if self.config.observation != environment.blocks or self.config.action != task.action:
            raise PlannerError("this planner was trained with another observation or action: train it again")

    def save(self, folder: Path | str) -> None:
        """Write the folder; each file is complete or absent.

        Raises:
            PlannerError: if a weight is not finite; nothing is written then.
        """
        _FOLDER.write_weights(Path(folder), self.actor.state_dict())
        _FOLDER.write_description(Path(folder), self.config, self.provenance)


def planner_hash(folder: Path | str) -> str:
    """Identity of a planner: SHA-256 over all of its folder but the provenance, 16 hexadecimal digits."""
    return _FOLDER.identity(Path(folder))
