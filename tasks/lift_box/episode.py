"""What is drawn for an episode, and where robot and box stand when it begins."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from highlevel.task import Start
from lowlevel.runs.draws import uniform
from tasks.lift_box.config import LiftBoxConfig

_SPAWN_STREAM = 1


@dataclass
class Episode:
    """Properties of N episodes; one row per robot."""

    size: Tensor
    """Edges of the box (N, 3) [m]."""
    mass: Tensor
    """(N,) [kg]"""
    center_of_mass: Tensor
    """In the box frame (N, 3) [m]."""
    friction: Tensor
    """Sliding friction of the palms (N,)."""
    support_height: Tensor
    """Top of the block under the box (N,) [m]; zero on the floor."""
    position_bias: Tensor
    """Error of the observed box position that stays (N, 3), in [-1, 1]."""
    angle_bias: Tensor
    """Error of the observed box attitude that stays (N, 3), in [-1, 1]."""

    @classmethod
    def empty(cls, count: int) -> Episode:
        """Storage for ``count`` robots."""
        return cls(
            size=torch.full((count, 3), 0.3),
            mass=torch.ones(count),
            center_of_mass=torch.zeros(count, 3),
            friction=torch.ones(count),
            support_height=torch.zeros(count),
            position_bias=torch.zeros(count, 3),
            angle_bias=torch.zeros(count, 3),
        )

    def assign(self, ids: Tensor, other: Episode) -> None:
        """Overwrite rows ``ids`` with ``other``."""
        for item in fields(self):
            getattr(self, item.name)[ids] = getattr(other, item.name)


def draw(config: LiftBoxConfig, seed: int, number: Tensor) -> tuple[Episode, Start]:
    """Episodes ``number`` (n,): properties, and where the robots stand around a box at the origin with yaw
    zero.

    The robot faces the box's -x face: the box lies at +x of the robot but for bearing and yaw.
    """
    spawn = config.spawn
    random = uniform(seed, number, _SPAWN_STREAM, 20)

    def between(column: int, low: float, high: float) -> Tensor:
        return low + (high - low) * random[:, column]

    size = spawn.edge[0] + (spawn.edge[1] - spawn.edge[0]) * random[:, 0:3]
    friction = between(4, *spawn.friction)
    on_floor = random[:, 5] < spawn.floor_share
    episode = Episode(
        size=size,
        mass=between(3, *spawn.mass),
        center_of_mass=spawn.center_of_mass * (2.0 * random[:, 11:14] - 1.0),
        friction=torch.zeros_like(friction) if config.control == "frictionless" else friction,
        support_height=torch.where(on_floor, 0.0, between(6, *spawn.support_height)),
        position_bias=2.0 * random[:, 14:17] - 1.0,
        angle_bias=2.0 * random[:, 17:20] - 1.0,
    )
    sight = between(7, -spawn.box_yaw, spawn.box_yaw)
    bearing = between(8, *spawn.bearing)
    distance = between(9, *spawn.distance) + 0.5 * size[:, 0]
    position = -distance[:, None] * torch.stack([torch.cos(sight), torch.sin(sight)], -1)
    return episode, Start(position, sight + bearing)
