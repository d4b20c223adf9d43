"""Golden vectors: reference inputs and outputs by which any port of a controller can be checked."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from lowlevel.commands import COMMAND_SIZE, CommandSpace
from lowlevel.control.elevation_map import MAP_SIZE
from lowlevel.control.observation import Proprioception
from robots.g1.constants import DEFAULT_POSITION, NUM_JOINTS

GOLDEN_ROBOTS = 4
"""Robots in a set of golden vectors."""


class ActingController(Protocol):
    """The part of :class:`lowlevel.control.controller.Controller` that golden vectors exercise."""

    def act(self, proprioception: Proprioception, elevation_map: Tensor, command: Tensor, flag: Tensor) -> Tensor: ...

    @property
    def last_history(self) -> Tensor: ...

    @property
    def last_action(self) -> Tensor: ...


def golden_vectors(controller: ActingController, space: CommandSpace, seed: int, steps: int = 3) -> dict[str, Any]:
    """Random measurements and commands over a few control steps, with what a fresh ``controller`` makes of them.

    Besides the inputs of :meth:`act`, every step holds the targets (PD targets [rad]), the history that the network
    saw and its action.
    """
    generator = torch.Generator().manual_seed(seed)
    lower, upper = space.bounds()
    default = torch.tensor(DEFAULT_POSITION, dtype=torch.float32)

    def normal(*shape: int) -> Tensor:
        return torch.randn(GOLDEN_ROBOTS, *shape, generator=generator)

    records = []
    for _ in range(steps):
        gravity = torch.tensor([0.0, 0.0, -1.0]) + 0.1 * normal(3)
        record = {
            "joint_position": default + 0.2 * normal(NUM_JOINTS),
            "joint_velocity": normal(NUM_JOINTS),
            "base_angular_velocity": 0.5 * normal(3),
            "projected_gravity": torch.nn.functional.normalize(gravity, dim=-1),
            "elevation_map": 0.75 + 0.05 * normal(MAP_SIZE),
            "command": lower + (upper - lower) * torch.rand(GOLDEN_ROBOTS, COMMAND_SIZE, generator=generator),
            "flag": torch.ones(GOLDEN_ROBOTS, 1),
        }
        record["targets"] = replay(controller, record)
        record["history"] = controller.last_history
        record["action"] = controller.last_action
        records.append({name: value.tolist() for name, value in record.items()})
    return {"robots": GOLDEN_ROBOTS, "steps": records}


def replay(controller: ActingController, record: dict[str, Tensor]) -> Tensor:
    """PD targets (N, 29) [rad] of ``controller`` for one recorded step."""
    measured = Proprioception(
        record["joint_position"],
        record["joint_velocity"],
        record["base_angular_velocity"],
        record["projected_gravity"],
    )
    return controller.act(measured, record["elevation_map"], record["command"], record["flag"])
