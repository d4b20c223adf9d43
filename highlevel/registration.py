"""Registers every task as a Gymnasium environment, and finds the controller that they run on by default."""

from __future__ import annotations

from pathlib import Path

import gymnasium

from highlevel.task import environment_id, task_names
from lowlevel.control.controller import content_hash
from robots.errors import PilotError

CONTROLLERS = Path(__file__).resolve().parents[1] / "checkpoints" / "lowlevel"
"""Where shipped controllers lie."""
DEFAULT_CONTROLLER = "pilot-g1-simple"
"""The one of them that is used where none is asked for."""


def register_tasks() -> None:
    """Register ``pilot/<Task>-v0`` for every task; registering twice changes nothing."""
    for name in task_names():
        identity = environment_id(name)
        if identity not in gymnasium.registry:
            gymnasium.register(identity, entry_point="highlevel.gym_env:PlannerEnv", kwargs={"task": name})


def find_controller(folder: Path | str | None = None, identity: str | None = None) -> Path:
    """``folder`` if it is given; else the shipped controller of that ``identity``; else the default one.

    Raises:
        PilotError: if no such controller is shipped.
    """
    if folder is not None:
        return Path(folder)
    shipped = [path.parent for path in sorted(CONTROLLERS.glob("*/controller.json"))]
    for candidate in shipped:
        if candidate.name == DEFAULT_CONTROLLER if identity is None else content_hash(candidate) == identity:
            return candidate
    found = ", ".join(path.name for path in shipped) or "none"
    wanted = DEFAULT_CONTROLLER if identity is None else identity
    raise PilotError(f"name a controller folder: {wanted} is not among those in {CONTROLLERS}: {found}")
