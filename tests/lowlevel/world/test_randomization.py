from __future__ import annotations

from dataclasses import replace

import pytest

from lowlevel.world.randomization import RandomizationConfig, between


def test_conditions_on_the_way_from_easy_to_hard() -> None:
    easy, hard = (
        RandomizationConfig.for_evaluation(),
        RandomizationConfig(friction=(0.2, 1.2), push_velocity=0.8, standing_push_velocity=1.0),
    )
    assert between(easy, hard, 0.0) == easy and between(easy, hard, 1.0) == hard
    halfway = between(easy, hard, 0.5)
    assert halfway.friction == pytest.approx((0.4, 1.1))
    assert halfway.delay == pytest.approx((0.7, 0.2, 0.1))
    assert replace(halfway, push_velocity=0.4, standing_push_velocity=0.5) == halfway
