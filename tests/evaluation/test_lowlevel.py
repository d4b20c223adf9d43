from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evaluation.lowlevel import main
from evaluation.protocols.arena import Arena, Episode, Push
from evaluation.protocols.skills import SKILL_FIGURES
from evaluation.protocols.suites import suite_of
from evaluation.protocols.tracking import (
    FIGURES,
    GROUPS,
    energy_per_meter,
    group_of,
    mode_episodes,
    motion_modes,
    paired_differences,
    protocol_episodes,
    run_modes,
    run_tracking,
    run_walking,
    tracking_figures,
    walking_episodes,
)
from evaluation.reporting.statistics import wilson_interval
from lowlevel.control.controller import ONNX_FILE, Controller
from lowlevel.world.measures import TRACKING_FIGURES
from lowlevel.world.terrain import TerrainConfig
from robots.g1.constants import ARM_JOINTS

FLAT = TerrainConfig(tile_size=16.0)


@pytest.fixture(scope="module")
def controller(untrained_controller: Path) -> Controller:
    return Controller.load(untrained_controller)


@pytest.fixture(scope="module")
def arena(controller: Controller) -> Arena:
    return Arena(controller, FLAT, num_threads=1, batch=4)


def test_an_episode_is_the_same_in_evaluations_of_any_size(controller: Controller) -> None:
    space = controller.command_space
    few, many = protocol_episodes(space, 3, 7, 2), protocol_episodes(space, 20, 7, 2)
    for a, b in zip(few, many, strict=False):
        assert a.seed == b.seed and a.tile == b.tile and a.starts == b.starts == (0.0, 10.0)
        assert torch.equal(a.commands, b.commands) and torch.equal(a.flags, b.flags)
    assert not torch.equal(few[0].commands, protocol_episodes(space, 3, 8, 2)[0].commands)


def test_commands_follow_the_mixture(controller: Controller) -> None:
    episodes = protocol_episodes(controller.command_space, 400, 0, 2)
    commands = torch.cat([episode.commands for episode in episodes])
    group = group_of(commands, torch.cat([episode.flags for episode in episodes]))
    for index, share in enumerate((0.4, 0.4, 0.2)):
        low, high = wilson_interval(int((group == index).sum()), len(group), confidence=0.999)
        assert low < share + 0.005 and share - 0.005 < high, GROUPS[index]
    walking, standing = commands[group == 0], commands[group == 1]
    assert walking[:, 3].min() >= 0.55 and walking[:, 4].abs().max() <= 0.2
    assert walking[:, 5].min() >= -0.2 and walking[:, 5].max() <= 0.5
    assert standing[:, :3].abs().max() == 0.0 and standing[:, 3].min() < 0.35 and standing[:, 5].max() > 1.3
    assert {episode.tile for episode in episodes[::2]} == {0} and {e.tile for e in episodes[1::2]} == {1}


def two_commands(controller: Controller, count: int = 4) -> list[Episode]:
    """Episodes of two commands of 0.6 s; the first robot falls in its first one, the others stay up that long."""
    space = controller.command_space
    short = [
        replace(episode, duration=1.2, starts=(0.0, 0.6))
        for episode in protocol_episodes(space, count, seed=1, tiles=1)
    ]
    short[0] = replace(short[0], pushes=(Push(0.1, (0.0, 12.0, 0.0)),))
    return short


