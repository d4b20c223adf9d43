"""Stages follow one another by what was measured, and a gait prior is absorbed on the way."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lowlevel.commands import KINDS
from lowlevel.curriculum import CurriculumConfig
from lowlevel.environment import EnvironmentConfig, PilotEnvironment
from lowlevel.gait_prior import GaitPrior, GaitPriorConfig
from lowlevel.imitation.cloning import CloningConfig, PriorTeacher, clone
from lowlevel.learning.ppo import PPOConfig
from lowlevel.networks.config import NetworkConfig
from lowlevel.presets import PRESETS
from lowlevel.rewards import RewardWeights
from lowlevel.stages import Stage
from lowlevel.trainer import Trainer, TrainingConfig
from lowlevel.world.randomization import RandomizationConfig

QUICK = CloningConfig(rounds=2, steps=4, mixed_rounds=1, gradient_steps=2, minibatch=16)
FIRST = Stage(name="first", waits_for="reward/alive", above=0.1, least_steps=0, std=(0.2, 0.3), prior=GaitPriorConfig())
SECOND = Stage(name="second", std=(0.05, 0.1), rollout_doublings=1, arms_act=True, mixture=(("walk", 1.0),))


def tiny(*stages: Stage) -> TrainingConfig:
    return TrainingConfig(
        environment=EnvironmentConfig(num_robots=8, num_threads=1),
        network=NetworkConfig(vision=False, history_hidden=(16,), expert_hidden=(16, 8), critic_hidden=(16,)),
        ppo=PPOConfig(steps_per_update=8, minibatches=2),
        cloning=QUICK,
        stages=tuple(replace(stage, rewards=RewardWeights(alive=1.0)) for stage in stages),
    )


def test_the_next_stage_begins_when_its_figure_is_reached(tmp_path: Path) -> None:
    trainer = Trainer(replace(tiny(FIRST, SECOND), total_steps=64 * 4), tmp_path)
    assert trainer.environment.prior is not None
    trainer.train()
    assert trainer.stage.name == "second"
    environment = trainer.environment
    assert environment.prior is None and environment.task.arms_act
    assert set(environment.buffers.kind.tolist()) == {list(KINDS).index("walk")}
    assert trainer.ppo.storage.steps == 16
    assert float(trainer.ppo.actor.log_std.exp().max()) <= 0.1 + 1e-6


def test_only_kinds_that_a_stage_brings_in_open_anew(tmp_path: Path) -> None:
    first = replace(FIRST, prior=None, mixture=(("walk", 0.5), ("squat", 0.5)))
    trainer = Trainer(tiny(first, replace(SECOND, mixture=(("walk", 0.5), ("slow", 0.5)))), tmp_path)
    trainer.curriculum.opening[:] = 0.9
    trainer.observation = trainer.environment.reset()
    assert trainer._stage_is_over({"reward/alive": 100.0})
    trainer._enter_next_stage(print)
    opening = dict(zip(KINDS, trainer.environment.opening.tolist(), strict=True))
    assert opening["walk"] == opening["squat"] == pytest.approx(0.9) and opening["slow"] == pytest.approx(0.3)


def test_a_stage_that_never_gets_there_ends_by_its_steps(tmp_path: Path) -> None:
    hopeless = replace(FIRST, above=2.0, most_steps=128)
    trainer = Trainer(replace(tiny(hopeless, SECOND), total_steps=64 * 2), tmp_path)
    trainer.train()
    assert trainer.stage.name == "second"
    trainer = Trainer(replace(tiny(replace(hopeless, most_steps=129), SECOND), total_steps=64 * 2), tmp_path)
    trainer.train()
    assert trainer.stage.name == "first"


def test_a_resumed_run_goes_on_in_its_stage(tmp_path: Path) -> None:
    config = replace(tiny(FIRST, SECOND), total_steps=64 * 4)
    trainer = Trainer(config, tmp_path)
    trainer.train()
    resumed = Trainer(config, tmp_path)
    resumed.load()
    assert resumed.stage.name == "second" and resumed.stage_begin == trainer.stage_begin > 0
    assert resumed.ppo.storage.steps == 16
    first, second = trainer.iterate(), resumed.iterate()
    assert {k: v for k, v in first.items() if "speed" not in k} == {k: v for k, v in second.items() if "speed" not in k}


def test_absorption_teaches_the_policy_what_the_prior_did(tmp_path: Path) -> None:
    """Walking on the spot by the prior alone: after absorption the policy does the same without it."""
    walking = Stage(
        prior=GaitPriorConfig(), mixture=(("walk", 1.0),), randomization=RandomizationConfig.for_evaluation()
    )
    config = replace(tiny(walking), environment=EnvironmentConfig(num_robots=32, num_threads=1))
    trainer = Trainer(config, tmp_path)
    alone = PilotEnvironment(trainer.environment.config, replace(trainer.environment.task, prior=None), seed=1)
    prior = GaitPrior(GaitPriorConfig())
    progress: list[float] = []
    settings = CloningConfig(rounds=12, mixed_rounds=6, minibatch=256, learning_rate=3e-3)
    observation = clone(
        trainer.ppo,
        alone,
        PriorTeacher(trainer.ppo, alone, prior),
        settings,
        lambda text: progress.append(float(text.split(": ")[1].split(" nat")[0])),
    )
    assert progress[-1] < 0.3 * progress[0]
    state = alone.buffers
    wanted = prior(state.reference, state.capture_point, state.mean_velocity_error) / alone.action_scale
    action = trainer.ppo.deterministic(observation)
    assert torch.isfinite(action).all()
    assert (action - wanted)[:, :15].square().mean() < 0.5 * wanted[:, :15].square().mean()


@pytest.mark.parametrize("name", PRESETS)
def test_stages_of_presets_wait_for_figures_that_are_logged(name: str, tmp_path: Path) -> None:
    config = PRESETS[name]
    for stage in config.stages:
        small = replace(
            config,
            stages=(stage,),
            environment=replace(config.environment, num_robots=4, num_threads=1),
            ppo=replace(config.ppo, steps_per_update=4, minibatches=1),
        )
        trainer = Trainer(small, tmp_path)
        trainer.observation = trainer.environment.reset()
        figures = trainer.iterate()
        assert not stage.waits_for or math.isfinite(figures[stage.waits_for])


def test_a_stage_makes_its_conditions_harder(tmp_path: Path) -> None:
    easy = RandomizationConfig.for_evaluation()
    trainer = Trainer(
        tiny(replace(SECOND, randomization=easy, harder=RandomizationConfig(push_velocity=2.0))), tmp_path
    )
    assert trainer.environment.randomizer.config == easy
    trainer.observation = trainer.environment.reset()
    trainer.curriculum.kinds.fall_rate.zero_()
    hardness = trainer.iterate()["curriculum/hardness"]
    assert hardness == pytest.approx(CurriculumConfig().growth)
    assert trainer.environment.randomizer.config.push_velocity == pytest.approx(2.0 * hardness)
    trainer.save()
    resumed = Trainer(trainer.config, tmp_path)
    resumed.load()
    assert resumed.environment.randomizer.config == trainer.environment.randomizer.config


def test_conditions_begin_easily_with_every_stage_that_hardens_them(tmp_path: Path) -> None:
    easy = RandomizationConfig.for_evaluation()
    hardening = replace(SECOND, randomization=easy, harder=RandomizationConfig())
    trainer = Trainer(replace(tiny(replace(FIRST, most_steps=64), hardening), total_steps=64), tmp_path)
    trainer.curriculum.hardness = torch.tensor(0.7)
    trainer.train()
    assert trainer.stage.name == "second"
    assert float(trainer.curriculum.hardness) == 0.0 and trainer.environment.randomizer.config == easy
