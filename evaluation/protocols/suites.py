"""Suites of the tracking protocol: the ground, what is asked of robots on it, and what the paper reports there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from evaluation.protocols import crossing
from evaluation.protocols.arena import Arena, Episode
from evaluation.protocols.tracking import TILE_SIZE, CommandTable, protocol_episodes, run_tracking
from evaluation.reporting.statistics import Figure
from lowlevel.commands import CommandSpace
from lowlevel.world.terrain import TerrainConfig
from robots.errors import PilotError

Advance = Callable[[int], None]
"""Told how many control steps have passed, for a progress bar."""


@dataclass(frozen=True)
class Suite:
    """What ``evaluate-lowlevel --suite`` names."""

    terrain: TerrainConfig
    paper: dict[str, float] = field(default_factory=dict)
    """Figures that the paper reports on such ground (Table II), by name."""
    paper_row: str = ""
    """Which row of it."""
    crosses: bool = False
    """Whether robots cross the tiles, or walk about on them."""

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


BLIND_ON_SIMPLE_GROUND = {
    "E_v": 0.145,
    "E_omega": 0.099,
    "E_h": 0.010,
    "E_r": 0.057,
    "E_p": 0.053,
    "E_y": 0.055,
    "E_arm": 0.206,
}
PILOT_ON_COMPLEX_GROUND = {
    "E_v": 0.148,
    "E_omega": 0.102,
    "E_h": 0.009,
    "E_r": 0.055,
    "E_p": 0.056,
    "E_y": 0.068,
    "E_arm": 0.218,
    "E_stumble": 0.006,
}
SUITES: dict[str, Suite] = {
    "simple": Suite(TerrainConfig(("flat", "slabs"), tile_size=TILE_SIZE), BLIND_ON_SIMPLE_GROUND, "blind"),
    "flat": Suite(TerrainConfig(("flat",), tile_size=TILE_SIZE)),
    "slabs": Suite(TerrainConfig(("slabs",), tile_size=TILE_SIZE)),
    "full": Suite(crossing.TERRAIN, PILOT_ON_COMPLEX_GROUND, "PILOT, complex terrain", crosses=True),
}


def suite_of(name: str) -> Suite:
    """A suite by name.

    Raises:
        PilotError: if there is none of that name.
    """
    if name not in SUITES:
        raise PilotError(f"unknown suite {name!r}; choose one of {', '.join(SUITES)}")
    return SUITES[name]