def test_the_table_agrees_with_a_plain_recount(arena: Arena, controller: Controller) -> None:
    """Every command is followed on its own and its errors are written out from their definitions."""
    episodes = two_commands(controller)
    table, transient = run_tracking(arena, episodes)
    moments = list(arena.run(episodes))
    assert table.episode.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    for line, (row, number) in enumerate((row, number) for row in range(4) for number in range(2)):
        recount: dict[str, list[float]] = {"E_h": [], "E_v": [], "E_arm": [], "E_omega": []}
        signed, work, way, targets = [], 0.0, 0.0, []
        told = episodes[row].commands[number].numpy()
        mine = [moment for moment in moments if moment.active[row] and moment.number[row] == number]
        for moment in mine:
            command, robot = moment.command[row].numpy(), moment.measured.robot
            yaw = moment.measured.heading[row].item()
            forward = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
            velocity = forward @ robot.base_linear_velocity[row, :2].numpy()
            height = robot.base_position[row, 2].item()  # flat ground at zero
            signed.append([*(velocity - command[:2]), moment.measured.yaw_rate[row].item() - command[2]])
            recount["E_v"].append(float(np.abs(velocity - command[:2]).sum()))
            recount["E_omega"].append(abs(signed[-1][2]))
            recount["E_h"].append(abs(height - command[3]))
            arms = robot.joint_position[row, ARM_JOINTS].numpy() - command[7:]
            recount["E_arm"].append(float(np.abs(arms).sum()))
            targets.append(moment.targets[row].numpy())
            speed = float(np.linalg.norm(told[:2]))
            if speed >= 0.1:
                work += moment.work[row].item()
                way += 0.02 * float(velocity @ told[:2]) / speed
        if episodes[row].flags[number] < 0.5:
            del recount["E_arm"]
            assert np.isnan(table.columns["E_arm"][line])
        for name, values in recount.items():
            assert table.columns[name][line] == pytest.approx(float(np.mean(values)), rel=1e-4), name
        assert table.columns["fell"][line] == float(any(moment.fell[row] for moment in mine))
        assert table.columns["energy"][line] == pytest.approx(work, rel=1e-4)
        assert table.columns["progress"][line] == pytest.approx(way, rel=1e-3, abs=1e-6)
        changes = np.abs(np.diff(targets, axis=0)).mean()
        assert table.columns["action_rate"][line] == pytest.approx(changes, rel=1e-4)
        if len(mine) == 30:  # one window of 0.5 s
            drift = np.abs(np.mean(signed[:25], axis=0))
            assert table.columns["E_v_mean"][line] == pytest.approx(drift[0] + drift[1], rel=1e-3)
            assert table.columns["E_omega_mean"][line] == pytest.approx(drift[2], rel=1e-3, abs=1e-6)
    assert table.columns["fell"][0] == 1.0, "twelve meters per second sideways fell nobody"
    assert np.isfinite(table.columns["E_v"][1]), "the fallen robot's next command counts, too"
    assert np.isnan(table.columns["E_v_steady"]).all(), "0.6 s are all transient"
    assert transient.shape == (30, len(TRACKING_FIGURES)) and np.isfinite(transient).all()


def test_figures_are_means_over_episodes_of_their_commands(arena: Arena, controller: Controller) -> None:
    table, _ = run_tracking(arena, two_commands(controller))
    figures = tracking_figures(table, ["flat"])
    by_episode = table.columns["E_v"].reshape(4, 2).mean(axis=1)
    assert figures["E_v"].n == 4 and figures["E_v"].value == pytest.approx(by_episode.mean())
    assert figures["E_v_steady"].value is None
    fell = table.columns["fell"].reshape(4, 2)
    assert figures["fall_rate"].value == fell.any(axis=1).mean() and figures["fall_rate"].n == 4
    assert figures["fall_rate_command"].value == fell.mean()
    assert figures["non_finite_rate"].value == 0.0
    assert figures["E_h_on_flat"] == figures["E_h"] and set(FIGURES) <= set(figures)


def test_steady_errors_begin_two_seconds_after_a_change(arena: Arena, controller: Controller) -> None:
    """With a transient of 0.1 s the steady mean is the mean over the other steps."""
    import evaluation.protocols.tracking as tracking

    episodes = two_commands(controller)[1:2]
    moments = list(arena.run(episodes))
    heights = [m.measured.base_height[0] - m.command[0, 3] for m in moments if m.number[0] == 0 and m.active[0]]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracking, "TRANSIENT", 0.1)
        table, _ = run_tracking(arena, episodes)
    expected = torch.stack(heights[5:]).abs().mean().item()
    assert table.columns["E_h_steady"][0] == pytest.approx(expected, rel=1e-4)


