"""Terrain as boxes on a plane: one list of boxes makes both the collision geometry and the height raster.

Every robot of a batch lives in the same world, so the whole terrain is part of one shared model. A tile is a
square patch made by one function of :data:`TILES`. To add stairs or platforms, add a function there, and name it in the
terrain of a stage (:mod:`lowlevel.presets`) and in ``evaluation.protocols.tracking.SUITES``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor

from lowlevel.control.elevation_map import MAP_SIZE, map_points
from robots.errors import PilotError
from robots.g1.model import WORLD_COLLISION
from robots.rotations import rotate_about_vertical

STANCE_REACH = 0.3
"""No part of a standing robot's soles is farther than this from the base, horizontally and along each axis [m]."""


@dataclass(frozen=True)
class Block:
    """An axis-aligned box standing on the ground plane: center (x, y), half extents (x, y), top height [m]."""

    center: tuple[float, float]
    half_extent: tuple[float, float]
    top: float


def flat(size: float, level: float, rng: np.random.Generator) -> list[Block]:
    """Nothing but the ground plane."""
    return []


def irregular(size: float, level: float, rng: np.random.Generator) -> list[Block]:
    """Slabs of 0.4 m with heights within +-2 cm of their mean at level 1."""
    slab = 0.4
    count = round(size / slab)
    centers = (np.arange(count) + 0.5) * slab - size / 2.0
    tops = 0.002 + 0.04 * level * rng.random((count, count))
    return [
        Block((float(x), float(y)), (slab / 2, slab / 2), float(tops[i, j]))
        for i, x in enumerate(centers)
        for j, y in enumerate(centers)
    ]


TileFunction = Callable[[float, float, np.random.Generator], list[Block]]
TILES: dict[str, TileFunction] = {"flat": flat, "irregular": irregular}


@dataclass(frozen=True)
class TerrainConfig:
    """Which tiles the world holds; robots are spread over them evenly."""

    tiles: tuple[str, ...] = ("flat",)
    """Kinds of tile, in a row along y; each is a key of :data:`TILES`."""
    tile_size: float = 8.0
    """Side of a square tile [m]."""
    level: float = 1.0
    """Difficulty in [0, 1], handed to the tile functions."""
    raster_resolution: float = 0.05
    """Cell size of the height raster [m]."""
    seed: int = 0
    """Seed of the random tiles."""


class Terrain:
    """Blocks, the height raster built from them, and lookups on it."""

    def __init__(self, config: TerrainConfig, device: torch.device | str = "cpu") -> None:
        unknown = [tile for tile in config.tiles if tile not in TILES]
        if unknown:
            raise PilotError(f"unknown terrain tile {unknown[0]!r}; choose from {', '.join(TILES)}")
        self.config = config
        rng = np.random.default_rng(config.seed)
        size = config.tile_size
        centers = [(0.0, (i - (len(config.tiles) - 1) / 2.0) * size) for i in range(len(config.tiles))]
        self.blocks = [
            Block((cx + block.center[0], cy + block.center[1]), block.half_extent, block.top)
            for tile, (cx, cy) in zip(config.tiles, centers, strict=True)
            for block in TILES[tile](size, config.level, rng)
        ]
        self.tile_centers = torch.tensor(centers, dtype=torch.float32, device=device)
        self._origin = torch.tensor([-size / 2, -size * len(config.tiles) / 2], device=device)
        # The outermost cells stand for the plane around the tiles.
        self._raster = torch.from_numpy(np.pad(self._rasterize(), 1)).to(device)
        self._map_offsets = map_points(device)

    def _rasterize(self) -> np.ndarray:
        config, resolution = self.config, self.config.raster_resolution
        shape = (
            round(config.tile_size / resolution),
            round(config.tile_size * len(config.tiles) / resolution),
        )
        raster = np.zeros(shape, dtype=np.float32)
        origin = self._origin.cpu().numpy()
        for block in self.blocks:
            low = (np.array(block.center) - block.half_extent - origin) / resolution
            high = (np.array(block.center) + block.half_extent - origin) / resolution
            (i0, j0), (i1, j1) = np.round(low).astype(int), np.round(high).astype(int)
            cells = raster[max(i0, 0) : i1, max(j0, 0) : j1]
            np.maximum(cells, block.top, out=cells)
        return raster

    def add_to(self, spec: mujoco.MjSpec, friction: float = 1.0) -> None:
        """Add the blocks as static boxes that feet and objects collide with."""
        for number, block in enumerate(self.blocks):
            geom = spec.worldbody.add_geom(name=f"terrain_{number}", type=mujoco.mjtGeom.mjGEOM_BOX)
            half_height = 0.5 * block.top
            geom.pos = [*block.center, half_height]
            geom.size = [*block.half_extent, half_height]
            geom.contype, geom.conaffinity = 0, WORLD_COLLISION
            geom.friction = [friction, 0.005, 0.0001]
            geom.rgba = [0.5, 0.52, 0.5, 1.0]

    def height(self, points: Tensor) -> Tensor:
        """Ground height [m] (...,) at world positions ``points`` (..., 2); zero outside the tiles."""
        if not self.blocks:
            return torch.zeros(points.shape[:-1], device=points.device)
        # One axis at a time: for the elevation maps twice as fast as both in one tensor.
        rows, columns = self._raster.shape
        (x, y), (x0, y0), resolution = points.unbind(-1), self._origin.unbind(), self.config.raster_resolution
        row = ((x - x0) / resolution + 1.0).clamp(0, rows - 1).int()
        column = ((y - y0) / resolution + 1.0).clamp(0, columns - 1).int()
        return torch.index_select(self._raster.flatten(), 0, (row * columns + column).flatten()).view(row.shape)

    def highest(self, center: Tensor, reach: float) -> Tensor:
        """Highest ground [m] (N,) within ``reach`` [m] of ``center`` (N, 2) along both axes."""
        count = 2 * round(reach / self.config.raster_resolution) + 1
        offsets = torch.linspace(-reach, reach, count, device=center.device)
        grid = torch.cartesian_prod(offsets, offsets)
        return self.height(center[:, None] + grid).amax(dim=1)

    def elevation_map(self, base_position: Tensor, heading: Tensor) -> Tensor:
        """Vertical distance base - terrain [m] (N, 121) on the egocentric grid, aligned with the heading.

        ``base_position`` (N, 3) world [m], ``heading`` (N,) [rad].
        """
        if not self.blocks:
            return base_position[:, 2:3].expand(-1, MAP_SIZE)
        offsets = rotate_about_vertical(heading[:, None], self._map_offsets[None])
        return base_position[:, 2:3] - self.height(base_position[:, None, :2] + offsets)
