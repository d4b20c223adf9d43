"""Planner folders: round trip, and one sentence for everything that can be wrong with one."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from stable_baselines3 import PPO

from highlevel.action import ActionConfig
from highlevel.environment import CommandEnvironment
from highlevel.learning.policy import PlannerActor, PlannerNetwork, policy_arguments
from highlevel.planner import PLANNER_FILE, WEIGHTS_FILE, Planner, PlannerConfig, PlannerError, planner_hash
from highlevel.registry import DEFAULT_CONTROLLER, find_controller, load_task
from highlevel.vec_env import PlannerVecEnv
from lowlevel.control.controller import content_hash
from robots.errors import PilotError

Make = Callable[..., CommandEnvironment]


@pytest.fixture
def planner(make_environment: Make, untrained_controller: Path) -> Planner:
    environment = make_environment()
    torch.manual_seed(0)
    actor = PlannerActor(environment.observation_size, 21, (16, 8))
    config = PlannerConfig(
        task="lift_box",
        task_config=environment.task.describe(),
        controller=content_hash(untrained_controller),
        observation=environment.blocks,
        action=ActionConfig(),
        hidden=(16, 8),
    )
    return Planner(config, actor, {"decisions": 0})


def test_a_saved_planner_loads_and_acts_the_same(planner: Planner, tmp_path: Path, make_environment: Make) -> None:
    planner.save(tmp_path)
    loaded = Planner.load(tmp_path)
    assert loaded.config == planner.config
    loaded.require_environment(make_environment())
    observation = torch.randn(5, len(planner.actor.mean), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(loaded.act(observation), planner.act(observation), rtol=0, atol=0)
    torch.testing.assert_close(loaded.act(observation), loaded.act(observation), rtol=0, atol=0)
    assert loaded.act(1e4 * observation).abs().max() <= 1.0


def test_the_exported_actor_equals_stable_baselines_deterministic_prediction(make_environment: Make) -> None:
    environment = make_environment()
    network = PlannerNetwork(hidden=(16, 8))
    scale = torch.linspace(0.5, 2.0, environment.observation_size)
    model = PPO("MlpPolicy", PlannerVecEnv(environment), policy_kwargs=policy_arguments(network, scale), device="cpu")
    with torch.no_grad():
        model.policy.action_net.weight.mul_(40.0)
    observation = np.random.default_rng(0).normal(size=(6, environment.observation_size)).astype(np.float32)
    expected, _ = model.predict(observation, deterministic=True)
    actor = PlannerActor.from_policy(model.policy, network.hidden)
    with torch.no_grad():
        found = actor(torch.from_numpy(observation)).clamp(-1.0, 1.0).numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.abs(expected).max() > 0.05


@pytest.mark.parametrize("name", [PLANNER_FILE, WEIGHTS_FILE])
def test_a_missing_or_truncated_file_is_named(planner: Planner, tmp_path: Path, name: str) -> None:
    planner.save(tmp_path)
    path = tmp_path / name
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(PlannerError, match=f"{name} is damaged"):
        Planner.load(tmp_path)
    path.unlink()
    with pytest.raises(PlannerError, match=f"{name} is missing"):
        Planner.load(tmp_path)


def test_another_version_is_refused(planner: Planner, tmp_path: Path) -> None:
    planner.save(tmp_path)
    path = tmp_path / PLANNER_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format_version": 99}))
    with pytest.raises(PlannerError, match="format version 99"):
        Planner.load(tmp_path)


def test_weights_that_are_not_finite_are_neither_loaded_nor_saved(planner: Planner, tmp_path: Path) -> None:
    planner.save(tmp_path)
    tensors = load_file(tmp_path / WEIGHTS_FILE)
    tensors["output.bias"][3] = float("nan")
    save_file(tensors, tmp_path / WEIGHTS_FILE)
    with pytest.raises(PlannerError, match=r"output\.bias.*not finite"):
        Planner.load(tmp_path)
    planner.actor.output.bias[0] = float("inf")
    with pytest.raises(PlannerError, match=r"output\.bias.*not finite.*nothing was written"):
        planner.save(tmp_path / "other")
    assert not (tmp_path / "other" / WEIGHTS_FILE).exists()


def test_another_controller_is_refused(planner: Planner, tmp_path: Path, untrained_controller: Path) -> None:
    planner.save(tmp_path / "right")
    Planner.load(tmp_path / "right", untrained_controller)
    Planner(replace(planner.config, controller="0" * 16), planner.actor, {}).save(tmp_path / "wrong")
    with pytest.raises(PlannerError, match="trained on controller 0000"):
        Planner.load(tmp_path / "wrong", untrained_controller)
    assert planner_hash(tmp_path / "right") != planner_hash(tmp_path / "wrong")


def test_another_action_range_is_refused(planner: Planner, make_environment: Make) -> None:
    other = Planner(replace(planner.config, action=ActionConfig(yaw=0.5)), planner.actor, {})
    with pytest.raises(PlannerError, match="another observation or action"):
        other.require_environment(make_environment())


def test_the_shipped_planner_finds_its_controller_and_fits_its_task() -> None:
    planner = Planner.load(Path(__file__).resolve().parents[2] / "checkpoints" / "highlevel" / "lift-box")
    controller = find_controller(identity=planner.config.controller)
    planner.require_controller(controller)
    planner.require_environment(CommandEnvironment(load_task(planner.config.task), controller, 1))


def test_controllers_are_found_by_folder_name_and_identity(tmp_path: Path) -> None:
    assert find_controller(tmp_path) == tmp_path
    assert find_controller().name == DEFAULT_CONTROLLER
    with pytest.raises(PilotError, match="0123456789abcdef is not among"):
        find_controller(identity="0123456789abcdef")
