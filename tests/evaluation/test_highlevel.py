from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from evaluation.highlevel import (
    Arguments,
    Evaluation,
    all_figures,
    control_names,
    evaluate,
    failure_figures,
    main,
    report_text,
    success_figures,
    with_control,
)
from evaluation.reporting.statistics import wilson_interval
from highlevel.episodes import EpisodeRecord
from highlevel.registry import load_task

STAGES = ("approach", "reach", "grasp", "lift", "upright", "hold")


def record(number: int, stage: int, failure: str | None, duration: float = 15.0) -> EpisodeRecord:
    return EpisodeRecord(number, failure is None, stage, failure, duration, total_reward=float(stage))


RECORDS = [
    record(0, 6, None, duration=10.0),
    record(1, 6, None, duration=12.0),
    record(2, 4, "drop"),
    record(3, 1, "fall"),
    record(4, 1, "fall"),
]


def test_figures_count_full_and_partial_success() -> None:
    figures = success_figures(RECORDS, STAGES)
    assert figures["full"].value == pytest.approx(0.4)
    assert figures["full"].ci95 == wilson_interval(2, 5)
    assert figures["lift_up"].value == pytest.approx(0.6)
    assert figures["fall_rate"].value == pytest.approx(0.4)
    assert figures["success_time"].value == pytest.approx(11.0) and figures["success_time"].n == 2
    passed = [figures[f"stage_{stage}"].value for stage in STAGES]
    assert passed == pytest.approx([1.0, 0.6, 0.6, 0.6, 0.4, 0.4])


def test_tasks_without_a_lifting_stage_have_no_lift_up() -> None:
    assert "lift_up" not in success_figures(RECORDS, ("walk", "open"))


def test_failures_are_listed_by_frequency() -> None:
    assert [(name, figure.value) for name, figure in failure_figures(RECORDS).items()] == [
        ("fall", pytest.approx(0.4)),
        ("drop", pytest.approx(0.2)),
    ]


def test_a_failed_episode_is_described_by_what_it_was_and_how_far_it_came() -> None:
    won = EpisodeRecord(0, True, 3, None, 9.0, 0.0, (1.0, 2.0, 9.0), {"mass [kg]": 1.0})
    lost = EpisodeRecord(7, False, 1, "not_upright", 15.0, 0.0, (4.0,), {"mass [kg]": 1.25})
    arguments = Arguments("scripted")
    evaluation = Evaluation(arguments, "c", None, ("walk", "lift", "hold"), [won, lost], {}, [], 1.0)
    lines = report_text(evaluation, all_figures(evaluation)).splitlines()
    assert "| episode | mass [kg] | walk [s] | lift [s] | hold [s] | end [s] |" in lines
    assert "| 7 | 1.25 | 4.0 | - | - | not upright at 15.0 |" in lines
    assert not any(line.startswith("| 0 |") for line in lines)


def test_negative_controls_change_nothing_else() -> None:
    task = load_task("lift_box")
    assert control_names(task) == ("frictionless", "no_hands")
    before = task.describe()
    for name in control_names(task):
        after = with_control(task, name).describe()
        assert after.pop("control") == name
        assert after == {key: value for key, value in before.items() if key != "control"}
    del task.config  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="has no negative controls"):
        control_names(task)


def test_an_evaluation_repeats_itself_and_grows_by_new_episodes(untrained_controller: Path) -> None:
    arguments = Arguments("scripted", episodes=1, seed=3, robots=2, threads=1)
    few = evaluate(arguments, untrained_controller)
    many = evaluate(replace(arguments, episodes=2, controls=True, control_episodes=1), untrained_controller)
    assert [r.number for r in many.records] == [0, 1]
    assert many.records[:1] == few.records
    assert set(many.controls) == {"frictionless", "no_hands"}
    side_by_side = evaluate(replace(many.arguments, threads=2), untrained_controller)
    assert side_by_side.records == many.records and side_by_side.controls == many.controls
    assert all([r.number for r in records] == [0] for records in many.controls.values())
    assert few.planner is None and len(few.controller) == 16


def test_command_writes_a_report(
    untrained_controller: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    output = tmp_path / "report"
    where = ["--controller", str(untrained_controller), "--output", str(output)]
    main(["--planner", "scripted", *where, "--episodes", "2", "--seed", "4", "--robots", "2"])
    assert {file.name for file in output.iterdir()} == {
        "report.md",
        "metrics.json",
        "episodes.json",
        "stages.png",
    }
    content = json.loads((output / "metrics.json").read_text())
    assert content["seed"] == 4 and content["planner"] == "scripted" and len(content["controller"]) == 16
    for name in ("full", "lift_up", "fall_rate"):
        assert content["figures"][name]["n"] == 2
    episodes = json.loads((output / "episodes.json").read_text())
    assert [episode["number"] for episode in episodes] == [0, 1]
    falls = sum(episode["failure"] == "fall" for episode in episodes)
    assert content["figures"]["fall_rate"]["value"] == pytest.approx(falls / 2)
    assert str(output / "report.md") in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--planner", "scripted", "--task", "fly"], "there is no task 'fly'"),
        (["--planner", "{tmp}/nowhere"], "planner.json is missing"),
        (["--planner", "scripted", "--episodes", "0"], "--episodes must be at least 1"),
        (["--planner", "scripted", "--condition", "windy"], "unknown condition 'windy'"),
        (["--planner", "scripted", "--condition", "heavy-torso"], "heavy-torso is for evaluate-lowlevel alone"),
        (["--planner", "scripted", "--controller", "{tmp}"], "controller.json is missing"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(
    untrained_controller: Path, tmp_path: Path, options: list[str], message: str
) -> None:
    options = [option.format(tmp=tmp_path) for option in options]
    if "--controller" not in options:
        options += ["--controller", str(untrained_controller)]
    with pytest.raises(SystemExit) as stop:
        main([*options, "--output", str(tmp_path / "report")])
    assert message in str(stop.value) and "\n" not in str(stop.value)
    assert not (tmp_path / "report").exists()
