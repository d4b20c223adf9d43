"""One instant of N robots as the environment sees it: everything that no command, action or noise changes.

A step observes twice, before and after robots are reset. Both observations share one snapshot, in which only the
rows of the reset robots are taken anew.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from lowlevel.control.observation import map_observation
from lowlevel.world.measures import Measurement
from lowlevel.world.simulation import RobotState
from lowlevel.world.world import World
from robots.rotations import rotate_about_vertical

FORCE_SCALE = 400.0
"""Foot force that the critic sees as one [N]."""


@dataclass(frozen=True)
class Snapshot:
    """Tensors have one row per robot."""

    measured: Measurement
    feet: Tensor
    """Contacts, clearances [m], and positions from the base [m], velocities [m/s] and forces [400 N] of both feet in
    the heading frame (N, 22), as the critic sees them."""
    elevation: Tensor
    """The elevation map without noise (N, 121) [m], as observed."""


def take_snapshot(world: World, ids: Tensor | None = None) -> Snapshot:
    """A :class:`Snapshot` of robots ``ids`` (n,), all by default."""
    measured = world.measure(ids)
    robot = measured.robot
    position = robot.foot_position - robot.base_position[:, None]
    vectors = torch.cat([position, robot.foot_velocity, robot.foot_force / FORCE_SCALE], dim=1)
    turned = rotate_about_vertical(-measured.heading[:, None], vectors)
    return Snapshot(
        measured=measured,
        feet=torch.cat([measured.foot_contact.float(), measured.foot_clearance, turned.flatten(1)], dim=1),
        elevation=map_observation(world.elevation(measured)),
    )


Rows = TypeVar("Rows", Snapshot, Measurement, RobotState)


def with_rows(whole: Rows, ids: Tensor, part: Rows) -> Rows:
    """A copy of ``whole`` in which rows ``ids`` (n,) are the n rows of ``part``."""
    changed: dict[str, Any] = {}
    for field in fields(whole):
        old, new = getattr(whole, field.name), getattr(part, field.name)
        changed[field.name] = old.index_copy(0, ids, new) if isinstance(old, Tensor) else with_rows(old, ids, new)
    return replace(whole, **changed)
