"""Tasks by name, with their experts and Gymnasium ids, and the shipped controllers that they run on.

A task is a folder ``tasks/<name>/``, or a module that an installed package names in the entry-point group
``open_pilot.tasks``. It has an attribute ``TASK``, a function without required arguments that returns a
:class:`highlevel.task.Task`. If it has a scripted expert, its attribute ``EXPERT`` makes one of a
:class:`highlevel.environment.CommandEnvironment`. Nothing under ``highlevel`` knows a task by name.
"""

from __future__ import annotations

import importlib
import pkgutil
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium

from highlevel.environment import CommandEnvironment
from highlevel.episodes import Policy
from highlevel.task import Task
from lowlevel.control.controller import content_hash
from robots.errors import PilotError

TASK_GROUP = "open_pilot.tasks"
"""Entry-point group of tasks that live in other packages."""
CONTROLLERS = Path(__file__).resolve().parents[1] / "checkpoints" / "lowlevel"
"""Where shipped controllers lie."""
DEFAULT_CONTROLLER = "pilot-g1-simple"
"""The one of them that is used where none is asked for."""


def task_modules() -> dict[str, str]:
    """The module of every task that is installed, by the task's name.

    Raises:
        PilotError: if an installed package has a task of the same name as another one.
    """
    package = importlib.import_module("tasks")
    folders = (module.name for module in pkgutil.iter_modules(package.__path__) if module.ispkg)
    modules = {name: f"tasks.{name}" for name in sorted(folders)}
    for entry in metadata.entry_points(group=TASK_GROUP):
        if modules.setdefault(entry.name, entry.value) != entry.value:
            raise PilotError(f"{entry.value} and {modules[entry.name]} are both called {entry.name!r}: rename one")
    return modules


def _module(name: str) -> ModuleType:
    modules = task_modules()
    if name not in modules:
        raise PilotError(f"there is no task {name!r}; the tasks are: {', '.join(modules) or 'none'}")
    return importlib.import_module(modules[name])


def load_task(name: str, **options: Any) -> Task:
    """The task of that name; ``options`` go to its ``TASK``.

    Raises:
        PilotError: if there is no such task, or its module does not hold one.
    """
    module = _module(name)
    factory = getattr(module, "TASK", None)
    if factory is None:
        raise PilotError(f"{module.__name__} has no attribute TASK: it must name the task's class")
    task = factory(**options)
    if not isinstance(task, Task):
        raise PilotError(f"TASK of {module.__name__} makes a {type(task).__name__}, not a highlevel.task.Task")
    return task


def load_expert(environment: CommandEnvironment) -> Policy:
    """The scripted expert of the environment's task, for that environment's robots.

    Raises:
        PilotError: if the task has none.
    """
    name = environment.task.name
    expert = getattr(_module(name), "EXPERT", None)
    if expert is None:
        raise PilotError(f"task {name!r} has no scripted expert: train it with --demonstrations 0")
    policy: Policy = expert(environment)
    return policy


def environment_id(name: str) -> str:
    """Gymnasium id of a task: ``lift_box`` is ``pilot/LiftBox-v0``."""
    return f"pilot/{''.join(word.capitalize() for word in name.split('_'))}-v0"


def register_tasks() -> None:
    """Register ``pilot/<Task>-v0`` for every task; registering twice changes nothing."""
    for name in task_modules():
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
