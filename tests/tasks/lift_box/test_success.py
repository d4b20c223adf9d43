"""The whole task, on the shipped controller: what the reports say must be what happens."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.protocols.policies import SCRIPTED, make_policy
from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.episodes import run_episodes
from highlevel.registry import find_controller, load_task

EPISODES = 8
SHIPPED = Path(__file__).resolve().parents[3] / "checkpoints" / "highlevel" / "lift-box"


USUAL, CONVERGED = PhysicsConfig(), PhysicsConfig(solver_iterations=100, line_search_iterations=100)


@pytest.mark.parametrize(
    ("planner", "physics"),
    [(SCRIPTED, USUAL), (str(SHIPPED), USUAL), (str(SHIPPED), CONVERGED)],
    ids=["scripted", "shipped", "converged solver"],
)
def test_the_box_is_lifted_and_held(planner: str, physics: PhysicsConfig) -> None:
    controller = find_controller()
    environment = CommandEnvironment(load_task("lift_box"), controller, EPISODES, physics=physics)
    records = run_episodes(environment, make_policy(planner, environment, controller), EPISODES, seed=7)
    failures = [record.failure for record in records if not record.success]
    # At 98 % it is 6 or fewer of 8 once in 100 runs of other episodes; these are always the same.
    assert len(failures) <= 2, failures
    for record in records:
        if record.success:
            assert list(record.stage_times) == sorted(record.stage_times) and len(record.stage_times) == 6
            assert 5.0 < record.duration < 15.0
