"""The height raster against MuJoCo's ray casting on the same blocks."""

import math

import mujoco
import numpy as np
import pytest
import torch

from lowlevel.control.elevation_map import MAP_CELLS, MAP_MIRROR, MAP_RESOLUTION
from lowlevel.world.terrain import TILES, Terrain, TerrainConfig


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return Terrain(TerrainConfig(tiles=("flat", "slabs")))


def scene(terrain: Terrain) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    terrain.add_to(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("tile", TILES)
def test_heights_agree_with_ray_casting(tile: str) -> None:
    """Exactly in the middle of the raster's cells, and on slopes, which it has in steps, within 1 cm anywhere."""
    terrain = Terrain(TerrainConfig(tiles=("flat", tile), levels=(0.0, 0.5, 1.0)))
    model, data = scene(terrain)
    rng = np.random.default_rng(0)
    anywhere = rng.uniform([-13, -9], [13, 9], (1500, 2))
    middles = (np.floor(anywhere / 0.05) + 0.5) * 0.05
    geom = np.zeros(1, dtype=np.int32)

    def errors(points: np.ndarray) -> np.ndarray:
        heights = terrain.height(torch.tensor(points, dtype=torch.float32)).numpy()
        rays = []
        for point in points:
            start = np.array([*point, 3.0])
            rays.append(3.0 - mujoco.mj_ray(model, data, start, np.array([0, 0, -1.0]), None, 1, -1, geom, None))
        return np.abs(heights - rays)

    assert errors(middles).max() < 1e-5
    if tile == "slope":
        assert errors(anywhere).max() < 0.01
    assert (terrain.height(torch.tensor(middles, dtype=torch.float32)) > 0.0).any() or tile == "flat"


@pytest.mark.parametrize(("tile", "lowest", "highest"), [("stairs", 0.05, 0.2), ("platform", 0.1, 0.3)])
def test_edges_are_as_high_as_the_level_says(tile: str, lowest: float, highest: float) -> None:
    for level, edge in ((0.0, lowest), (0.5, 0.5 * (lowest + highest)), (1.0, highest)):
        tops = sorted({0.0, *(block.top for block in TILES[tile](8.0, level, np.random.default_rng(3)))})
        np.testing.assert_allclose(np.diff(tops), edge)


def test_a_slope_rises_by_its_angle() -> None:
    terrain = Terrain(TerrainConfig(tiles=("slope",), levels=(1.0,)))
    low, high = terrain.height(torch.tensor([[-3.025, 0.025], [-1.525, 0.025]])).tolist()
    assert math.degrees(math.atan((high - low) / 1.5)) == pytest.approx(20.0, abs=0.05)


def test_tiles_lie_by_kind_and_level() -> None:
    terrain = Terrain(TerrainConfig(tiles=("flat", "platform", "stairs"), levels=(0.0, 1.0)))
    heights = terrain.height(terrain.tile_centers)
    assert heights[:4].tolist() == pytest.approx([0.0, 0.0, 0.1, 0.3])
    assert heights[5] > 3.0 * heights[4] > 1.0
    assert torch.pdist(terrain.tile_centers).min() == pytest.approx(8.0)


def test_the_highest_ground_is_that_of_the_slabs_within_reach(terrain: Terrain) -> None:
    centers = torch.tensor([[0.3, 5.0], [-2.1, 3.3], [1.7, -4.0]])
    found = terrain.highest(centers, 0.3)
    for center, height in zip(centers, found, strict=True):
        tops = [0.0]
        for block in terrain.blocks:
            apart = np.abs(np.array(block.center) - center.numpy()) - block.half_extent
            tops += [block.top] if (apart < 0.3 - 1e-6).all() else []
        assert height.item() == pytest.approx(max(tops), abs=1e-6)


def test_slabs_stay_within_two_centimeters_of_their_mean(terrain: Terrain) -> None:
    tops = np.array([block.top for block in terrain.blocks])
    assert tops.max() - tops.min() <= 0.04
    assert tops.std() > 0.005


def test_elevation_map_is_egocentric(terrain: Terrain) -> None:
    position = torch.tensor([[0.3, 4.2, 0.8]])
    heading = torch.tensor([0.7])
    elevation = terrain.elevation_map(position, heading)[0].view(MAP_CELLS, MAP_CELLS)
    ahead, left = 8, 2
    forward = (ahead - 5) * MAP_RESOLUTION
    sideways = (left - 5) * MAP_RESOLUTION
    x = position[0, 0] + forward * torch.cos(heading[0]) - sideways * torch.sin(heading[0])
    y = position[0, 1] + forward * torch.sin(heading[0]) + sideways * torch.cos(heading[0])
    expected = position[0, 2] - terrain.height(torch.stack([x, y])[None])[0]
    assert elevation[ahead, left] == pytest.approx(expected.item(), abs=1e-6)


def test_mirroring_the_map_swaps_left_and_right() -> None:
    elevation = np.arange(MAP_CELLS**2, dtype=float)
    grid, mirrored = elevation.reshape(11, 11), MAP_MIRROR(elevation).reshape(11, 11)
    assert np.array_equal(mirrored, grid[:, ::-1])
    assert np.array_equal(MAP_MIRROR(MAP_MIRROR(elevation)), elevation)


def test_flat_ground_needs_no_raster() -> None:
    ground = Terrain(TerrainConfig(tiles=("flat",)))
    assert torch.equal(ground.height(torch.randn(5, 2)), torch.zeros(5))
    assert torch.equal(ground.elevation_map(torch.tensor([[1.0, 2.0, 0.7]]), torch.zeros(1)), torch.full((1, 121), 0.7))


def test_unknown_tile_is_named() -> None:
    with pytest.raises(ValueError, match=r"'lava'.*flat"):
        Terrain(TerrainConfig(tiles=("lava",)))


def test_every_tile_function_keeps_inside_its_tile() -> None:
    for function in TILES.values():
        for block in function(8.0, 1.0, np.random.default_rng(0)):
            assert all(abs(c) + h <= 4.0 + 1e-9 for c, h in zip(block.center, block.half_extent, strict=True))
