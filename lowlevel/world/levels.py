"""Levels of terrain: on every kind of tile a robot climbs from one to the next by doing there what it is told.

Survival is no success: a robot that stands before a step for ten seconds has learned nothing about it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lowlevel.world.terrain import TILES, Terrain

LARGEST_ERROR = 0.3
"""Mean velocity error over an episode [m/s] up to which it is a success."""
CROSSED = 1.5
"""A success has climbed up and down as much as so long a line across its tile does [m]."""


class Levels:
    """The level that each robot has reached on each kind of tile (N, kinds), numbers in ``TerrainConfig.levels``."""

    def __init__(self, terrain: Terrain, num_robots: int, device: torch.device | str = "cpu") -> None:
        self._terrain = terrain
        self._config = terrain.config
        self._count = len(terrain.config.levels)
        self._row = {kind: row for row, kind in enumerate(terrain.config.tiles)}
        self.reached = torch.zeros(num_robots, len(TILES), dtype=torch.long, device=device)

    def draw(self, ids: Tensor, chances: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Kinds of tile, drawn by their ``chances`` (kinds,), and tiles at the level of robots ``ids`` (n,), (n,) each.

        A tile is its number in ``Terrain.tile_centers``.
        """
        kinds = torch.multinomial(chances, len(ids), replacement=True, generator=generator)
        rows = torch.tensor([self._row.get(kind, 0) for kind in TILES], device=ids.device)
        return kinds, self._config.number_of(rows[kinds], self.reached[ids, kinds])

    def judge(
        self,
        ids: Tensor,
        kind: Tensor,
        tile: Tensor,
        fallen: Tensor,
        error: Tensor,
        climbed: Tensor,
        generator: torch.Generator,
    ) -> None:
        """Move robots ``ids`` (n,) up after a success on a ``kind`` of tile, and down after a fall.

        ``tile`` (n,) as in :meth:`draw`; ``error`` (n,), mean velocity error over the episode [m/s]; ``climbed`` (n,),
        changes of the ground's height below the base, up and down together [m]. Robots past the last level go on at a
        random one.
        """
        crossed = climbed >= CROSSED * self._terrain.relief[tile]
        success = ~fallen & (error < LARGEST_ERROR) & crossed
        level = self.reached[ids, kind] + success.long() - fallen.long()
        anywhere = torch.randint(self._count, (len(ids),), generator=generator, device=ids.device)
        self.reached[ids, kind] = torch.where(level >= self._count, anywhere, level.clamp_min(0))

    def figures(self) -> dict[str, float]:
        """Mean level of every kind of tile in the terrain, as its difficulty in [0, 1]."""
        difficulty = torch.tensor(self._terrain.config.levels, device=self.reached.device)
        means = difficulty[self.reached].mean(dim=0)
        numbers = {kind: number for number, kind in enumerate(TILES)}
        return {f"level/{kind}": float(means[numbers[kind]]) for kind in self._row}
