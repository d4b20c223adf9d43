"""Demonstrations and behavior cloning, on a target that can be computed by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from torch import Tensor

from highlevel.environment import CommandEnvironment, StepResult
from highlevel.learning.cloning import CloningConfig, clone
from highlevel.learning.demonstrations import Demonstrations, Source, record
from highlevel.learning.policy import PlannerNetwork, policy_arguments
from highlevel.vec_env import PlannerVecEnv
from lowlevel.world.measures import Measurement
from robots.errors import PilotError
from tasks.lift_box.config import LiftBoxConfig
from tasks.lift_box.episode import draw

Make = Callable[..., CommandEnvironment]


class _Standing:
    """Asks for standing still."""

    def __init__(self, environment: CommandEnvironment) -> None:
        self._environment = environment
        self.resets: list[list[int]] = []

    def act(self, observation: Tensor) -> Tensor:
        neutral = self._environment.controller.command_space.neutral()
        return self._environment.action_map.action(neutral.repeat(len(observation), 1))

    def reset(self, ids: Tensor) -> None:
        self.resets.append(ids.tolist())


def _short_wins(environment: CommandEnvironment, monkeypatch: pytest.MonkeyPatch, decisions: int) -> None:
    """Make every episode a success after ``decisions``, with a reward of one per control step."""
    from highlevel.task import Decision, Outcome

    def judge(measured: Measurement, decision: Decision) -> Outcome:
        success = environment.decisions >= decisions
        return Outcome(torch.ones(environment.num_envs), success, torch.zeros_like(success))

    monkeypatch.setattr(environment.task, "step", judge)


def test_recorded_returns_are_discounted_sums(
    make_environment: Make, monkeypatch: pytest.MonkeyPatch, source: Source
) -> None:
    environment = make_environment(2)
    _short_wins(environment, monkeypatch, 3)
    expert = _Standing(environment)
    halving = replace(source, discount=0.5)
    demonstrations = record(environment, expert, 4, seed=0, noise=0.05, source=halving)
    assert demonstrations.count == 4 and demonstrations.attempts == 4
    assert demonstrations.observation.shape == (12, environment.observation_size)
    # Rewards of 5, 5 and 1: the last option ends at its first control step.
    np.testing.assert_allclose(demonstrations.value[:3], [5 + 0.5 * (5 + 0.5), 5 + 0.5, 1.0])
    assert expert.resets == [[0, 1], [0, 1], [0, 1]]
    wanted = expert.act(torch.zeros(1, 1))[0].numpy()
    np.testing.assert_allclose(demonstrations.action, np.tile(wanted, (12, 1)), atol=1e-6)


def test_demonstrations_survive_a_round_trip_and_damage_is_reported(tmp_path: Path, source: Source) -> None:
    rng = np.random.default_rng(0)
    demonstrations = Demonstrations(
        source,
        rng.normal(size=(6, 4)).astype(np.float32),
        rng.uniform(-1, 1, (6, 21)).astype(np.float32),
        np.arange(6, dtype=np.float32),
        np.array([0, 0, 0, 2, 2, 2]),
        5,
    )
    path = tmp_path / "demonstrations.npz"
    with pytest.raises(PilotError, match="does not exist"):
        Demonstrations.load(path)
    demonstrations.save(path)
    loaded = Demonstrations.load(path)
    np.testing.assert_array_equal(loaded.action, demonstrations.action)
    assert loaded.count == 2 and loaded.attempts == 5 and loaded.source == source
    assert loaded.joined(demonstrations).count == 4
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match="does not hold demonstrations"):
        Demonstrations.load(path)
    demonstrations.value[0] = np.nan
    demonstrations.save(path)
    with pytest.raises(ValueError, match="'value' that are not finite"):
        Demonstrations.load(path)


def test_cloning_learns_a_known_policy_and_its_value(make_environment: Make, source: Source) -> None:
    environment = make_environment(2)
    torch.manual_seed(0)
    size = environment.observation_size
    scale = torch.ones(size)
    network = PlannerNetwork(hidden=(64, 64))
    model = PPO("MlpPolicy", PlannerVecEnv(environment), policy_kwargs=policy_arguments(network, scale), device="cpu")
    rng = np.random.default_rng(0)
    observation = np.full((3000, size), 3.0, np.float32)
    observation[:, :21] += 2.0 * rng.normal(size=(3000, 21))
    action = np.tanh(observation[:, :21] - 3.0).astype(np.float32)
    demonstrations = Demonstrations(
        source, observation, action, observation[:, 0] * 2.0, np.repeat(np.arange(100), 30), attempts=100
    )
    std_before = model.policy.log_std.detach().clone()
    config = CloningConfig(epochs=40, batch_size=256, learning_rate=3e-3, observation_noise=0.0)
    result = clone(model.policy, demonstrations, scale, config, seed=0)
    assert result.held_out_error < 0.35 < action.std()
    assert result.value_error < 0.3 * demonstrations.value.std()
    torch.testing.assert_close(model.policy.log_std.detach(), std_before)
    normalizer = model.policy.features_extractor
    torch.testing.assert_close(normalizer.mean, torch.full((size,), 3.0), atol=0.2, rtol=0)


def test_cloning_refuses_foreign_demonstrations(make_environment: Make, source: Source) -> None:
    environment = make_environment(2)
    scale = torch.ones(environment.observation_size)
    arguments = policy_arguments(PlannerNetwork(hidden=(8,)), scale)
    model = PPO("MlpPolicy", PlannerVecEnv(environment), policy_kwargs=arguments, device="cpu")

    def demonstrations(count: int, width: int) -> Demonstrations:
        zeros = np.zeros((count, width), np.float32)
        return Demonstrations(
            source, zeros, np.zeros((count, 21), np.float32), np.zeros(count, np.float32), np.zeros(count), 1
        )

    with pytest.raises(ValueError, match="record them again"):
        clone(model.policy, demonstrations(4, 3), scale, CloningConfig(), seed=0)
    with pytest.raises(ValueError, match="record some first"):
        clone(model.policy, demonstrations(0, len(scale)), scale, CloningConfig(), seed=0)


def test_slow_episodes_are_not_displaced_by_quick_ones(
    make_environment: Make, monkeypatch: pytest.MonkeyPatch, source: Source
) -> None:
    from highlevel.task import Decision, Outcome

    for robots in (1, 3):
        environment = make_environment(robots)

        def judge(measured: Measurement, decision: Decision, environment: CommandEnvironment = environment) -> Outcome:
            # Episode 0 takes six decisions, episode 3 fails, and the others take two.
            number, over = environment.episode, environment.decisions >= 2
            over = over & ((number > 0) | (environment.decisions >= 6))
            return Outcome(torch.ones(environment.num_envs), over & (number != 3), over & (number == 3))

        monkeypatch.setattr(environment.task, "step", judge)
        recorded = record(environment, _Standing(environment), 4, seed=0, noise=0.0, source=source)
        numbers, lengths = np.unique(recorded.episode, return_counts=True)
        assert numbers.tolist() == [0, 1, 2, 4] and lengths.tolist() == [6, 2, 2, 2]
        assert recorded.attempts == 5
        stops = iter([False] * 4 + [True] * 100)
        recorded = record(
            environment,
            _Standing(environment),
            4,
            seed=0,
            noise=0.0,
            source=source,
            should_stop=lambda s=stops: next(s),
        )
        assert recorded.count == recorded.attempts == 0, "the quick ones are not kept without the slow one"


def test_episode_records_do_not_depend_on_the_number_of_robots(
    make_environment: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    from highlevel.episodes import run_episodes, success_rate

    seen: dict[int, list[tuple[int, float]]] = {}
    for robots in (1, 3):
        environment = make_environment(robots)
        _short_wins(environment, monkeypatch, 2)
        distances: list[tuple[int, float]] = []

        def observe(observation: Tensor, action: Tensor, result: StepResult, into: list = distances) -> None:
            into += [
                (int(n), float(o[0])) for n, o, d in zip(result.episode, observation, result.done, strict=True) if d
            ]

        records = run_episodes(environment, _Standing(environment), 5, seed=9, observers=[observe])
        assert [record.number for record in records] == [0, 1, 2, 3, 4]
        assert success_rate(records) == 1.0 and all(record.failure is None for record in records)
        assert records[0].duration == pytest.approx(0.2) and records[0].total_reward == pytest.approx(6.0)
        drawn, _ = draw(LiftBoxConfig(), 9, torch.arange(5))
        np.testing.assert_allclose([r.conditions["mass [kg]"] for r in records], drawn.mass, rtol=1e-6)
        seen[robots] = sorted(item for item in distances if item[0] < 5)
    assert [n for n, _ in seen[1]] == [n for n, _ in seen[3]]
    np.testing.assert_allclose([d for _, d in seen[1]], [d for _, d in seen[3]], atol=1e-4)
