"""Suites of the tracking protocol: the ground, what is asked of robots on it, and what the paper reports there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.protocols import crossing
from evaluation.protocols.arena import Arena, Episode
from evaluation.protocols.tracking import TILE_SIZE, CommandTable, protocol_episodes, run_tracking
from evaluation.reporting.statistics import Figure
from lowlevel.commands import CommandSpace
from lowlevel.world.measures import TRACKING_FIGURES
from lowlevel.world.terrain import TerrainConfig
from robots.errors import PilotError

Advance = Callable[[int], None]
"""Told how many control steps have passed, for a progress bar."""


@dataclass(frozen=True)
class Suite:
    """What ``evaluate-lowlevel --suite`` names."""

    terrain: TerrainConfig
    crosses: bool
    """Whether robots cross the tiles, or walk about on them."""
    paper: dict[str, float]
    """Figures of the paper's Table II, by name."""
    paper_row: str
    """Which row of it."""

    def episodes(self, space: CommandSpace, count: int, seed: int) -> list[Episode]:
        """The fixed episodes of an evaluation."""
        if self.crosses:
            return crossing.crossing_episodes(space, count, seed)
        return protocol_episodes(space, count, seed, len(self.terrain.tiles))

    def run(
        self, arena: Arena, episodes: Sequence[Episode], advance: Advance = lambda steps: None
    ) -> tuple[CommandTable, np.ndarray, dict[str, Figure]]:
        """The table of their commands, mean figures over the time since a command began, and figures of the suite."""
        if self.crosses:
            return crossing.run_crossing(arena, episodes, advance)
        return *run_tracking(arena, episodes, advance), {}


def _paper(*values: float) -> dict[str, float]:
    return dict(zip(TRACKING_FIGURES, values, strict=False))


def _simple(*tiles: str) -> Suite:
    blind = _paper(0.145, 0.099, 0.010, 0.057, 0.053, 0.055, 0.206)
    return Suite(TerrainConfig(tiles=tiles, tile_size=TILE_SIZE), crosses=False, paper=blind, paper_row="blind")


SUITES: dict[str, Suite] = {
    "simple": _simple("flat", "irregular"),
    "flat": _simple("flat"),
    "slabs": _simple("irregular"),
    "full": Suite(
        crossing.TERRAIN,
        crosses=True,
        paper=_paper(0.148, 0.102, 0.009, 0.055, 0.056, 0.068, 0.218, 0.006),
        paper_row="PILOT, complex terrain",
    ),
}


def suite_of(name: str) -> Suite:
    """A suite by name.

    Raises:
        PilotError: if there is none of that name.
    """
    if name not in SUITES:
        raise PilotError(f"unknown suite {name!r}; choose one of {', '.join(SUITES)}")
    return SUITES[name]
