"""Robots climb from level to level by crossing what they are told to cross, and not by standing in front of it."""

import pytest
import torch

from lowlevel.environment import EnvironmentConfig, PilotEnvironment
from lowlevel.task import TaskConfig
from lowlevel.world.levels import CROSSED, LARGEST_ERROR, Levels
from lowlevel.world.terrain import TILES, Terrain, TerrainConfig

NAMES = list(TILES)
LEVELS = (0.0, 0.5, 1.0)
TERRAIN = Terrain(TerrainConfig(tiles=("flat", "stairs"), levels=LEVELS))


def judged(level: int, fallen: bool, error: float, share_crossed: float, robots: int = 200) -> torch.Tensor:
    """Levels on stairs of ``robots`` that were at ``level``, after one episode each."""
    levels, ids = Levels(TERRAIN, robots), torch.arange(robots)
    levels.reached[:] = level
    kind, tile = torch.full((robots,), NAMES.index("stairs")), torch.full((robots,), len(LEVELS) + level)
    climbed = torch.full((robots,), share_crossed * CROSSED * float(TERRAIN.relief[len(LEVELS) + level]))
    generator = torch.Generator().manual_seed(0)
    levels.judge(ids, kind, tile, torch.full((robots,), fallen), torch.full((robots,), error), climbed, generator)
    assert (levels.reached[:, NAMES.index("flat")] == level).all()
    return levels.reached[:, NAMES.index("stairs")]


@pytest.mark.parametrize(
    ("fallen", "error", "share_crossed", "change"),
    [
        (False, 0.9 * LARGEST_ERROR, 1.1, 1),
        (False, 0.9 * LARGEST_ERROR, 0.9, 0),  # it only stood there
        (False, 1.1 * LARGEST_ERROR, 1.1, 0),
        (True, 0.9 * LARGEST_ERROR, 1.1, -1),
    ],
)
def test_a_level_is_climbed_by_success_and_not_by_survival(
    fallen: bool, error: float, share_crossed: float, change: int
) -> None:
    assert (judged(1, fallen, error, share_crossed) == 1 + change).all()


def test_the_first_level_is_the_lowest_and_who_masters_the_last_is_spread_over_all() -> None:
    assert (judged(0, True, 0.0, 0.0) == 0).all()
    assert set(judged(len(LEVELS) - 1, False, 0.0, 1.1).tolist()) == set(range(len(LEVELS)))


def test_robots_start_on_tiles_of_the_drawn_kind_at_their_level() -> None:
    levels = Levels(TERRAIN, 300)
    levels.reached[:, NAMES.index("stairs")] = 2
    chances = torch.tensor([{"flat": 0.25, "stairs": 0.75}.get(name, 0.0) for name in NAMES])
    kind, tile = levels.draw(torch.arange(300), chances, torch.Generator().manual_seed(0))
    on_stairs = kind == NAMES.index("stairs")
    assert 0.65 < on_stairs.float().mean() < 0.85
    assert (tile[on_stairs] == len(LEVELS) + 2).all() and (tile[~on_stairs] == 0).all()
    assert levels.figures() == {"level/flat": 0.0, "level/stairs": 1.0}


def test_relief_is_what_a_line_across_the_stairs_climbs() -> None:
    # Stairs up to a landing and down again: from side to side through the middle, each riser twice.
    tile = TerrainConfig(tiles=("stairs",), levels=(1.0,))
    terrain = Terrain(tile)
    line = torch.linspace(-3.99, 3.99, 800)
    through_the_middle = terrain.height(torch.stack([line, torch.full_like(line, 0.02)], dim=1)).diff().abs().sum()
    assert 0.3 * through_the_middle < float(terrain.relief[0]) * 8.0 < through_the_middle
    assert float(Terrain(TerrainConfig()).relief[0]) == 0.0


def test_an_environment_counts_what_its_robots_climb() -> None:
    terrain = TerrainConfig(tiles=("stairs",), levels=LEVELS)
    environment = PilotEnvironment(EnvironmentConfig(num_robots=8, num_threads=1), TaskConfig(terrain=terrain))
    environment.reset()
    buffers = environment.buffers
    assert (buffers.tile_kind == NAMES.index("stairs")).all() and (buffers.tile == 0).all()
    ground, climbed = buffers.ground.clone(), torch.zeros(8)
    for _ in range(20):
        result = environment.step(torch.randn(8, 29, generator=torch.Generator().manual_seed(0)))
        below = environment.world.terrain.height(result.measured.robot.base_position[:, :2])
        climbed, ground = climbed + (below - ground).abs(), below
    going_on = buffers.episode_step == 20
    assert going_on.any()
    assert torch.allclose(buffers.climbed[going_on], climbed[going_on])
    resumed = PilotEnvironment(environment.config, environment.task, seed=5)
    resumed.reset()
    environment.levels.reached[:] = 2
    resumed.load_state_dict(environment.state_dict())
    assert torch.equal(resumed.levels.reached, environment.levels.reached)


def test_a_mastered_level_leads_to_the_next_tile(monkeypatch: pytest.MonkeyPatch) -> None:
    terrain = TerrainConfig(tiles=("stairs",), levels=LEVELS)
    config = EnvironmentConfig(num_robots=4, num_threads=1, episode_length=0.1)
    environment = PilotEnvironment(config, TaskConfig(terrain=terrain))
    environment.reset()
    monkeypatch.setattr("lowlevel.world.levels.CROSSED", 0.0)
    for _ in range(5):
        result = environment.step(torch.zeros(4, 29))
    assert result.truncated.all() and (environment.buffers.tile == 1).all()
