"""The told velocity is corrected until the robot walks as it should."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from lowlevel.absorption import AbsorptionConfig
from lowlevel.calibration import CalibrationConfig, Correction, ToldTeacher, fit, measure
from lowlevel.commands import COMMAND_SIZE, MIRROR, VELOCITY, CommandSpace
from lowlevel.control.observation import FRAME, FRAME_SIZE, HISTORY_LENGTH, columns
from lowlevel.environment import EnvironmentConfig
from lowlevel.learning.ppo import PPOConfig
from lowlevel.networks.config import NetworkConfig
from lowlevel.rewards import RewardWeights
from lowlevel.stages import Stage
from lowlevel.trainer import Trainer, TrainingConfig
from lowlevel.world.randomization import RandomizationConfig

WALKING = Stage("walk", mixture=(("walk", 1.0),), rewards=RewardWeights(alive=1.0))


def small(*stages: Stage, robots: int = 8) -> TrainingConfig:
    return TrainingConfig(
        environment=EnvironmentConfig(num_robots=robots, num_threads=1, command_interval=(1.0, 1.2)),
        network=NetworkConfig(vision=False, history_hidden=(16,), expert_hidden=(16, 8), critic_hidden=(16,)),
        ppo=PPOConfig(steps_per_update=8, minibatches=2),
        absorption=AbsorptionConfig(rounds=1, steps=2, mixed_rounds=1, gradient_steps=1, minibatch=16),
        stages=tuple(replace(stage, randomization=RandomizationConfig.for_evaluation()) for stage in stages),
    )


@pytest.fixture
def space(tmp_path: Path) -> CommandSpace:
    return Trainer(small(WALKING), tmp_path).environment.command_space


def some_commands(space: CommandSpace, count: int) -> Tensor:
    lower, upper = space.bounds()
    return lower + torch.rand(count, COMMAND_SIZE, generator=torch.Generator().manual_seed(0)) * (upper - lower)


def test_a_mirrored_command_has_the_mirrored_correction_and_standing_has_none(space: CommandSpace) -> None:
    correction = Correction(space, limit=0.5)
    for values in correction.parameters():
        torch.nn.init.normal_(values, std=0.3)
    command = some_commands(space, 50)
    index, sign = torch.as_tensor(MIRROR.index), torch.as_tensor(MIRROR.sign, dtype=command.dtype)
    found = correction(command)
    assert found.abs().max() > 0.1
    assert torch.allclose(correction(command[:, index] * sign), found * sign[VELOCITY], atol=1e-6)
    command[:, VELOCITY] = 0.02
    assert not correction(command).any()


def test_the_fit_finds_what_is_wanted(space: CommandSpace) -> None:
    """A robot that walks at 0.8, 0.7 and 0.9 of what it is told."""
    command = some_commands(space, 3000)
    wanted = command[:, VELOCITY] * torch.tensor([0.25, 0.43, 0.11])
    correction = Correction(space, limit=0.5)
    explained = fit(correction, command, wanted, epochs=30, generator=torch.Generator().manual_seed(0))
    assert min(explained) > 0.9


class Follower:
    """Robots that walk at a share of what they are told, at once, and do as their action says."""

    control_period = 0.02

    def __init__(self, commands: Tensor, share: float, until: int) -> None:
        self.num_robots, self.share, self.until, self.steps = len(commands), share, until, 0
        self.buffers = SimpleNamespace(command=commands, reference=SimpleNamespace(command=commands))

    def reset(self, spread_episodes: bool) -> dict[str, Tensor]:
        return {"command": self.buffers.command}

    def step(self, action: Tensor) -> SimpleNamespace:
        self.steps += 1
        walked = self.share * action
        robot = SimpleNamespace(linear_velocity=walked, yaw_rate=walked[:, 2])
        never = torch.zeros(self.num_robots, dtype=torch.bool)
        over = never | (self.steps == self.until)
        observation = {"command": self.buffers.command}
        return SimpleNamespace(observation=observation, measured=robot, terminated=never, truncated=over)


def test_the_integrator_finds_what_a_robot_must_be_told(space: CommandSpace) -> None:
    command = some_commands(space, 20)
    command[:, VELOCITY] *= 0.5
    command[0, VELOCITY] = 0.0
    teacher = SimpleNamespace(label=lambda observation, further: observation["command"][:, VELOCITY] + further)
    config = CalibrationConfig(steps=400)
    told, added = measure(teacher, Follower(command, 0.8, until=400), torch.device("cpu"), config)  # type: ignore[arg-type]
    assert torch.equal(told, command[1:])
    assert torch.allclose(added, 0.25 * told[:, VELOCITY], atol=0.01)


def test_the_teacher_sees_the_corrected_velocity_in_every_frame(tmp_path: Path) -> None:
    trainer = Trainer(small(WALKING), tmp_path)
    observation = trainer.environment.reset()
    space = trainer.environment.command_space
    correction = Correction(space, limit=0.5)
    with torch.no_grad():
        list(correction.parameters())[-1][:] = torch.tensor([0.1, 0.0, 0.0])
    lower, upper = space.bounds()
    history = observation["history"].view(-1, HISTORY_LENGTH + 1, FRAME_SIZE).clone()
    buffers = trainer.environment.buffers
    for block, command in (("command", buffers.command), ("slewed_command", buffers.reference.command)):
        walks = command[:, VELOCITY].norm(dim=1) >= 0.1
        assert walks.any() and not walks.all()
        moved = 0.05 + 0.1 * walks
        history[:, :, columns(FRAME, block).start] += (moved * 2.0 / (upper[0] - lower[0]))[:, None]
    wanted = trainer.ppo.deterministic(observation | {"history": history.flatten(1)})
    further = torch.tensor([[0.05, 0.0, 0.0]]).expand(8, 3)
    label = ToldTeacher(trainer.ppo, space, correction).label(observation, further)
    assert torch.allclose(label, wanted, atol=1e-5)


def test_a_stage_begins_with_a_calibration(tmp_path: Path) -> None:
    first = replace(WALKING, waits_for="reward/alive", above=0.1, least_steps=0)
    calibrated = replace(WALKING, name="calibrated", calibrates=True)
    config = replace(
        small(first, calibrated, robots=32),
        calibration=CalibrationConfig(steps=250, settling=0.1, epochs=2),
        total_steps=32 * 8 * 2,
    )
    trainer = Trainer(config, tmp_path)
    lines: list[str] = []
    trainer.observation = trainer.environment.reset()
    before = {name: value.clone() for name, value in trainer.ppo.actor.state_dict().items()}
    trainer.waited_for = 1.0
    trainer._follow_stages({"reward/alive": 10.0}, lines.append)
    assert trainer.stage.name == "calibrated"
    assert [line.split()[0] for line in lines] == ["calibrating", "calibrated", "cloning:"]
    after = trainer.ppo.actor.state_dict()
    assert any(not torch.equal(before[name], after[name]) for name in before)
