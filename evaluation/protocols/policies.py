"""Who decides in an evaluation: a trained planner, or the task's scripted expert."""

from __future__ import annotations

from pathlib import Path

from highlevel.environment import CommandEnvironment
from highlevel.episodes import Policy
from highlevel.planner import Planner
from highlevel.registry import find_controller, load_expert
from lowlevel.control.controller import Controller

SCRIPTED = "scripted"
"""Stands where a planner's folder is expected for the task's scripted expert."""


def controller_for(planner: str, named: Path | None) -> Path:
    """The ``named`` controller folder, or else the shipped one that the ``planner`` was trained on; both can be loaded.

    Raises:
        PilotError: if one of them cannot be used, or not with the other.
    """
    loaded = None if planner == SCRIPTED else Planner.load(planner)
    folder = find_controller(named, loaded.config.controller if loaded else None)
    Controller.load(folder)
    if loaded:
        loaded.require_controller(folder)
    return folder


def make_policy(planner: str, environment: CommandEnvironment, controller: Path) -> Policy:
    """The scripted expert of the environment's task, or the planner in a folder.

    Raises:
        PlannerError: if the planner does not belong to this task and controller.
    """
    if planner == SCRIPTED:
        return load_expert(environment)
    loaded = Planner.load(planner, controller)
    loaded.require_environment(environment)
    return loaded
