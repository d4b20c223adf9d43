"""The full suite: robots are told to cross tiles of every kind and level, and it counts who reaches the far side.

A robot starts on the flat ground before its tile and is told to walk at 0.5 m/s across it, with the postures and arms
of "walk and work", another one every 10 s. Whoever tells it also steers: the yaw rate leads it back to its course.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from evaluation.protocols.arena import Arena, Course, Episode
from evaluation.protocols.trace import Channel, Trace, record
from evaluation.protocols.tracking import CHANNELS, CommandTable, protocol_episodes, tabulate
from evaluation.reporting.statistics import Figure, share_figure
from lowlevel.commands import KINDS, VELOCITY, CommandSampler, CommandSpace
from lowlevel.world.terrain import (
    LANDING,
    MARGIN,
    TerrainConfig,
    platform_height,
    riser_height,
    roughness,
    slope_angle,
)

SPEED = 0.5
"""[m/s]"""
TILE_SIZE = 8.0
"""[m]"""
LEVELS = (0.0, 1.0 / 3.0, 0.5, 2.0 / 3.0, 1.0)
"""Stairs of 5, 10, 12.5, 15 and 20 cm, and so on (:data:`OBSTACLES`)."""
OBSTACLES: dict[str, tuple[str, Callable[[float], float]]] = {
    "rough": ("±{:.0f} cm", lambda level: 100.0 * roughness(level)),
    "slope": ("{:.0f}°", lambda level: math.degrees(slope_angle(level))),
    "stairs": ("{:.1f} cm", lambda level: 100.0 * riser_height(level)),
    "platform": ("{:.0f} cm", lambda level: 100.0 * platform_height(level)),
}
"""How the levels of a kind of tile are written."""
TERRAIN = TerrainConfig(("flat", *OBSTACLES), LEVELS, TILE_SIZE)
TWO_WAYS = ("slope", "stairs")
"""Kinds of tile that are climbed to their middle, and descended after it."""

_START, _FAR_SIDE = -0.5 * TILE_SIZE + 0.5 * MARGIN, 0.5 * TILE_SIZE - MARGIN
_TOP = -0.5 * LANDING
"""Where the way up is over, from the middle of the tile along the course [m]."""
_PLACE = {"place": Channel(lambda moment: moment.measured.robot.base_position[:, 0])}


def crossing_episodes(space: CommandSpace, count: int, seed: int) -> list[Episode]:
    """The fixed episodes of an evaluation: episode i crosses tile i, counted round, whoever walks."""
    sampler, everything = CommandSampler(space), torch.ones(len(KINDS))
    working = torch.tensor([name == "walk_and_work" for name in KINDS]).float()
    tiles = len(TERRAIN.tiles) * len(TERRAIN.levels)
    episodes = []
    for number, episode in enumerate(protocol_episodes(space, count, seed, tiles)):
        generator = torch.Generator().manual_seed(episode.seed + 2)
        kinds = sampler.draw_kinds(len(episode.starts), working, generator)
        commands, flags = sampler.sample(kinds, everything, generator)
        commands[:, VELOCITY] = torch.tensor([SPEED, 0.0, 0.0])
        course = Course((_START, 0.0))
        episodes.append(replace(episode, commands=commands, flags=flags[:, 0], tile=number % tiles, course=course))
    return episodes


def run_crossing(
    arena: Arena, episodes: Sequence[Episode], advance: Callable[[int], None] = lambda steps: None
) -> tuple[CommandTable, np.ndarray, dict[str, Figure]]:
    """Run ``episodes``, each until its robot has crossed its tile.

    Returns:
        what :func:`evaluation.protocols.tracking.run_tracking` returns, and the shares that cross without a fall.
    """
    trace = record(arena, episodes, CHANNELS | _PLACE, advance)
    middle = arena.world.terrain.tile_centers[[episode.tile for episode in episodes], 0].numpy()
    place = trace["place"] - middle[:, None]
    tile = torch.tensor([episode.tile for episode in episodes])
    table, transient = tabulate(until(trace, reached(place, _FAR_SIDE)), episodes, TERRAIN)
    return table, transient, crossing_figures(place, trace.fell | trace.failed, tile)


def reached(place: np.ndarray, where: float) -> np.ndarray:
    """Whether robots have been beyond ``where`` by then (E, T); ``place`` (E, T) [m] has NaN where they are down."""
    return np.asarray(np.logical_or.accumulate(place > where, axis=1))


def until(trace: Trace, over: np.ndarray) -> Trace:
    """The ``trace`` without what follows once an episode is ``over`` (E, T)."""
    channels = {}
    for name, values in trace.channels.items():
        channels[name] = values.copy()
        channels[name][over] = np.nan
    return replace(trace, channels=channels, fell=trace.fell & ~over, failed=trace.failed & ~over)


def crossing_figures(place: np.ndarray, out: np.ndarray, tile: Tensor) -> dict[str, Figure]:
    """Shares that cross without a fall, by kind of tile and level: ``crosses_stairs_15.0 cm`` and so on.

    ``place`` (E, T) along the course from the middle of the tile [m]; ``out`` (E, T), falls; ``tile`` (E,) as in
    ``Terrain.tile_centers``. Of slopes and stairs also ``climbs_…``, the share that reaches the landing, and
    ``descends_…``, the share of these that reaches the far side.
    """
    fallen = np.logical_or.accumulate(out, axis=1)
    across = np.asarray((reached(place, _FAR_SIDE) & ~fallen).any(axis=1))
    up = np.asarray((reached(place, _TOP) & ~fallen).any(axis=1))
    kinds, levels = (place.numpy() for place in TERRAIN.place_of(tile))
    of_kind = {kind: kinds == number for number, kind in enumerate(TERRAIN.tiles)}
    figures = {"crosses": share_figure(across), "crosses_flat": share_figure(across[of_kind["flat"]])}
    for kind in OBSTACLES:
        for level, name in enumerate(level_names(kind)):
            rows = of_kind[kind] & (levels == level)
            figures[f"crosses_{name}"] = share_figure(across[rows])
            if kind in TWO_WAYS:
                figures[f"climbs_{name}"] = share_figure(up[rows])
                figures[f"descends_{name}"] = share_figure(across[rows & up])
    return figures


def level_names(kind: str) -> list[str]:
    """``stairs_15.0 cm`` and so on for the levels of a ``kind`` of obstacle."""
    text, size = OBSTACLES[kind]
    return [f"{kind}_{text.format(size(level))}" for level in LEVELS]
