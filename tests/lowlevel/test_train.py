"""Training runs: exact resume, crash safety and the command line."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from some_correction import fill

from lowlevel.control.controller import Controller
from lowlevel.environment import EnvironmentConfig
from lowlevel.export import export_run
from lowlevel.networks.config import NetworkConfig
from lowlevel.presets import PRESETS
from lowlevel.runs.configs import from_plain
from lowlevel.runs.run_folder import LOG_FILE, STATE_FILE, RunFolder, describe_run
from lowlevel.train import main
from lowlevel.trainer import Trainer, TrainingConfig
from robots.errors import PilotError

TINY_NETWORK = NetworkConfig(
    history_hidden=(16,),
    map_hidden=8,
    map_global=4,
    expert_hidden=(16, 8),
    critic_hidden=(16,),
    target_hidden=(16,),
)


def tiny(**changes: object) -> TrainingConfig:
    """A run small enough for a test."""
    base = TrainingConfig(
        environment=EnvironmentConfig(num_robots=8, num_threads=1),
        network=TINY_NETWORK,
        ppo=replace(TrainingConfig().ppo, steps_per_update=8, minibatches=2),
    )
    return replace(base, **changes)  # type: ignore[arg-type]


def weights(trainer: Trainer) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in trainer.ppo.actor.parameters()])


def run(trainer: Trainer, iterations: int) -> list[dict[str, float]]:
    if not trainer.observation:
        trainer.observation = trainer.environment.reset(spread_episodes=True)
    return [trainer.iterate() for _ in range(iterations)]


def without_clock(figures: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in figures.items() if not name.startswith("speed/")}


def test_resumed_run_is_bit_exact_over_twenty_updates(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    unbroken = Trainer(tiny(), tmp_path)
    run(unbroken, 3)
    unbroken.save()
    expected = run(unbroken, 20)
    resumed = Trainer(tiny(seed=5), tmp_path)
    resumed.load()
    figures = run(resumed, 20)
    assert torch.equal(weights(unbroken), weights(resumed))
    assert [without_clock(f) for f in figures] == [without_clock(f) for f in expected]


def test_a_run_that_sees_begins_with_what_a_blind_one_does(tmp_path: Path) -> None:
    (tmp_path / "blind").mkdir()
    blind = Trainer(tiny(network=replace(TINY_NETWORK, vision=False)), tmp_path / "blind")
    run(blind, 2)
    fill(blind.environment.correction)
    blind.save()
    seeing = Trainer(tiny(seed=3), tmp_path / "seeing")
    seeing.begin_seeing(blind.run)
    for name, values in blind.environment.correction.state_dict().items():
        assert torch.equal(seeing.environment.correction.state_dict()[name], values)
    observation = blind.environment.reset()
    torch.testing.assert_close(seeing.ppo.deterministic(observation), blind.ppo.deterministic(observation))
    torch.testing.assert_close(
        seeing.ppo.critic(observation["privileged"]), blind.ppo.critic(observation["privileged"])
    )
    figures = run(seeing, 2)
    assert figures[-1]["learner/kl"] < 1.0
    with pytest.raises(PilotError, match="choose --preset vision"):
        blind.begin_seeing(blind.run)
    blind.run.save({name: part for name, part in blind.state_dict().items() if name != "correction"})
    with pytest.raises(PilotError, match="another version: it has no 'correction'"):
        seeing.begin_seeing(blind.run)


def test_only_networks_multiply_coarsely(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, str] = {}
    trainer = Trainer(tiny(), tmp_path)

    def watch(name: str, owner: object, method: str) -> None:
        original = getattr(owner, method)

        def watched(*arguments: object, **options: object) -> object:
            seen[name] = torch.get_float32_matmul_precision()
            return original(*arguments, **options)

        monkeypatch.setattr(owner, method, watched)

    watch("act", trainer.ppo, "act")
    watch("update", trainer.ppo, "update")
    watch("world", trainer.environment, "step")
    run(trainer, 1)
    assert seen == {"act": "medium", "update": "medium", "world": "highest"}
    assert torch.get_float32_matmul_precision() == "highest"


def test_networks_that_see_do_not_begin_from_nothing(tmp_path: Path) -> None:
    for preset in ("vision", "no-attention"):
        with pytest.raises(SystemExit, match="name its folder with --blind"):
            main([*ARGUMENTS, "--preset", preset, "--output", str(tmp_path)])
    assert not list(tmp_path.iterdir())


def test_same_seed_same_weights_other_seed_other_weights(tmp_path: Path) -> None:
    trainers = [Trainer(tiny(seed=seed), tmp_path) for seed in (1, 1, 2)]
    for trainer in trainers:
        run(trainer, 2)
    assert torch.equal(weights(trainers[0]), weights(trainers[1]))
    assert not torch.equal(weights(trainers[0]), weights(trainers[2]))


def test_configuration_survives_json(tmp_path: Path) -> None:
    for preset, config in PRESETS.items():
        description = describe_run(config, preset=preset)
        assert from_plain(TrainingConfig, json.loads(json.dumps(description["config"]))) == config
    RunFolder(tmp_path).describe(PRESETS["no-moe"], preset="no-moe")
    assert RunFolder(tmp_path).config(TrainingConfig) == PRESETS["no-moe"]


ARGUMENTS = [
    "--environment.num-robots", "8", "--environment.num-threads", "1", "--ppo.steps-per-update", "8",
    "--ppo.minibatches", "2", "--save-interval", "0",
]  # fmt: skip


def test_command_line_trains_and_resumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([*ARGUMENTS, "--preset", "no-mirror", "--total-steps", "128", "--output", str(tmp_path), "--name", "run"])
    folder = tmp_path / "run"
    assert "no controller yet: the stage 'balance' has a gait prior" in capsys.readouterr().out
    assert not (folder / "controller").exists()
    entries = [json.loads(line) for line in (folder / LOG_FILE).read_text().splitlines()]
    assert [entry["steps"] for entry in entries] == [64, 128]
    with pytest.raises(SystemExit, match="already holds a run"):
        main([*ARGUMENTS, "--output", str(tmp_path), "--name", "run"])
    main(["--resume", str(folder), "--total-steps", "192"])
    entries = [json.loads(line) for line in (folder / LOG_FILE).read_text().splitlines()]
    assert [entry["steps"] for entry in entries] == [64, 128, 192]
    description = RunFolder(folder).description()
    assert description["preset"] == "no-mirror" and description["config"]["ppo"]["mirror_loss_weight"] == 0.0
    assert [start["config"]["total_steps"] for start in description["earlier"]] == [128]


def test_a_run_without_a_gait_prior_ends_with_its_controller(tmp_path: Path) -> None:
    Trainer(tiny(), tmp_path).save()
    RunFolder(tmp_path).describe(tiny(), preset="simple")
    main(["--resume", str(tmp_path), "--total-steps", "64"])
    Controller.load(tmp_path / "controller")
    export_run(tmp_path, tmp_path / "exported")
    Controller.load(tmp_path / "exported", runtime="torch")


def test_of_two_runs_with_one_name_the_second_is_refused_before_the_first_has_saved(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    run.require_unused()
    run.claim()
    with pytest.raises(PilotError, match="another run has just begun"):
        run.claim()
    run.describe(tiny(), preset="simple")
    described = run.description()
    with pytest.raises(SystemExit, match="a run that has saved nothing yet: give another --name"):
        main([*ARGUMENTS, "--output", str(tmp_path), "--name", "run"])
    assert run.description() == described


def test_ctrl_c_ends_a_run_that_can_be_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    original = Trainer.iterate

    def interrupted(self: Trainer) -> dict[str, float]:
        signal.raise_signal(signal.SIGINT)
        return original(self)

    monkeypatch.setattr(Trainer, "iterate", interrupted)
    with pytest.raises(SystemExit) as exit_info:
        main([*ARGUMENTS, "--total-steps", "128", "--output", str(tmp_path), "--name", "run"])
    assert exit_info.value.code == 130 and f"continue with --resume {tmp_path / 'run'}" in capsys.readouterr().err
    assert torch.load(tmp_path / "run" / STATE_FILE, weights_only=True)["steps"] == 64


def test_killed_run_resumes_from_its_last_save(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "lowlevel.train", *ARGUMENTS, "--output", str(tmp_path), "--name", "run"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ)
    state = tmp_path / "run" / STATE_FILE
    deadline = time.monotonic() + 300
    while not state.exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    time.sleep(0.3)
    process.send_signal(signal.SIGKILL)
    process.wait()
    trainer = Trainer(RunFolder(tmp_path / "run").config(TrainingConfig), tmp_path / "run")
    trainer.load()
    assert trainer.steps > 0
    run(trainer, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--preset", "stairs"], "unknown preset 'stairs'"),
        (["--resume", "/nonexistent"], "/nonexistent holds no run.json"),
        (["--resume", "/nonexistent", "--preset", "simple"], "leave --preset out"),
        (["--output", "/proc/nowhere"], "/proc/nowhere"),
        (["--environment.gains", "rubber"], "unknown gain set 'rubber'"),
        (["--environment.num-robots", "0"], "num_robots must be at least 1"),
        (["--device", "abacus"], "unknown device 'abacus'"),
    ],
)
def test_bad_input_gives_one_sentence(arguments: list[str], message: str, tmp_path: Path) -> None:
    output = [] if "--output" in arguments or "--resume" in arguments else ["--output", str(tmp_path)]
    with pytest.raises(SystemExit) as exit_info:
        main([*arguments, *output])
    assert message in str(exit_info.value) and "\n" not in str(exit_info.value)


def test_a_state_that_cannot_be_used_is_refused_and_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    trainer = Trainer(tiny(), folder)
    trainer.save()
    path = folder / STATE_FILE
    RunFolder(folder).describe(tiny(), preset="simple")
    content, state = path.read_bytes(), trainer.state_dict()

    def refusal() -> str:
        before = path.read_bytes()
        with pytest.raises(SystemExit) as exit_info:
            main(["--resume", str(folder)])
        assert path.read_bytes() == before
        return str(exit_info.value)

    for length in (0, 5000):
        path.write_bytes(content[:length])
        assert "is not a readable training state" in refusal()
    torch.save({name: value for name, value in state.items() if name != "curriculum"}, path)
    assert "has no 'curriculum'" in refusal()
    torch.save(state, path)
    bias = next(name for name in state["ppo"]["actor"] if name.endswith("bias"))
    state["ppo"]["actor"][bias].view(-1)[0] = torch.nan
    torch.save(state, path)
    assert f"weight {bias!r}" in refusal() and "is not finite" in refusal()


def test_the_shipped_learning_state_can_be_continued() -> None:
    run = Path(__file__).resolve().parents[2] / "checkpoints" / "training" / "pilot-g1-simple"
    config = RunFolder(run).config(TrainingConfig)
    small = replace(
        config,
        environment=replace(config.environment, num_robots=8, num_threads=1),
        ppo=replace(config.ppo, steps_per_update=4, minibatches=2),
    )
    trainer = Trainer(small, run)
    trainer.load()
    trainer.observation = trainer.environment.reset()
    assert trainer.steps > 1_000_000 and trainer.stage.name == "refine"
    trainer.iterate()
