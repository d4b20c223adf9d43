"""The curriculum opens ranges in the paper's order, and only when tracking and survival allow it."""

from dataclasses import asdict

from lowlevel.commands import CommandRange
from lowlevel.curriculum import STAGES, Curriculum, CurriculumConfig

GOOD = {stage.reward: 1.0 for stage in STAGES}


def test_nothing_opens_while_robots_fall() -> None:
    curriculum = Curriculum(CurriculumConfig())
    curriculum.update(GOOD, survival=0.1)
    assert curriculum.open_range == CurriculumConfig().start


def test_stages_open_in_order_until_everything_is_open() -> None:
    curriculum = Curriculum(CurriculumConfig())
    opened: list[str] = []
    for _ in range(1500):
        before = asdict(curriculum.open_range)
        curriculum.update(GOOD, survival=1.0)
        opened += [k for k, v in asdict(curriculum.open_range).items() if v > before[k] and k not in opened]
    assert opened == [stage.name for stage in STAGES]
    assert curriculum.open_range == CommandRange()


def test_a_stage_waits_for_its_own_tracking() -> None:
    curriculum = Curriculum(CurriculumConfig())
    for _ in range(1500):
        curriculum.update(GOOD | {"base_height": 0.0}, survival=1.0)
    assert curriculum.open_range.velocity == 1.0
    assert curriculum.open_range.height == CurriculumConfig().start.height
    assert curriculum.open_range.torso == CurriculumConfig().start.torso


def test_state_round_trip() -> None:
    curriculum, other = Curriculum(CurriculumConfig()), Curriculum(CurriculumConfig())
    for _ in range(10):
        curriculum.update(GOOD, survival=1.0)
    other.load_state_dict(curriculum.state_dict())
    assert other.open_range == curriculum.open_range
