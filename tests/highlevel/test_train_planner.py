"""A tiny training run through the command line: outputs, resume, refusals."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.learning.cloning import CloningConfig
from highlevel.learning.config import PlannerTrainingConfig, PPOConfig
from highlevel.learning.demonstrations import Demonstrations, Source
from highlevel.learning.policy import PlannerNetwork
from highlevel.planner import Planner
from highlevel.train import main
from highlevel.trainer import BEST_FOLDER, DEMONSTRATION_SEED, TRAINING_SEED, PlannerTrainer
from lowlevel.runs.checks import NonFiniteError
from lowlevel.runs.run_folder import LOG_FILE, STATE_FILE, RunFolder

_TINY = [
    "--demonstrations=0",
    "--num-envs=4",
    "--num-threads=1",
    "--ppo.decisions-per-update=16",
    "--ppo.batch-size=64",
    "--ppo.epochs=1",
    "--selection-episodes=4",
    "--selection-interval=1000000",
    *("--network.hidden", "16", "16"),
]


@pytest.fixture
def quick_episodes(monkeypatch: pytest.MonkeyPatch, coarse_physics: PhysicsConfig) -> None:
    """Short episodes and coarse physics, so that a run takes seconds."""
    from highlevel import trainer
    from tasks.lift_box.task import LiftBox

    original = LiftBox.__init__

    def short(self: LiftBox, *arguments: object, **options: object) -> None:
        original(self, *arguments, **options)  # type: ignore[arg-type]
        self.episode_length = 0.5

    monkeypatch.setattr(LiftBox, "__init__", short)
    monkeypatch.setattr(trainer, "PhysicsConfig", lambda num_threads: coarse_physics)


def test_a_run_trains_and_resumes(untrained_controller: Path, tmp_path: Path, quick_episodes: None) -> None:
    start = [*_TINY, f"--controller={untrained_controller}", f"--output={tmp_path}", "--name=run"]
    main([*start, "--total-decisions=128"])
    folder = tmp_path / "run"
    state = torch.load(folder / STATE_FILE, weights_only=True)
    assert state["decisions"] == 128 and state["phase"] == "ppo"
    planner = Planner.load(folder / BEST_FOLDER, untrained_controller)
    assert planner.config.task == "lift_box" and planner.provenance["selection"]["episodes"] == 4
    entries = [json.loads(line) for line in (folder / LOG_FILE).read_text().splitlines()]
    assert entries[-1]["decisions"] == 128 and 0.0 <= entries[-1]["selection/success_rate"] <= 1.0
    assert list((folder / "tensorboard").iterdir())

    with pytest.raises(SystemExit, match="already holds a run"):
        main([*start, "--total-decisions=128"])
    description = json.loads((folder / "run.json").read_text())
    description["config"]["total_decisions"] = 192
    (folder / "run.json").write_text(json.dumps(description))
    assert RunFolder(folder).config(PlannerTrainingConfig).total_decisions == 192
    main(["--resume", str(folder)])  # a finished run goes on, too
    resumed = torch.load(folder / STATE_FILE, weights_only=True)
    assert resumed["decisions"] == 192 and resumed["updates"] == 3
    changed = [not torch.equal(state["policy"][name], resumed["policy"][name]) for name in state["policy"]]
    assert any(changed)
    for name in ("features_extractor.mean", "features_extractor.scale"):
        torch.testing.assert_close(state["policy"][name], resumed["policy"][name])


def test_a_planner_of_another_controller_is_trained_on(
    untrained_controller: Path, tmp_path: Path, quick_episodes: None
) -> None:
    start = [*_TINY, f"--controller={untrained_controller}", f"--output={tmp_path}"]
    main([*start, "--name=first", "--total-decisions=64"])
    first = Planner.load(tmp_path / "first" / BEST_FOLDER)
    other = Path(shutil.copytree(untrained_controller, tmp_path / "controller"))
    description = json.loads((other / "controller.json").read_text())
    (other / "controller.json").write_text(json.dumps(description | {"note": "another identity"}))
    again = [
        *_TINY,
        f"--controller={other}",
        f"--output={tmp_path}",
        f"--warm-start={tmp_path / 'first' / BEST_FOLDER}",
    ]
    main([*again, "--name=second", "--total-decisions=64", "--ppo.warm-up-updates=1"])
    second = Planner.load(tmp_path / "second" / BEST_FOLDER, other)
    for before, after in zip(first.actor.parameters(), second.actor.parameters(), strict=True):
        assert torch.equal(before, after), "only the critic has learned by now"
    assert second.provenance["config"]["warm_start"] == BEST_FOLDER
    with pytest.raises(SystemExit, match=r"other widths: add --network\.hidden 16 16"):
        main([*again, "--name=third", "--network.hidden", "32"])
    assert not (tmp_path / "third").exists()


def test_a_run_resumed_while_it_records_does_not_train_on_the_demonstrations_episodes(
    untrained_controller: Path, tmp_path: Path, quick_episodes: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    config = PlannerTrainingConfig(
        controller=untrained_controller,
        demonstrations=1,
        num_envs=2,
        num_threads=1,
        network=PlannerNetwork(hidden=(16, 16)),
        cloning=CloningConfig(epochs=1),
        ppo=PPOConfig(decisions_per_update=16, batch_size=32),
    )
    folder.mkdir()
    PlannerTrainer(config, folder).save()
    trainer = PlannerTrainer(config, folder)
    trainer.load()

    def record() -> Demonstrations:
        observation = trainer.environment.reset(DEMONSTRATION_SEED).numpy()
        action, value = np.zeros((len(observation), 21), np.float32), np.zeros(len(observation), np.float32)
        return Demonstrations(trainer.source, observation, action, value, np.zeros(len(observation), np.int64), 1)

    monkeypatch.setattr(trainer, "_demonstrations", record)
    trainer._begin()
    trainer.vec_env.reset()
    assert trainer.environment.seed == TRAINING_SEED + config.seed


def test_bad_input_is_one_sentence(untrained_controller: Path, tmp_path: Path) -> None:
    where = [f"--controller={untrained_controller}", f"--output={tmp_path}", "--name=run"]
    for options, message in (
        ([*_TINY, *where, "--task=fly"], "there is no task 'fly'"),
        ([*_TINY, *where, "--ppo.batch-size=63"], "must divide a rollout"),
        ([*_TINY, f"--controller={tmp_path}", f"--output={tmp_path}"], "controller.json is missing"),
        (["--resume", str(tmp_path)], "holds no run.json"),
        ([*_TINY, *where, "--selection-episodes=0"], "selection_episodes is 0"),
        ([*_TINY, *where, "--cloning.held-out=1"], "held_out is 1.0, but it must be at least 0 and below 1"),
        ([*_TINY, *where, "--network.hidden"], "must name widths of at least 1"),
        ([*_TINY, *where, f"--demonstration-file={__file__}"], "does not hold demonstrations"),
    ):
        with pytest.raises(SystemExit, match=message):
            main(options)
    assert not (tmp_path / "run").exists()


def test_a_state_that_cannot_be_continued_is_refused(
    untrained_controller: Path, tmp_path: Path, quick_episodes: None
) -> None:
    start = [*_TINY, f"--controller={untrained_controller}", f"--output={tmp_path}", "--name=run"]
    main([*start, "--total-decisions=64", "--selection-episodes=1"])
    folder = tmp_path / "run"
    path = folder / STATE_FILE
    content, state = path.read_bytes(), torch.load(path, weights_only=True)

    def refusal() -> str:
        with pytest.raises(SystemExit) as exit_info:
            main(["--resume", str(folder)])
        assert "\n" not in str(exit_info.value)
        return str(exit_info.value)

    for length in (0, 1000):
        path.write_bytes(content[:length])
        assert "is not a readable training state" in refusal()
    torch.save(state | {"controller": "0123456789abcdef"}, path)
    assert "this run is for controller 0123456789abcdef" in refusal()
    torch.save({name: value for name, value in state.items() if name != "episode"}, path)
    assert "does not fit this run: 'episode'" in refusal()
    state["policy"]["value_net.bias"][0] = torch.nan
    torch.save(state, path)
    assert "'value_net.bias' is not finite" in refusal()
    path.unlink()
    assert "ended before its first save" in refusal()


def test_weights_that_are_not_finite_are_not_saved(
    untrained_controller: Path, tmp_path: Path, quick_episodes: None
) -> None:
    start = [*_TINY, f"--controller={untrained_controller}", f"--output={tmp_path}", "--name=run"]
    main([*start, "--total-decisions=64", "--selection-episodes=1"])
    folder = tmp_path / "run"
    before = (folder / STATE_FILE).read_bytes()
    config = RunFolder(folder).config(PlannerTrainingConfig)
    trainer = PlannerTrainer(replace(config, controller=untrained_controller), folder)
    trainer.load()
    with torch.no_grad():
        trainer.model.policy.value_net.bias[0] = torch.inf
    with pytest.raises(NonFiniteError, match=r"value_net.bias' after 64 decisions is not finite"):
        trainer.save()
    assert (folder / STATE_FILE).read_bytes() == before


def test_ctrl_c_ends_a_run_that_can_be_continued(
    untrained_controller: Path,
    tmp_path: Path,
    quick_episodes: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    original = PlannerTrainer.select

    def interrupted(self: PlannerTrainer) -> float:
        signal.raise_signal(signal.SIGINT)
        return original(self)

    start = [*_TINY, f"--controller={untrained_controller}", f"--output={tmp_path}", "--name=run"]
    with monkeypatch.context() as patched:
        patched.setattr(PlannerTrainer, "select", interrupted)
        with pytest.raises(SystemExit) as exit_info:
            main([*start, "--total-decisions=128"])
    folder = tmp_path / "run"
    assert exit_info.value.code == 130 and f"continue with --resume {folder}" in capsys.readouterr().err
    decisions = torch.load(folder / STATE_FILE, weights_only=True)["decisions"]
    assert decisions < 128 and decisions % 64 == 0, "half a rollout taught nothing and does not count"
    main(["--resume", str(folder)])
    assert torch.load(folder / STATE_FILE, weights_only=True)["decisions"] == 128


def test_cloning_comes_first_and_the_actor_waits_for_the_critic(
    untrained_controller: Path,
    tmp_path: Path,
    quick_episodes: None,
    make_environment: Callable[..., CommandEnvironment],
    source: Source,
) -> None:
    environment = make_environment(2)
    rng = np.random.default_rng(0)
    width = environment.observation_size
    demonstrations = Demonstrations(
        source,
        rng.normal(size=(200, width)).astype(np.float32),
        rng.uniform(-1, 1, (200, 21)).astype(np.float32),
        rng.normal(size=200).astype(np.float32),
        np.repeat(np.arange(20), 10),
        attempts=25,
    )
    recorded = tmp_path / "recorded.npz"
    demonstrations.save(recorded)
    start = [*_TINY, f"--controller={untrained_controller}", f"--output={tmp_path}", "--cloning.epochs=2"]
    start += [f"--demonstration-file={recorded}", "--ppo.warm-up-updates=2", "--selection-episodes=1"]
    main([*start, "--name=warming", "--total-decisions=128"])
    main([*start, "--name=learning", "--total-decisions=192"])
    loaded = Planner.load(tmp_path / "warming" / "cloned")
    assert loaded.provenance["demonstrated_on"] == source.controller != loaded.config.controller
    with pytest.raises(SystemExit, match="recorded with another discount"):
        main([*start, "--name=other", "--ppo.discount=0.9"])
    assert not (tmp_path / "other").exists()
    cloned = loaded.actor.state_dict()
    warm = torch.load(tmp_path / "warming" / STATE_FILE, weights_only=True)["policy"]
    late = torch.load(tmp_path / "learning" / STATE_FILE, weights_only=True)["policy"]
    torch.testing.assert_close(warm["action_net.weight"], cloned["output.weight"], rtol=0, atol=0)
    torch.testing.assert_close(warm["features_extractor.mean"], cloned["mean"], rtol=0, atol=0)
    expected = torch.full((21,), PPOConfig().log_std_after_cloning)
    torch.testing.assert_close(warm["log_std"], expected, msg="the clone explores less than training from nothing")
    assert not torch.equal(late["action_net.weight"], cloned["output.weight"])
    assert not torch.equal(warm["value_net.weight"], late["value_net.weight"])
    entries = [json.loads(line) for line in (tmp_path / "warming" / LOG_FILE).read_text().splitlines()]
    assert entries[0]["cloning/train_error"] > 0.0 and entries[0]["decisions"] == 0
