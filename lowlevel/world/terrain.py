"""Terrain as blocks on a plane: one list of blocks makes both the collision geometry and the height raster.

Every robot of a batch lives in the same world, so the whole terrain is part of one shared model. A tile is a
square patch made by one function of :data:`TILES`. To add one, add a function there, and name it in the
terrain of a stage (:mod:`lowlevel.presets`) and in ``evaluation.protocols.crossing.OBSTACLES``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch
from torch import Tensor

from lowlevel.control.elevation_map import MAP_SIZE, map_points
from robots.errors import PilotError
from robots.g1.model import WORLD_COLLISION
from robots.rotations import rotate_about_vertical

MARGIN = 0.5
"""Flat ground around what stands on a tile [m]."""
LANDING = 2.0
"""Side of the flat top of slopes and stairs [m]."""
DEPTH = 0.5
"""How far blocks reach below the ground plane [m]: out of a thin one a foot that has sunk past its middle is pushed
downwards, and stays caught in it."""
STANCE_REACH = 0.3
"""No part of a standing robot's soles is farther than this from the base, horizontally and along each axis [m]."""


@dataclass(frozen=True)
class Block:
    """A box that stands on the ground plane, or a frustum: a box whose top face is smaller than its base."""

    center: tuple[float, float]
    """[m]"""
    half_extent: tuple[float, float]
    """Of its base along x and y [m]."""
    top: float
    """Height of its top face [m]."""
    half_top: tuple[float, float] | None = None
    """Half extent of its top face; as large as the base by default [m]."""

    def moved(self, x: float, y: float) -> Block:
        """The same block somewhere else."""
        return replace(self, center=(self.center[0] + x, self.center[1] + y))

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of its surface at points of its base."""
        if self.half_top is None:
            return np.full(np.broadcast_shapes(x.shape, y.shape), self.top)
        apart = (np.abs(x - self.center[0]), np.abs(y - self.center[1]))
        rises = [(b - d) / (b - t) for b, d, t in zip(self.half_extent, apart, self.half_top, strict=True)]
        return self.top * np.clip(np.minimum(*rises), 0.0, 1.0)


def flat(size: float, level: float, rng: np.random.Generator) -> list[Block]:
    """Nothing but the ground plane."""
    return []


def slabs(size: float, level: float, rng: np.random.Generator) -> list[Block]:
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


def roughness(level: float) -> float:
    """Largest height above and below the middle of rough ground [m]."""
    return 0.06 * level


def slope_angle(level: float) -> float:
    """2 to 20 degrees [rad]."""
    return math.radians(2.0 + 18.0 * level)


def riser_height(level: float) -> float:
    """Of stairs, 5 to 20 cm [m]."""
    return 0.05 + 0.15 * level


def platform_height(level: float) -> float:
    """10 to 30 cm [m]."""
    return 0.1 + 0.2 * level


def rough(size: float, level: float, rng: np.random.Generator) -> list[Block]:
    """Steps every 0.4 m, both ways, of up to twice the :func:`roughness`.

    The ground is the higher one of two crossing strips: a tenth of the blocks that as many slabs would take.
    """
    half, strip = size / 2.0, 0.4
    count = round(size / strip)
    centers = (np.arange(count) + 0.5) * strip - half
    tops = 0.002 + 2.0 * roughness(level) * rng.random((2, count))
    along = [Block((float(x), 0.0), (strip / 2, half), float(top)) for x, top in zip(centers, tops[0], strict=True)]
    across = [Block((0.0, float(y)), (half, strip / 2), float(top)) for y, top in zip(centers, tops[1], strict=True)]
    return along + across


def slope(size: float, level: float, rng: np.random.Generator) -> list[Block]:
    """Slopes up to a landing of 2 m in the middle."""
    base, landing = size / 2.0 - MARGIN, 0.5 * LANDING
    height = (base - landing) * math.tan(slope_angle(level))
    return [Block((0.0, 0.0), (base, base), height, (landing, landing))]


def stairs(size: float, level: float, rng: np.random.Generator) -> list[Block]:
    """Stairs up to a landing of 2 m in the middle, with treads of 25 to 35 cm."""
    riser, tread, landing = riser_height(level), float(rng.choice([0.25, 0.3, 0.35])), 0.5 * LANDING
    count = int((size / 2.0 - MARGIN - landing) / tread)
    return [Block((0.0, 0.0), (landing + (count - step) * tread,) * 2, (step + 1) * riser) for step in range(count + 1)]


def platform(size: float, level: float, rng: np.random.Generator) -> list[Block]:
    """Blocks of 0.5 m across the tile, to step onto and off."""
    length = size / 2.0 - MARGIN
    return [Block((x, 0.0), (0.25, length), platform_height(level)) for x in (-2.0, 0.0, 2.0)]


TileFunction = Callable[[float, float, np.random.Generator], list[Block]]
TILES: dict[str, TileFunction] = {tile.__name__: tile for tile in (flat, slabs, rough, slope, stairs, platform)}
"""Kinds of tile by name. A tile is blocks around its own center; the terrain places them."""


@dataclass(frozen=True)
class TerrainConfig:
    """Which tiles the world holds: every kind in every level."""

    tiles: tuple[str, ...] = ("flat",)
    """Kinds of tile, in a row along y; each is a key of :data:`TILES`."""
    levels: tuple[float, ...] = (1.0,)
    """Difficulties in [0, 1] in which there is one tile of each kind, along x."""
    tile_size: float = 8.0
    """Side of a square tile [m]."""
    raster_resolution: float = 0.05
    """Cell size of the height raster [m]."""
    seed: int = 0
    """Seed of the random tiles."""

    def number_of(self, kind: Tensor, level: Tensor) -> Tensor:
        """Numbers of tiles in ``Terrain.tile_centers``, from those of their ``kind`` and ``level`` in this terrain."""
        return kind * len(self.levels) + level

    def place_of(self, number: Tensor) -> tuple[Tensor, Tensor]:
        """Kinds and levels of tiles, the inverse of :meth:`number_of`."""
        return number // len(self.levels), number % len(self.levels)


def tile_shares(config: TerrainConfig, device: torch.device | str = "cpu") -> Tensor:
    """Equal shares of the kinds of tile in ``config``, (kinds,) in the order of :data:`TILES`."""
    present = torch.tensor([name in config.tiles for name in TILES], dtype=torch.float32, device=device)
    return present / present.sum()


class Terrain:
    """Blocks, the height raster built from them, and lookups on it.

    ``tile_centers`` (tiles, 2) [m]: those of the first kind first, from the first level to the last. ``relief``
    (tiles,) [m/m]: how much the ground rises and sinks along a line across a tile, per meter.
    """

    def __init__(self, config: TerrainConfig, device: torch.device | str = "cpu") -> None:
        unknown = [tile for tile in config.tiles if tile not in TILES]
        if unknown:
            raise PilotError(f"unknown terrain tile {unknown[0]!r}; choose from {', '.join(TILES)}")
        self.config = config
        rng = np.random.default_rng(config.seed)
        size = config.tile_size
        extent = np.array([len(config.levels), len(config.tiles)]) * size
        self._origin = torch.tensor(-extent / 2.0, dtype=torch.float32, device=device)
        centers, self.blocks = [], []
        for (row, tile), (column, level) in itertools.product(enumerate(config.tiles), enumerate(config.levels)):
            x, y = (np.array([column, row]) + 0.5) * size - extent / 2.0
            centers.append((float(x), float(y)))
            self.blocks += [block.moved(float(x), float(y)) for block in TILES[tile](size, level, rng)]
        self.tile_centers = torch.tensor(centers, dtype=torch.float32, device=device)
        raster = self._rasterize(extent)
        self.relief = torch.tensor([self._relief(raster, center) for center in centers], device=device)
        # The outermost cells stand for the plane around the tiles.
        self._raster = torch.from_numpy(np.pad(raster, 1)).to(device)
        self._map_offsets = map_points(device)

    def _rasterize(self, extent: np.ndarray) -> np.ndarray:
        """The highest surface at the center of every cell."""
        resolution = self.config.raster_resolution
        raster = np.zeros(np.round(extent / resolution).astype(int), dtype=np.float32)
        for block in self.blocks:
            low = (np.array(block.center) - block.half_extent + extent / 2.0) / resolution
            high = (np.array(block.center) + block.half_extent + extent / 2.0) / resolution
            (i0, j0), (i1, j1) = np.maximum(np.round(low).astype(int), 0), np.round(high).astype(int)
            cells = raster[i0:i1, j0:j1]
            x = (i0 + np.arange(cells.shape[0]) + 0.5) * resolution - extent[0] / 2.0
            y = (j0 + np.arange(cells.shape[1]) + 0.5) * resolution - extent[1] / 2.0
            heights = block.height(x[:, None], y[None])
            np.maximum(cells, heights, out=cells, casting="same_kind")
        return raster

    def _relief(self, raster: np.ndarray, center: tuple[float, float]) -> float:
        """Mean change of height per meter on the tile at ``center``, along both axes."""
        half, resolution = self.config.tile_size / 2.0, self.config.raster_resolution
        low = np.round((np.array(center) - half - self._origin.cpu().numpy()) / resolution).astype(int)
        cells = round(2.0 * half / resolution)
        tile = raster[low[0] : low[0] + cells, low[1] : low[1] + cells]
        changes = [np.abs(np.diff(tile, axis=axis)).mean() for axis in (0, 1)]
        return float(np.mean(changes)) / resolution

    def add_to(self, spec: mujoco.MjSpec, friction: float = 1.0) -> None:
        """Add the blocks as static geoms that feet and objects collide with."""
        for number, block in enumerate(self.blocks):
            geom = spec.worldbody.add_geom(name=f"terrain_{number}")
            if block.half_top is None:
                geom.type = mujoco.mjtGeom.mjGEOM_BOX
                geom.pos = [*block.center, 0.5 * (block.top - DEPTH)]
                geom.size = [*block.half_extent, 0.5 * (block.top + DEPTH)]
            else:
                base = block.half_extent
                corners = [
                    (sign_x * x, sign_y * y, z)
                    for (x, y), z in ((base, -DEPTH), (base, 0.0), (block.half_top, block.top))
                    for sign_x, sign_y in itertools.product((-1, 1), repeat=2)
                ]
                spec.add_mesh(name=f"terrain_{number}", uservert=np.array(corners).flatten())
                geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, f"terrain_{number}"
                geom.pos = [*block.center, 0.0]
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
