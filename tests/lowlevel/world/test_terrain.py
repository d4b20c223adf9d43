"""The height raster against MuJoCo's ray casting on the same blocks."""

import mujoco
import numpy as np
import pytest
import torch

from lowlevel.control.elevation_map import MAP_CELLS, MAP_MIRROR, MAP_RESOLUTION
from lowlevel.world.terrain import TILES, Terrain, TerrainConfig


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return Terrain(TerrainConfig(tiles=("flat", "irregular")))


def scene(terrain: Terrain) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    terrain.add_to(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_heights_agree_with_ray_casting(terrain: Terrain) -> None:
    model, data = scene(terrain)
    points = np.random.default_rng(0).uniform([-5, -9], [5, 9], (300, 2))
    heights = terrain.height(torch.tensor(points, dtype=torch.float32)).numpy()
    geom = np.zeros(1, dtype=np.int32)
    for point, height in zip(points, heights, strict=True):
        start = np.array([*point, 2.0])
        distance = mujoco.mj_ray(model, data, start, np.array([0, 0, -1.0]), None, 1, -1, geom, None)
        assert 2.0 - distance == pytest.approx(height, abs=1e-6)


def test_the_highest_ground_is_that_of_the_slabs_within_reach(terrain: Terrain) -> None:
    centers = torch.tensor([[0.3, 5.0], [-2.1, 3.3], [1.7, -4.0]])
    found = terrain.highest(centers, 0.3)
    for center, height in zip(centers, found, strict=True):
        tops = [0.0]
        for block in terrain.blocks:
            apart = np.abs(np.array(block.center) - center.numpy()) - block.half_extent
            tops += [block.top] if (apart < 0.3 - 1e-6).all() else []
        assert height.item() == pytest.approx(max(tops), abs=1e-6)


def test_irregularities_stay_within_two_centimeters_of_their_mean(terrain: Terrain) -> None:
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
