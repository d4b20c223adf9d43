"""The option loop: determinism, resets in the middle, frozen controller, ends inside an option."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from highlevel.environment import CommandEnvironment, PhysicsConfig, StepResult
from highlevel.registry import load_task
from highlevel.task import Decision, Outcome
from lowlevel.commands import HEIGHT
from lowlevel.control.controller import Controller
from lowlevel.runs.checks import NonFiniteError
from lowlevel.world.measures import Measurement
from lowlevel.world.randomization import RandomizationConfig
from robots.errors import PilotError

Make = Callable[..., CommandEnvironment]


def _actions(decisions: int, robots: int, seed: int = 0) -> Tensor:
    return 2.0 * torch.rand(decisions, robots, 21, generator=torch.Generator().manual_seed(seed)) - 1.0


def _run(environment: CommandEnvironment, actions: Tensor) -> list[StepResult]:
    return [environment.step(action) for action in actions]


def test_the_same_seed_gives_the_same_episodes_in_the_same_and_in_another_instance(
    make_environment: Make,
) -> None:
    actions = _actions(12, 3)
    first, second = make_environment(3), make_environment(3)
    runs = []
    for environment in (first, first, second):
        start = environment.reset(seed=5)
        results = _run(environment, actions)
        runs.append((start, torch.stack([r.observation for r in results]), torch.stack([r.reward for r in results])))
    for other in runs[1:]:
        for a, b in zip(runs[0], other, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert not torch.equal(first.reset(seed=6), runs[0][0])


def test_an_episode_begun_in_the_middle_of_a_batch_equals_a_fresh_one(make_environment: Make) -> None:
    environment = make_environment(2)
    environment.reset(seed=1)
    for step in range(150):
        result = environment.step(_actions(1, 2, step)[0])
        if bool(result.done[0]) and not bool(result.done[1]):
            break
    else:
        pytest.fail("the untrained controller was expected to fall")
    began, numbers = result.observation[0], environment.episode.clone()
    actions = 0.1 * _actions(5, 2, 99)
    later = [environment.step(action) for action in actions]

    fresh = make_environment(2)
    fresh.reset(seed=1)
    fresh.episode = numbers
    assert not any(bool(result.done[0]) for result in later)
    fresh._begin(torch.arange(2))
    torch.testing.assert_close(fresh.observe()[0], began, rtol=0, atol=0)
    again = [fresh.step(action) for action in actions]
    for a, b in zip(later, again, strict=True):
        torch.testing.assert_close(a.final_observation[0], b.final_observation[0], rtol=1e-4, atol=1e-4)


def test_environments_that_are_given_one_controller_do_not_disturb_each_other(
    make_environment: Make, untrained_controller: Path, coarse_physics: PhysicsConfig
) -> None:
    shared = Controller.load(untrained_controller)
    first, second = (CommandEnvironment(load_task("lift_box"), shared, 2, 0, coarse_physics) for _ in range(2))
    alone = make_environment()
    actions = _actions(6, 2)
    expected = [alone.reset(seed=1), *(result.observation for result in _run(alone, actions))]
    observed = [first.reset(seed=1)]
    second.reset(seed=2)
    for action in actions:
        observed.append(first.step(action).observation)
        second.step(-action)
    torch.testing.assert_close(torch.stack(observed), torch.stack(expected), rtol=0, atol=0)


def test_late_targets_arrive_late_and_an_episodes_robot_is_the_same_in_any_row(make_environment: Make) -> None:
    drawn = replace(RandomizationConfig.for_evaluation(), delay=(0.0, 0.0, 1.0), waist_effort=(35.0, 50.0))
    late = make_environment(3, randomization=drawn)
    sent: list[Tensor] = []
    advance = late.world.advance
    late.world.advance = lambda targets: sent.append(targets) or advance(targets)  # type: ignore[assignment, func-returns-value]
    late.reset(seed=1)
    start = late.simulation.read().joint_position.clone()
    waist = [late.simulation.model.actuator(f"waist_{axis}_joint").id for axis in ("roll", "pitch")]
    limits = late.simulation.per_robot("actuator_forcerange")[:, waist, 1].copy()
    assert (limits > 35.0).all() and (limits < 50.0).all() and len(set(limits.flatten().tolist())) == 6
    late.step(_actions(1, 3)[0])
    torch.testing.assert_close(sent[0], start, rtol=0, atol=1e-5)
    torch.testing.assert_close(sent[1], start, rtol=0, atol=1e-5)
    assert not torch.allclose(sent[2], start, atol=1e-3)

    other = make_environment(2, randomization=drawn)
    other.seed, other.episode = 1, torch.tensor([2, 0])
    other._begin(torch.arange(2))
    swapped = other.simulation.per_robot("actuator_forcerange")[:, waist, 1]
    np.testing.assert_array_equal(swapped, limits[[2, 0]])


def test_a_task_belongs_to_one_environment(untrained_controller: Path, coarse_physics: PhysicsConfig) -> None:
    task = load_task("lift_box")
    CommandEnvironment(task, untrained_controller, physics=coarse_physics)
    with pytest.raises(PilotError, match="belongs to another environment already: make a task for each"):
        CommandEnvironment(task, untrained_controller, physics=coarse_physics)


def test_what_is_not_finite_is_refused(make_environment: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = make_environment()
    environment.reset(seed=0)
    seen = environment.task.observe
    spoilt = {"box_position": torch.tensor([[0.0], [math.nan]]).expand(2, 3)}
    monkeypatch.setattr(environment.task, "observe", lambda *arguments: seen(*arguments) | spoilt)
    with pytest.raises(NonFiniteError, match="observation is not finite in 1 of 2 rows: 1"):
        environment.observe()


def test_every_block_is_as_wide_as_it_says(make_environment: Make) -> None:
    environment = make_environment()
    environment.reset(seed=0)
    seen = environment.task.observe(environment.measured, torch.ones(2))
    blocks = (*environment.task.object_blocks, *environment.task.added_blocks)
    assert {name: tuple(value.shape) for name, value in seen.items()} == {b.name: (2, b.size) for b in blocks}
    assert environment.observe().shape == (2, environment.observation_size)


def test_the_observed_previous_command_is_the_limited_and_feasible_one(make_environment: Make) -> None:
    environment = make_environment()
    environment.reset(seed=0)
    deep = torch.zeros(2, 21)
    deep[:, 3], deep[:, 5] = -1.0, 1.0
    result = environment.step(deep)
    names = [block.name for block in environment.blocks]
    start = sum(block.size for block in environment.blocks[: names.index("previous_command")])
    seen = result.final_observation[:, start : start + 21]
    torch.testing.assert_close(seen, environment.action_map.normalize(environment.command))
    assert torch.allclose(environment.command[:, HEIGHT], torch.tensor(0.72), atol=1e-4)
    clamped = environment.controller.clamp_command(environment.command)
    torch.testing.assert_close(clamped, environment.command)


def test_rewards_add_up_over_the_option_and_stop_where_the_episode_ends(
    make_environment: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = make_environment()
    environment.reset(seed=0)
    calls = []

    def judge(measured: Measurement, decision: Decision) -> Outcome:
        calls.append(1)
        success = torch.tensor([len(calls) == 3, False])
        return Outcome(torch.ones(2), success, torch.zeros(2, dtype=torch.bool))

    monkeypatch.setattr(environment.task, "step", judge)
    result = environment.step(torch.zeros(2, 21))
    assert len(calls) == environment.task.action.decision_steps == 5
    assert result.reward.tolist() == [3.0, 5.0]
    assert result.success.tolist() == [True, False]
    assert result.done.tolist() == [True, False]
    assert environment.episode.tolist() == [2, 1]
    assert not torch.equal(result.observation[0], result.final_observation[0])
    torch.testing.assert_close(result.observation[1], result.final_observation[1])


def test_an_episode_that_runs_out_of_time_has_failed(make_environment: Make) -> None:
    environment = make_environment()
    environment.reset(seed=0)
    environment.decisions[:] = environment.max_decisions - 1
    result = environment.step(environment.action_map.action(environment.command))
    assert result.done.all() and not result.success.any()
    assert set(result.failures.values()) == {"approach_timeout"}
    assert (environment.decisions == 0).all()


def test_bad_actions_are_refused(make_environment: Make) -> None:
    environment = make_environment()
    with pytest.raises(RuntimeError, match="call reset"):
        environment.step(torch.zeros(2, 21))
    environment.reset(seed=0)
    for bad in (torch.zeros(3, 21), torch.full((2, 21), float("nan"))):
        with pytest.raises(ValueError, match="finite and of shape"):
            environment.step(bad)