def test_a_controller_does_not_differ_from_itself_and_pairs_must_match(arena: Arena, controller: Controller) -> None:
    episodes = two_commands(controller)
    table, again = run_tracking(arena, episodes)[0], run_tracking(arena, episodes)[0]
    again.columns["E_v"] += 0.25
    differences = paired_differences(table, again)
    assert differences["E_h"].value == 0.0 and differences["E_h"].ci95 == (0.0, 0.0)
    assert differences["E_v"].value == pytest.approx(-0.25) and differences["E_v"].n == 4
    with pytest.raises(ValueError, match="same episodes"):
        paired_differences(table, run_tracking(arena, episodes[:2])[0])


def test_energy_per_meter_is_a_ratio_of_sums() -> None:
    """A still episode and one without translation commands change nothing; the interval is that of the ratio."""
    figure = energy_per_meter(np.array([400.0, 0.0, 800.0, 100.0]), np.array([2.0, 0.0, 3.0, 0.0]))
    assert figure.value == pytest.approx(1300.0 / 5.0) and figure.n == 3 and figure.unit == "J/m"
    rng = np.random.default_rng(0)
    way = rng.uniform(1.0, 9.0, 300)
    energy = 200.0 * way + rng.normal(0.0, 60.0, 300)
    figure = energy_per_meter(energy, way)
    picks = rng.integers(0, 300, (4000, 300))
    low, high = np.percentile(energy[picks].sum(axis=1) / way[picks].sum(axis=1), [2.5, 97.5])
    assert figure.ci95 is not None
    assert figure.ci95 == pytest.approx((low, high), abs=0.1 * (high - low))
    assert energy_per_meter(np.array([50.0]), np.array([-0.1])).value is None, "went backwards"


def test_walking_counts_falls_and_speed(arena: Arena, controller: Controller) -> None:
    episodes = [replace(episode, duration=0.8) for episode in walking_episodes(controller.command_space, 2, 0, 1)]
    assert episodes[0].commands[0, 0] == 0.5 and episodes[0].commands[0, 1:3].abs().max() == 0.0
    episodes[1] = replace(episodes[1], pushes=(Push(0.0, (0.0, 12.0, 0.0)),))
    figures = run_walking(arena, episodes)
    moments = list(arena.run(episodes))
    speeds = [
        np.mean([moment.measured.linear_velocity[row, 0].item() for moment in moments if moment.active[row]])
        for row in (0, 1)
    ]
    assert figures["walk_half_mps_survival"].value == 0.5
    assert figures["walk_half_mps_speed"].value == pytest.approx(np.mean(speeds), rel=1e-3)


def test_activations_are_averaged_by_mode(arena: Arena, controller: Controller) -> None:
    import evaluation.protocols.tracking as tracking

    space = controller.command_space
    lower, upper = space.bounds()
    for mode in motion_modes(space).values():
        assert ((mode >= lower) & (mode <= upper)).all()
    episodes = [replace(episode, duration=0.1) for episode in mode_episodes(space, 0)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracking, "TRANSIENT", 0.05)
        activations = run_modes(arena, episodes)
    assert activations.shape == (6, 4)
    np.testing.assert_allclose(activations.sum(axis=1), 1.0, atol=1e-5)
    second_mode = episodes[5:9]
    gates = torch.stack([moment.gate for moment in arena.run(second_mode)])[2:]
    by_hand = gates.mean(dim=(0, 1)).numpy()
    np.testing.assert_allclose(activations[1], by_hand, atol=0.02)


def test_suites() -> None:
    assert suite_of("simple").terrain.tiles == ("flat", "slabs")
    with pytest.raises(ValueError, match="unknown suite 'hard'; choose one of simple, flat, slabs, full"):
        suite_of("hard")


# -- the command ---------------------------------------------------------------------------------------------


