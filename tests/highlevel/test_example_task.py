"""What docs/add-a-task.md promises: a folder is enough for every command and for Gymnasium."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env

import tasks
from evaluation import highlevel as evaluation
from highlevel import train
from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.planner import Planner
from highlevel.registry import environment_id, load_task, register_tasks, task_modules
from highlevel.trainer import BEST_FOLDER


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The example lies beside the shipped tasks."""
    monkeypatch.setattr(tasks, "__path__", [*tasks.__path__, str(Path(__file__).parent / "example_tasks")])
    register_tasks()
    yield
    gymnasium.registry.pop(environment_id("squat"))
    sys.modules.pop("tasks.squat")


def test_the_folder_is_found_and_registered(untrained_controller: Path, coarse_physics: PhysicsConfig) -> None:
    assert {"lift_box", "squat"} <= task_modules().keys()
    environment = gymnasium.make("pilot/Squat-v0", controller=untrained_controller, physics=coarse_physics)
    check_env(environment.unwrapped, skip_render_check=True)


def test_its_expert_succeeds_and_can_be_evaluated(untrained_controller: Path, tmp_path: Path) -> None:
    arguments = ["--task=squat", "--planner=scripted", f"--controller={untrained_controller}", "--episodes=4"]
    evaluation.main([*arguments, "--robots=4", "--threads=1", f"--output={tmp_path}"])
    figures = json.loads((tmp_path / "metrics.json").read_text())["figures"]
    assert figures["full"]["value"] == 1.0 and "lift_up" not in figures
    episodes = json.loads((tmp_path / "episodes.json").read_text())
    # Its one stage is success, and success ends the episode.
    assert all(episode["stage_times"] == [pytest.approx(episode["duration"])] for episode in episodes)


def test_a_planner_imitates_its_expert(
    untrained_controller: Path, tmp_path: Path, coarse_physics: PhysicsConfig
) -> None:
    arguments = ["--task=squat", f"--controller={untrained_controller}", f"--output={tmp_path}", "--name=run"]
    arguments += ["--demonstrations=12", "--num-envs=4", "--num-threads=1", "--network.hidden", "32"]
    arguments += ["--ppo.decisions-per-update=16", "--ppo.batch-size=64", "--ppo.warm-up-updates=1"]
    arguments += ["--selection-episodes=4", "--total-decisions=64", "--cloning.epochs=60"]
    train.main(arguments)
    planner = Planner.load(tmp_path / "run" / BEST_FOLDER, untrained_controller)
    assert planner.provenance["selection"]["success_rate"] == 1.0
    environment = CommandEnvironment(load_task("squat"), untrained_controller, 2, 0, coarse_physics)
    assert environment.observation_size == planner.actor.mean.numel()
