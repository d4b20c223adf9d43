"""Registers every task as a Gymnasium environment, and finds the controller that they run on by default."""

from __future__ import annotations

from pathlib import Path

import gymnasium

from highlevel.task import environment_id, task_names

CONTROLLERS = Path(__file__).resolve().parents[1] / "checkpoints" / "lowlevel"
"""Where shipped controllers lie."""


def register_tasks() -> None:
    """Register ``pilot/<Task>-v0`` for every task; registering twice changes nothing."""
    for name in task_names():
        identity = environment_id(name)
        if identity not in gymnasium.registry:
            gymnasium.register(identity, entry_point="highlevel.gym_env:PlannerEnv", kwargs={"task": name})


def find_controller(folder: Path | str | None) -> Path:
    """``folder``, or the only controller that is shipped if it is None.

    Raises:
        FileNotFoundError: if none is named and there is not exactly one to choose.
    """
    if folder is not None:
        return Path(folder)
    shipped = sorted(CONTROLLERS.glob("*/controller.json"))
    if len(shipped) == 1:
        return shipped[0].parent
    found = ", ".join(path.parent.name for path in shipped) or "none"
    raise FileNotFoundError(f"name a controller folder: {CONTROLLERS} holds these: {found}")
