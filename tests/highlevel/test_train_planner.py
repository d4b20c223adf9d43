"""A tiny training run through the command line: outputs, resume, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from highlevel.environment import PhysicsConfig
from highlevel.planner import Planner
from highlevel.train import main
from highlevel.trainer import BEST_FOLDER, LOG_FILE, STATE_FILE, read_run_description

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
    assert read_run_description(folder).total_decisions == 192
    main(["--resume", str(folder)])
    resumed = torch.load(folder / STATE_FILE, weights_only=True)
    assert resumed["decisions"] == 192 and resumed["updates"] == 3
    changed = [not torch.equal(state["policy"][name], resumed["policy"][name]) for name in state["policy"]]
    assert any(changed)
    for name in ("features_extractor.mean", "features_extractor.scale"):
        torch.testing.assert_close(state["policy"][name], resumed["policy"][name])


def test_bad_input_is_one_sentence(untrained_controller: Path, tmp_path: Path) -> None:
    where = [f"--controller={untrained_controller}", f"--output={tmp_path}", "--name=run"]
    for options, message in (
        ([*_TINY, *where, "--task=fly"], "there is no task 'fly'"),
        ([*_TINY, *where, "--ppo.batch-size=63"], "must divide a rollout"),
        ([*_TINY, f"--controller={tmp_path}", f"--output={tmp_path}"], "controller.json is missing"),
        (["--resume", str(tmp_path)], "holds no run.json"),
        (["--resume", str(tmp_path), "--seed=1"], "leave the other options out"),
    ):
        with pytest.raises(SystemExit, match=message):
            main(options)
    assert not (tmp_path / "run").exists()


def test_a_damaged_state_is_refused(untrained_controller: Path, tmp_path: Path, quick_episodes: None) -> None:
    start = [*_TINY, f"--controller={untrained_controller}", f"--output={tmp_path}", "--name=run"]
    main([*start, "--total-decisions=64", "--selection-episodes=1"])
    path = tmp_path / "run" / STATE_FILE
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(SystemExit, match="is not a training state"):
        main(["--resume", str(tmp_path / "run")])
