"""Kinds of command open when they are tracked, and are drawn by what they lack."""

import pytest
import torch

from lowlevel.commands import KINDS, shares
from lowlevel.curriculum import Curriculum, CurriculumConfig
from lowlevel.world.terrain import TILES

NAMES = list(KINDS)


def see(curriculum: Curriculum, quality: dict[str, float], fall_rate: float = 0.0) -> None:
    """One update after steps of the kinds in ``quality`` alone."""
    for name, value in quality.items():
        kind = torch.full((1000,), NAMES.index(name))
        fallen = torch.arange(1000) < 1000 * fall_rate
        curriculum.observe(kind, torch.zeros_like(kind), torch.full((1000,), value), fallen)
    curriculum.update()


def test_a_kind_opens_only_when_it_is_tracked_and_its_robots_stay_up() -> None:
    config = CurriculumConfig()
    for quality, fall_rate, opens in ((0.9, 0.0, True), (0.3, 0.0, False), (0.9, 0.02, False)):
        curriculum = Curriculum(config)
        for _ in range(400):
            see(curriculum, {"walk": quality}, fall_rate)
        opening = dict(zip(NAMES, curriculum.opening.tolist(), strict=True))
        assert opening["walk"] == pytest.approx(1.0 if opens else config.start)
        assert opening["squat"] == pytest.approx(config.start)  # nobody has tried


def test_a_kind_closes_again_when_its_robots_fall() -> None:
    curriculum = Curriculum(CurriculumConfig())
    for _ in range(60):
        see(curriculum, {"squat": 0.9})
    widest = curriculum.opening[NAMES.index("squat")].item()
    for _ in range(200):
        see(curriculum, {"squat": 0.9}, fall_rate=0.01)
    closed = curriculum.opening[NAMES.index("squat")].item()
    assert closed == pytest.approx(CurriculumConfig().start) and closed < widest - 0.05


def test_what_is_tracked_badly_is_drawn_more_often_down_to_a_floor() -> None:
    curriculum = Curriculum(CurriculumConfig())
    mixture = shares((("walk", 0.25), ("stand", 0.25), ("squat", 0.5)))
    for _ in range(100):
        see(curriculum, {"walk": 0.2, "stand": 0.9, "squat": 0.6})
    chance = dict(zip(NAMES, curriculum.kind_chances(mixture).tolist(), strict=True))
    assert sum(chance.values()) == pytest.approx(1.0)
    assert chance["walk"] > 0.25 > chance["stand"] >= 0.25 / 2.0 / 2.0
    assert chance["forward"] == 0.0


def test_conditions_become_harder_while_few_robots_fall_and_only_where_they_may() -> None:
    curriculum = Curriculum(CurriculumConfig())
    kind, quality = torch.zeros(1000, dtype=torch.long), torch.ones(1000)

    def update(fall_rate: float, hardens: bool = True) -> float:
        curriculum.observe(kind, kind, quality, torch.arange(1000) < 1000 * fall_rate)
        curriculum.update(hardens)
        return float(curriculum.hardness)

    assert [update(0.0, hardens=False) for _ in range(60)][-1] == 0.0
    hardest = [update(0.0) for _ in range(400)][-1]
    assert hardest == 1.0
    assert [update(0.01) for _ in range(60)][-1] < 0.9


def test_a_kind_that_was_not_told_for_a_while_opens_anew() -> None:
    curriculum = Curriculum(CurriculumConfig())
    for _ in range(300):
        see(curriculum, {"walk": 0.9, "squat": 0.9})
    assert float(curriculum.opening[NAMES.index("squat")]) == 1.0
    curriculum.introduce(torch.tensor([kind == "squat" for kind in KINDS]))
    start = pytest.approx(CurriculumConfig().start)
    assert float(curriculum.opening[NAMES.index("squat")]) == start
    assert float(curriculum.opening[NAMES.index("walk")]) == 1.0
    see(curriculum, {"squat": 0.9})
    assert float(curriculum.opening[NAMES.index("squat")]) == start


def test_state_round_trip() -> None:
    curriculum, other = Curriculum(CurriculumConfig()), Curriculum(CurriculumConfig())
    for _ in range(10):
        see(curriculum, {"walk": 0.9})
    other.load_state_dict(curriculum.state_dict())
    every = torch.ones(len(KINDS)), torch.ones(len(TILES))
    assert other.figures(*every) == curriculum.figures(*every)


def test_tiles_are_drawn_by_what_they_lack_too() -> None:
    curriculum = Curriculum(CurriculumConfig())
    tile_shares = torch.tensor([name in ("flat", "stairs") for name in TILES]) / 2.0
    for number, quality in ((0, 0.8), (list(TILES).index("stairs"), 0.4)):
        kind, tile = torch.zeros(100, dtype=torch.long), torch.full((100,), number)
        curriculum.observe(kind, tile, torch.full((100,), quality), torch.zeros(100))
    for _ in range(100):
        curriculum.update()
    chance = dict(zip(TILES, curriculum.tile_chances(tile_shares).tolist(), strict=True))
    assert chance["stairs"] > chance["flat"] > 0.2 and chance["platform"] == 0.0
    assert {"quality/stairs", "steps_between_falls/flat"} <= curriculum.figures(
        torch.ones(len(KINDS)), tile_shares
    ).keys()
