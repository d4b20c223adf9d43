"""Sweeps: every cell fixes what it says and nothing else, and its figure lands where it belongs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from evaluation.protocols.sweeps import cells, sweep_figures, sweep_result, write_plots
from highlevel.episodes import EpisodeRecord
from highlevel.registry import load_task
from highlevel.task import Sweep, SweepAxis, Task
from tasks.lift_box.config import LiftBoxConfig, SpawnConfig
from tasks.lift_box.episode import draw
from tasks.lift_box.sweeps import SWEEPS


def _configs(sweep: Sweep) -> list[LiftBoxConfig]:
    variants: list[Any] = list(cells(load_task("lift_box"), sweep))
    return [variant.config for variant in variants]


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.name)
def test_every_cell_is_another_condition(sweep: Sweep) -> None:
    configs = _configs(sweep)
    assert len(configs) == sweep.size
    assert len({repr(config) for config in configs}) == sweep.size
    assert all(config.stages == LiftBoxConfig().stages for config in configs)


def test_a_cell_fixes_its_quantities_and_draws_the_rest_as_always() -> None:
    by_name = {sweep.name: sweep for sweep in SWEEPS}
    number = torch.arange(50)
    usual, _ = draw(LiftBoxConfig(), 1, number)
    heavy_and_wide, _ = draw(_configs(by_name["mass_edge"])[-1], 1, number)
    assert (heavy_and_wide.mass == 3.0).all()
    torch.testing.assert_close(heavy_and_wide.size, torch.full((50, 3), SpawnConfig().edge[1]))
    assert torch.equal(heavy_and_wide.friction, usual.friction)
    floor, _, high = (draw(config, 1, number)[0] for config in _configs(by_name["support_height"]))
    assert (floor.support_height == 0.0).all() and (high.support_height == 0.35).all()
    assert torch.equal(high.mass, usual.mass)


def test_results_are_tabled_and_drawn(tmp_path: Path) -> None:
    sweep = SWEEPS[0]

    def run(variant: Task) -> list[EpisodeRecord]:
        config: Any = variant.config  # type: ignore[attr-defined]
        light = config.spawn.mass[0] < 1.5 and config.spawn.edge[0] < 0.3
        return [EpisodeRecord(i, light and i > 0, 6, None, 10.0, 0.0) for i in range(4)]

    result = sweep_result(sweep, [run(variant) for variant in cells(load_task("lift_box"), sweep)])
    figures = sweep_figures([result])
    assert {name for name, figure in figures.items() if figure.value == 0.75} == {
        "full_mass_edge_0.5_0.25",
        "full_mass_edge_1_0.25",
    }
    assert len(figures) == 12 and all(figure.n == 4 for figure in figures.values())
    assert result.table.startswith("| mass [kg] | 0.25 | 0.3 | 0.35 |")
    write_plots(tmp_path, [result])
    assert (tmp_path / "sweep_mass_edge.png").stat().st_size > 1000


def test_a_sweep_of_one_quantity_has_one_column() -> None:
    sweep = Sweep("push", SweepAxis("pushes", (0.0, 1.0), lambda config, _: config))
    result = sweep_result(sweep, [[EpisodeRecord(0, True, 6, None, 9.0, 0.0)]] * sweep.size)
    assert list(sweep_figures([result])) == ["full_push_0", "full_push_1"]
    assert result.column_labels == ["full success"]
