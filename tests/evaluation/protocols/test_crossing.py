"""Who crosses: robots that reach the far side on their own feet, told to walk straight and steered."""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from evaluation.protocols.arena import Arena, Moment
from evaluation.protocols.crossing import (
    LEVELS,
    OBSTACLES,
    SPEED,
    TERRAIN,
    TILE_SIZE,
    crossing_episodes,
    crossing_figures,
    level_names,
    run_crossing,
    until,
)
from evaluation.protocols.trace import Trace, record
from evaluation.protocols.tracking import CHANNELS, GROUPS, tabulate
from lowlevel.commands import VELOCITY, is_walking
from lowlevel.control.controller import Controller
from lowlevel.world.terrain import MARGIN, Terrain


@pytest.fixture(scope="module")
def controller(untrained_controller: Path) -> Controller:
    return Controller.load(untrained_controller)


@pytest.fixture(scope="module")
def arena(controller: Controller) -> Arena:
    return Arena(controller, TERRAIN, num_threads=1, batch=4)


def test_every_tile_has_its_turn_and_an_episode_is_the_same_in_evaluations_of_any_size(arena: Arena) -> None:
    few, many = crossing_episodes(arena.space, 3, 7), crossing_episodes(arena.space, 60, 7)
    for a, b in zip(few, many, strict=False):
        assert a.seed == b.seed and torch.equal(a.commands, b.commands)
    assert sorted({episode.tile for episode in many}) == list(range(len(TERRAIN.tiles) * len(LEVELS)))
    for episode in many:
        assert bool(is_walking(episode.commands).all()) and (episode.flags == 1.0).all()
        assert episode.commands[:, VELOCITY].tolist() == [[SPEED, 0.0, 0.0]] * 2


def test_names_of_levels_say_what_stands_there() -> None:
    assert level_names("stairs")[3] == "stairs_15.0 cm" and level_names("platform")[-1] == "platform_30 cm"
    terrain = Terrain(TERRAIN)
    stairs = list(TERRAIN.tiles).index("stairs") * len(LEVELS) + 3
    tops = {
        round(block.top, 6)
        for block in terrain.blocks
        if abs(block.center[0] - float(terrain.tile_centers[stairs][0])) < TILE_SIZE / 2
        and abs(block.center[1] - float(terrain.tile_centers[stairs][1])) < TILE_SIZE / 2
    }
    assert min(tops) == pytest.approx(0.15) and all(math.isclose(top / 0.15, round(top / 0.15)) for top in tops)


def test_robots_start_before_their_tile_facing_it_and_are_steered_back_to_it(arena: Arena) -> None:
    episodes = [e for e in crossing_episodes(arena.space, 50, 3) if e.tile // len(LEVELS) == 3][:4]
    moments: list[Moment] = []
    for moment in arena.run(episodes):
        moments.append(moment)
        if len(moments) == 25:
            break
    centers = arena.world.terrain.tile_centers[[episode.tile for episode in episodes]]
    place = moments[0].measured.robot.base_position[:, :2] - centers
    assert (place[:, 0] < -TILE_SIZE / 2 + MARGIN).all() and (place[:, 1].abs() < 0.6).all()
    assert float(arena.world.terrain.height(place + centers).max()) == 0.0
    for before, after in itertools.pairwise(moments):
        assert torch.allclose(after.command[:, 2], -before.measured.heading, atol=1e-6)
    assert float(moments[-1].measured.heading.abs().max()) > 0.01  # without noise on it nobody would need to steer


def place_of(*ways: Sequence[float]) -> np.ndarray:
    return np.array(ways)


def test_who_crosses_climbs_and_descends() -> None:
    stairs = list(TERRAIN.tiles).index("stairs") * len(LEVELS)
    far, top, bottom = 3.6, -0.9, -3.0
    nan = np.nan
    place = place_of(
        [bottom, top, far, far],  # crosses, and whatever comes later does not matter
        [bottom, top, nan, nan],  # falls on the way down
        [bottom, nan, bottom, far],  # falls, and crosses when it is stood up again
        [bottom, bottom, bottom, bottom],  # does not move
    )
    out = np.zeros_like(place, dtype=bool)
    out[0, 3], out[1, 1], out[2, 0] = True, False, True
    out[1, 2] = True
    figures = crossing_figures(place, out, torch.tensor([stairs] * 4))
    assert figures["crosses"].value == figures["crosses_stairs_5.0 cm"].value == 0.25
    assert figures["climbs_stairs_5.0 cm"].value == 0.5 and figures["descends_stairs_5.0 cm"].value == 0.5
    assert figures["crosses_stairs_20.0 cm"].value is None and figures["crosses_flat"].n == 0


def test_figures_end_with_the_crossing() -> None:
    trace = Trace(0.02, {"E_v": np.ones((1, 4), np.float32)}, np.array([[0, 0, 0, 1]], bool), np.zeros((1, 4), bool))
    cut = until(trace, np.array([[False, False, True, True]]))
    assert np.isnan(cut["E_v"][0]).tolist() == [False, False, True, True] and not cut.has_fallen[0]
    assert trace.has_fallen[0] and not np.isnan(trace["E_v"]).any()


def test_commands_that_begin_once_a_tile_is_crossed_count_for_nothing(arena: Arena) -> None:
    episodes = crossing_episodes(arena.space, 2, 0)
    trace = record(arena, episodes, CHANNELS)
    over = np.zeros(trace.fell.shape, dtype=bool)
    over[0, round(8.0 / trace.period) :] = True
    table, _ = tabulate(until(trace, over), episodes, TERRAIN)
    assert np.isnan(table.columns["E_v"][:2]).tolist() == [False, True]
    assert [GROUPS[group] for group in table.group] == ["walk_and_work"] * 4


def test_a_controller_that_only_stands_crosses_nothing(arena: Arena) -> None:
    episodes = crossing_episodes(arena.space, 4, 0)
    table, transient, figures = run_crossing(arena, episodes)
    assert figures["crosses"].value == 0.0 and figures["crosses"].n == 4
    assert table.tile.tolist() == [0] * 8 and len(transient) > 0
    expected = {f"crosses_{name}" for kind in OBSTACLES for name in level_names(kind)}
    assert expected <= figures.keys()
