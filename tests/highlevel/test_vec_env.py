"""The two public faces of the environment keep their contracts."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import stable_baselines3.common.env_checker
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import highlevel  # noqa: F401 (registers the tasks)
from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.gym_env import PlannerEnv
from highlevel.vec_env import PlannerVecEnv

Make = Callable[..., CommandEnvironment]


def test_the_gymnasium_environment_passes_both_checkers(
    untrained_controller: Path, coarse_physics: PhysicsConfig
) -> None:
    environment = gymnasium.make("pilot/LiftBox-v0", controller=untrained_controller, physics=coarse_physics).unwrapped
    assert isinstance(environment, PlannerEnv)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # An environment of physical quantities has no bounds, and this one is checked without its spec.
        warnings.filterwarnings("ignore", message=".*(infinity|alternative render modes|spec).*")
        check_env(environment)
        stable_baselines3.common.env_checker.check_env(environment)


def test_stable_baselines_makes_it_like_any_other(untrained_controller: Path, coarse_physics: PhysicsConfig) -> None:
    arguments = {"controller": untrained_controller, "physics": coarse_physics}
    vec_env = make_vec_env("pilot/LiftBox-v0", n_envs=2, seed=0, env_kwargs=arguments)
    vec_env.reset()
    _, _, _, infos = vec_env.step(np.zeros((2, 21), np.float32))
    assert [info["is_success"] for info in infos] == [False, False]


def test_it_draws_pictures(untrained_controller: Path, coarse_physics: PhysicsConfig, has_opengl: bool) -> None:
    with pytest.raises(TypeError, match="no render mode 'human'"):
        PlannerEnv("lift_box", untrained_controller, coarse_physics, render_mode="human")
    assert PlannerEnv("lift_box", untrained_controller, coarse_physics).render() is None
    environment = PlannerEnv("lift_box", untrained_controller, coarse_physics, render_mode="rgb_array")
    environment.reset(seed=0)
    if not has_opengl:
        pytest.skip("this machine cannot render")
    first = environment.render()
    assert first is not None and first.shape == (480, 640, 3) and first.std() > 10.0
    for _ in range(5):
        environment.step(np.ones(21, np.float32))
    second = environment.render()
    assert second is not None and (first != second).any()
    environment.close()


def test_double_precision_around_it_changes_nothing(untrained_controller: Path, coarse_physics: PhysicsConfig) -> None:
    def rewards() -> list[float]:
        environment = PlannerEnv("lift_box", untrained_controller, coarse_physics)
        environment.reset(seed=0)
        return [environment.step(np.full(21, 0.3))[1] for _ in range(3)]

    usual = rewards()
    torch.set_default_dtype(torch.float64)
    try:
        assert rewards() == usual
    finally:
        torch.set_default_dtype(torch.float32)


def test_what_it_cannot_use_is_refused_in_one_sentence(
    untrained_controller: Path, coarse_physics: PhysicsConfig
) -> None:
    environment = PlannerEnv("lift_box", untrained_controller, coarse_physics)
    for seed in (-1, 2**63, 2**70):
        with pytest.raises(ValueError, match=r"it must be between 0 and 2\^63 - 1"):
            environment.reset(seed=seed)
    with pytest.raises(ValueError, match="no option 'mass' to reset with"):
        environment.reset(seed=0, options={"mass": 3.0})
    environment.reset(seed=2**63 - 1)
    with pytest.raises(ValueError, match=r"the action has the shape \(1, 21\), but it must be \(21,\)"):
        environment.step(np.zeros((1, 21), np.float32))
    with pytest.raises(ValueError, match="must be finite"):
        environment.step(np.full(21, np.nan, np.float32))


def test_stepping_a_finished_gymnasium_episode_is_refused(
    untrained_controller: Path, coarse_physics: PhysicsConfig
) -> None:
    environment = PlannerEnv("lift_box", untrained_controller, coarse_physics)
    with pytest.raises(RuntimeError, match="call reset"):
        environment.step(np.zeros(21, np.float32))


def test_workers_that_nobody_seeds_run_different_episodes(
    untrained_controller: Path, coarse_physics: PhysicsConfig
) -> None:
    environments = [PlannerEnv("lift_box", untrained_controller, coarse_physics) for _ in range(2)]
    starts = [environment.reset()[0] for environment in environments]
    assert not np.array_equal(*starts)
    numbers = [environments[0].reset()[1]["episode_number"] for _ in range(2)]
    assert numbers == [1, 2], "without a seed the next episode follows"
    seeded = [environment.reset(seed=3)[0] for environment in environments]
    np.testing.assert_array_equal(*seeded)


def test_the_vec_env_keeps_stable_baselines_contract(make_environment: Make) -> None:
    environment = make_environment(3)
    vec_env = PlannerVecEnv(environment)
    vec_env.seed(4)
    observation = vec_env.reset()
    assert observation.shape == (3, environment.observation_size) and observation.dtype == np.float32
    environment.decisions[1] = environment.max_decisions - 1
    action = environment.action_map.action(environment.command).numpy()
    following, reward, done, infos = vec_env.step(action)
    assert following.dtype == np.float32 and reward.dtype == np.float32 and done.dtype == bool
    assert done.tolist() == [False, True, False]
    assert infos[0] == {} and infos[2] == {}
    info = infos[1]
    assert info["TimeLimit.truncated"] is False and info["is_success"] is False
    assert info["failure"] == "approach_timeout" and info["stage"] == 0
    assert info["episode"]["l"] == 1 and info["episode"]["r"] == pytest.approx(float(reward[1]))
    # The terminal observation belongs to the old episode, the returned one to the new.
    assert not np.array_equal(info["terminal_observation"], following[1])
    time_left = observation.shape[1] - 2
    assert following[1, time_left] == pytest.approx(1.0)
    assert info["terminal_observation"][time_left] == pytest.approx(0.0)

    _, _, _, infos = vec_env.step(action)
    assert infos == [{}, {}, {}]


def test_a_fall_ends_the_episode(make_environment: Make) -> None:
    vec_env = PlannerVecEnv(make_environment(2))
    vec_env.seed(0)
    vec_env.reset()
    rng = np.random.default_rng(0)
    for _ in range(150):
        _, _, done, infos = vec_env.step(rng.uniform(-1, 1, (2, 21)).astype(np.float32))
        if done.any():
            break
    ended = [info for info in infos if info]
    assert ended and all(info["failure"] == "fall" and not info["TimeLimit.truncated"] for info in ended)


def test_seeds_repeat_episodes_and_wrappers_work(make_environment: Make) -> None:
    vec_env = PlannerVecEnv(make_environment(2))
    vec_env.seed(3)
    first = vec_env.reset()
    following = vec_env.reset()
    assert not np.array_equal(first, following)
    vec_env.seed(3)
    np.testing.assert_array_equal(vec_env.reset(), first)
    wrapped = VecNormalize(VecMonitor(vec_env))
    wrapped.reset()
    observation, _, _, _ = wrapped.step(np.zeros((2, 21), np.float32))
    assert np.isfinite(observation).all()
    assert vec_env.get_attr("num_envs") == [2, 2]
    assert vec_env.env_is_wrapped(VecMonitor) == [False, False]
    assert vec_env.env_method("observe", indices=0)[0].shape[0] == 2
    with pytest.raises(ValueError, match="without indices"):
        vec_env.set_attr("seed", 1, indices=0)