def test_command_writes_a_report(
    untrained_controller: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    has_opengl: bool,
) -> None:
    monkeypatch.setattr("evaluation.protocols.tracking.MODE_EPISODES", 1)
    folder = tmp_path / "controller"
    shutil.copytree(untrained_controller, folder)
    output = tmp_path / "results" / "report"
    options = [
        "--episodes",
        "2",
        "--walk-episodes",
        "1",
        "--skill-episodes",
        "1",
        "--seed",
        "5",
        "--robots",
        "2",
        "--record",
        "1",
        "--against",
        str(untrained_controller),
    ]
    main(["--controller", str(folder), "--output", str(output), *options])
    strips = {"strip-1.png"} if has_opengl else set()
    assert {file.name for file in output.iterdir()} == strips | {
        "report.md",
        "metrics.json",
        "episodes.csv",
        "tracking.png",
        "transient.png",
        "experts.png",
        "comparison.png",
        "episode_0.rrd",
    }
    content = json.loads((output / "metrics.json").read_text())
    assert content["seed"] == 5 and content["suite"] == "simple" and len(content["controller"]) == 16
    assert content["figures"]["E_v"]["unit"] == "m/s" and content["figures"]["E_v"]["n"] == 2
    low, high = content["figures"]["E_v"]["ci95"]
    assert low <= content["figures"]["E_v"]["value"] <= high
    assert {"E_stumble", "fall_rate", "E_arm_steady", "walk_half_mps_survival"} <= set(content["figures"])
    assert {"energy_per_meter", "action_rate", *SKILL_FIGURES} <= set(content["figures"])
    assert content["figures"]["push_success"]["n"] == 1
    (difference,) = content["differences"].values()
    assert difference["E_v"]["value"] == 0.0
    (other,) = content["others"].values()
    assert other["E_v"] == content["figures"]["E_v"] and other["push_success"]["n"] == 1
    rows = (output / "episodes.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * 2 and rows[0].startswith("episode,tile,group,E_v,")
    text = (output / "report.md").read_text()
    assert "## Against other controllers" in text and "| figure | ours | " in text
    assert "## Skills" in text and "- deep_bend: bend to height" in text and "unloaded_bend" not in text
    assert "| push_success | 1 |" in text
    assert "0.145" in text, "the paper's figure stands beside ours"
    assert str(output / "report.md") in capsys.readouterr().out
    assert list(tmp_path.joinpath("results").iterdir()) == [output], "no temporary files stay behind"


def _truncate(folder: Path) -> None:
    network = folder / ONNX_FILE
    network.write_bytes(network.read_bytes()[:5000])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "controller.json").unlink(), "controller.json is missing"),
        (_truncate, "damaged or truncated"),
    ],
    ids=["empty", "truncated"],
)
def test_a_bad_controller_is_refused_in_one_sentence(
    untrained_controller: Path,
    tmp_path: Path,
    damage: Callable[[Path], None],
    message: str,
) -> None:
    folder = tmp_path / "controller"
    shutil.copytree(untrained_controller, folder)
    damage(folder)
    with pytest.raises(SystemExit) as stop:
        main(["--controller", str(folder), "--output", str(tmp_path / "report")])
    assert message in str(stop.value) and "\n" not in str(stop.value)
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--suite", "hard"], "unknown suite 'hard'"),
        (["--condition", "drunk"], "unknown condition 'drunk'; choose one of nominal, late-20ms"),
        (["--episodes", "0"], "--episodes must be at least 1"),
        (["--skill-episodes", "-1"], "--skill-episodes must not be negative"),
        (["--record", "33"], "--record must be between"),
        (["--output", "{file}/report"], "is not a folder"),
    ],
)
def test_bad_options_are_refused_in_one_sentence(
    untrained_controller: Path, tmp_path: Path, options: list[str], message: str
) -> None:
    file = tmp_path / "file"
    file.write_text("here already")
    with pytest.raises(SystemExit) as stop:
        main(["--controller", str(untrained_controller), *(option.format(file=file) for option in options)])
    assert message in str(stop.value) and "\n" not in str(stop.value)


def test_interrupting_leaves_nothing_behind(untrained_controller: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "evaluation.lowlevel", "--controller", str(untrained_controller)]
    process = subprocess.Popen(
        [*command, "--output", str(tmp_path / "report"), "--threads", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        # A shell starts its background jobs, and so their children, with the interrupt ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    assert "evaluating" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60.0)
    assert process.returncode != 0
    assert errors.strip() == "evaluate-lowlevel: interrupted, nothing was written"
    assert list(tmp_path.iterdir()) == []
