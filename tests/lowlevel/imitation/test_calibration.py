"""The told velocity is corrected until the robot walks as it should."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from lowlevel.commands import COMMAND_SIZE, VELOCITY, CommandSpace
from lowlevel.control.velocity_correction import VelocityCorrection
from lowlevel.environment import EnvironmentConfig
from lowlevel.gait_prior import GaitPriorConfig
from lowlevel.imitation.calibration import CalibrationConfig, fit, measure
from lowlevel.imitation.cloning import CloningConfig
from lowlevel.learning.ppo import PPOConfig
from lowlevel.networks.config import NetworkConfig
from lowlevel.rewards import RewardWeights
from lowlevel.stages import Stage
from lowlevel.trainer import Trainer, TrainingConfig
from lowlevel.world.randomization import RandomizationConfig
from robots.errors import PilotError

WALKING = Stage(name="walk", mixture=(("walk", 1.0),), rewards=RewardWeights(alive=1.0))


def small(*stages: Stage, robots: int = 8) -> TrainingConfig:
    return TrainingConfig(
        environment=EnvironmentConfig(num_robots=robots, num_threads=1, command_interval=(1.0, 1.2)),
        network=NetworkConfig(vision=False, history_hidden=(16,), expert_hidden=(16, 8), critic_hidden=(16,)),
        ppo=PPOConfig(steps_per_update=8, minibatches=2),
        cloning=CloningConfig(rounds=10, steps=4, mixed_rounds=1, gradient_steps=20, minibatch=128, learning_rate=3e-3),
        stages=tuple(replace(stage, randomization=RandomizationConfig.for_evaluation()) for stage in stages),
    )


@pytest.fixture
def space(tmp_path: Path) -> CommandSpace:
    return Trainer(small(WALKING), tmp_path).environment.command_space


def some_commands(space: CommandSpace, count: int) -> Tensor:
    lower, upper = space.bounds()
    return lower + torch.rand(count, COMMAND_SIZE, generator=torch.Generator().manual_seed(0)) * (upper - lower)


def test_the_fit_finds_what_is_wanted(space: CommandSpace) -> None:
    """A robot that walks at 0.8, 0.7 and 0.9 of what it is told."""
    command = some_commands(space, 3000)
    wanted = command[:, VELOCITY] * torch.tensor([0.25, 0.43, 0.11])
    correction = VelocityCorrection(space)
    explained = fit(correction, command, wanted, epochs=30, generator=torch.Generator().manual_seed(0))
    assert min(explained) > 0.9


class Follower:
    """Robots that walk at their own share of the command, once they have set off; the last one falls."""

    control_period = 0.02

    def __init__(self, commands: Tensor, share: Tensor) -> None:
        self.share, self.steps = share, 0
        self.buffers = SimpleNamespace(command=commands)

    def reset(self) -> dict[str, Tensor]:
        self.buffers.command, self.steps = -self.buffers.command, 0
        return {}

    def step(self, action: Tensor, capture_point: Tensor) -> SimpleNamespace:
        self.steps += 1
        sways = 0.2 * (-1.0) ** self.steps
        has_set_off = self.steps > 150
        walked = self.share[:, None] * self.buffers.command[:, VELOCITY] * has_set_off + sways
        measured = SimpleNamespace(linear_velocity=walked, yaw_rate=walked[:, 2])
        falls = torch.zeros(len(walked), dtype=torch.bool)
        falls[-1] = self.steps == 20
        return SimpleNamespace(observation={}, measured=measured, terminated=falls)


def test_the_lasting_error_of_each_command_is_measured(space: CommandSpace) -> None:
    command = some_commands(space, 20)
    command[0, VELOCITY] = 0.0
    share = torch.linspace(0.7, 1.2, 20)
    output = SimpleNamespace(mean=torch.zeros(20, 29), motion=torch.zeros(20, 5))
    ppo = SimpleNamespace(device=torch.device("cpu"), learner=SimpleNamespace(policy=lambda seen: output))
    follower = Follower(command, share)
    told, errors = measure(ppo, follower, CalibrationConfig(duration=4.5, averaged=1.48), rounds=2)  # type: ignore[arg-type]
    # Neither the robot that stands nor the one that falls; the others, each twice.
    assert torch.equal(told, torch.cat([-command[1:-1], command[1:-1]]))
    assert torch.allclose(errors, (share[1:-1, None].repeat(2, 1) - 1.0) * told[:, VELOCITY], atol=1e-5)


def begun(tmp_path: Path, first: Stage, calibration: CalibrationConfig) -> tuple[Trainer, list[str]]:
    """A trainer that has just begun a stage with calibration after ``first``, and what it reported."""
    calibrated = replace(WALKING, name="calibrated", calibrates=True)
    tmp_path.mkdir(exist_ok=True)
    first = replace(first, waits_for="reward/alive", above=0.1, least_steps=0)
    trainer = Trainer(replace(small(first, calibrated, robots=32), calibration=calibration), tmp_path)
    trainer.observation = trainer.environment.reset()
    lines: list[str] = []
    assert trainer._stage_is_over({"reward/alive": 10.0})
    trainer._enter_next_stage(lines.append)
    assert trainer.stage.name == "calibrated" and trainer.observation
    return trainer, lines


def parts(lines: list[str]) -> list[str]:
    """The first words of ``lines``, those of successive ones that begin alike once."""
    return [word for word, _ in groupby(line.split()[0] for line in lines)]


def test_a_stage_begins_with_a_calibration(tmp_path: Path) -> None:
    quick = CalibrationConfig(commands=160, duration=0.2, averaged=0.1, epochs=2)
    _, lines = begun(tmp_path / "plain", WALKING, quick)
    assert parts(lines) == ["calibrating", "calibrated", "cloning:"]
    trainer, lines = begun(tmp_path / "prior", replace(WALKING, prior=GaitPriorConfig()), quick)
    assert parts(lines) == ["absorbing", "cloning:", "calibrating", "calibrated", "cloning:"]
    resumed = Trainer(trainer.config, tmp_path / "prior")
    resumed.load()
    assert resumed.stage.name == "calibrated"
    for name, values in trainer.environment.correction.state_dict().items():
        assert torch.equal(resumed.environment.correction.state_dict()[name], values)
    for name, values in trainer.ppo.actor.state_dict().items():
        assert torch.equal(resumed.ppo.actor.state_dict()[name], values)


def test_a_run_ends_with_a_correction_of_what_came_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = CalibrationConfig(commands=160, duration=0.2, averaged=0.1, epochs=2)
    lines: list[str] = []
    monkeypatch.setattr("lowlevel.runs.progress.ProgressReport.say", lambda self, line: lines.append(line))
    for calibrates, expected in ((False, []), (True, ["calibrating", "calibrated"])):
        config = replace(small(replace(WALKING, calibrates=calibrates), robots=32), calibration=quick, total_steps=1)
        trainer = Trainer(config, tmp_path / str(calibrates))
        trainer.train()
        assert trainer.steps > 1 and parts(lines) == expected
        resumed = Trainer(config, tmp_path / str(calibrates))
        resumed.load()
        resumed.train()  # has nothing left to do
        assert parts(lines) == expected


def test_without_enough_commands_there_is_no_calibration(tmp_path: Path) -> None:
    _, lines = begun(tmp_path, WALKING, CalibrationConfig(commands=32, duration=0.2, averaged=0.1))
    assert [line.split()[:2] for line in lines] == [["calibrating", "the"], ["no", "calibration:"]]


def test_what_the_fit_knows_nothing_about_is_left_alone(space: CommandSpace) -> None:
    command = some_commands(space, 600)
    noise = torch.randn(600, generator=torch.Generator().manual_seed(1))
    wanted = torch.stack([0.25 * command[:, 0], 0.3 * noise, 0.11 * command[:, 2]], dim=1)
    correction = VelocityCorrection(space)
    explained = fit(correction, command, wanted, epochs=30, generator=torch.Generator().manual_seed(0))
    assert explained[1] < 0.0 < min(explained[0], explained[2])
    assert correction.known.tolist() == [1.0, 0.0, 1.0]
    assert not correction(command)[:, 1].any() and correction(command)[:, 0].any()


@pytest.mark.parametrize(
    ("setting", "message"),
    [({"commands": 0}, "at least one"), ({"duration": 1.0}, "not 1.5 s"), ({"averaged": 0.0}, "not 0.0")],
)
def test_a_calibration_that_measures_nothing_is_refused(setting: dict[str, Any], message: str) -> None:
    with pytest.raises(PilotError, match=message):
        CalibrationConfig(**setting)
