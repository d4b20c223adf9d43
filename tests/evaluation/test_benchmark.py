from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from evaluation.benchmark import main
from evaluation.speed.measurements import measure_environment, measure_latency, window_rates
from evaluation.speed.plain_env import PlainMujocoEnv
from lowlevel.environment import EnvironmentConfig, PilotEnvironment
from lowlevel.task import TaskConfig


def test_rates_count_work_per_second() -> None:
    def step() -> int:
        time.sleep(0.01)
        return 5

    rates = window_rates(step, seconds=0.25, windows=5)
    assert len(rates) == 5
    assert 300.0 < np.mean(rates) < 500.0


@pytest.mark.parametrize("resets", [False, True])
def test_the_shares_of_an_environment_step_add_up(resets: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evaluation.speed.measurements.WINDOWS", 1)
    standing = EnvironmentConfig(
        num_robots=8,
        num_threads=1,
        start_moving=0.0,
        episode_length=0.04 if resets else 10.0,
    )
    environment = PilotEnvironment(standing, TaskConfig(mixture=(("stand", 1.0),)))  # nobody falls so soon
    environment.reset()
    figures = measure_environment(environment, seconds=0.02)
    values = {name: figure.value for name, figure in figures.items()}
    rate, physics, share = (
        values[name]
        for name in ("environment_steps_per_second", "physics_steps_per_second", "environment_python_share")
    )
    assert rate is not None and physics is not None and share is not None
    assert 0.0 < rate < physics
    if resets:  # which count as neither physics nor Python
        assert share < 1.0 - rate / physics
    else:
        assert share == pytest.approx(1.0 - rate / physics)


def test_latency_of_all_runtimes(untrained_controller: Path) -> None:
    figures = measure_latency(untrained_controller, ticks=30)
    for name in ("controller_tick_torch", "controller_tick_onnx"):
        median, tail = figures[f"{name}_p50"].value, figures[f"{name}_p99"].value
        assert median is not None and tail is not None
        assert 0.0 < median <= tail < 1000.0


def test_the_baseline_is_a_sound_environment_that_stands() -> None:
    environment = PlainMujocoEnv("stiff", 0.02 / 3)
    check_env(environment, skip_render_check=True)
    environment.reset(seed=0)
    for _ in range(10):
        observation, _, fallen, _, _ = environment.step(np.zeros(29, dtype=np.float32))
        assert not fallen
    assert observation[2] > 0.7


def test_command_writes_the_table(tmp_path: Path) -> None:
    output = tmp_path / "speed"
    options = "--robots 32 --planner-robots 2 --cores 1 --seconds 0.3 --ticks 20 --updates 1"
    main([*options.split(), "--output", str(output)])
    content = json.loads((output / "metrics.json").read_text())
    figures = content["figures"]
    for name in (
        "physics_steps_per_second",
        "environment_steps_per_second",
        "training_steps_per_second",
        "plain_subproc_steps_per_second",
        "planner_decisions_per_second",
        "planner_subproc_decisions_per_second",
    ):
        assert figures[name]["unit"] == "1/s" and figures[name]["value"] > 0.0
    ratio = figures["environment_over_plain_subproc"]["value"]
    parts = [figures[f"{part}_steps_per_second"]["value"] for part in ("environment", "plain_subproc")]
    assert ratio == pytest.approx(parts[0] / parts[1])
    assert content["machine"]["cores"] == 1
    assert "planner over baseline" in (output / "report.md").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--cores", "0"], "--cores must be positive"), (["--task", "fly"], "there is no task 'fly'")],
)
def test_bad_options_are_refused(options: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*options, "--output", str(tmp_path / "speed")])
    assert message in str(stop.value) and "\n" not in str(stop.value)
    assert not (tmp_path / "speed").exists()
