from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from evaluation.demo import Arguments, EpisodeSummary, draw, main, outcome_text, run_episode


def test_the_story_is_that_of_the_numbered_episode(
    untrained_controller: Path, tmp_path: Path, has_opengl: bool
) -> None:
    summaries: list[EpisodeSummary] = []
    for number in (0, 1):
        arguments = Arguments("scripted", seed=2, episode=number, threads=1)
        summary, twin = run_episode(arguments, untrained_controller, tmp_path / f"{len(summaries)}.rrd")
        summaries.append(summary)
    assert not summaries[0].success and summaries[0].failure is not None
    assert not np.array_equal(summaries[0].instants["start"], summaries[1].instants["start"])
    assert next(iter(summaries[1].instants)) == "start" and list(summaries[1].instants)[-1] == "end"
    box = twin.model.geom("box").size
    where = summaries[1].instants["start"]
    summary = EpisodeSummary(False, "drop", 1.0, {"approach": 0.5}, {"start": where, "approach": where, "end": where})
    names = ["stages.png", "0_start.png", "1_approach.png", "2_end.png"] if has_opengl else []
    assert draw(twin, summary, tmp_path) == names
    assert sorted(file.name for file in tmp_path.glob("*.png")) == sorted(names)
    assert ((box >= 0.125) & (box <= 0.175)).all() and len(set(box.tolist())) == 3, "the box has a drawn size"


def test_command_leaves_recording_report_and_outcome(
    untrained_controller: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "demo"
    where = ["--controller", str(untrained_controller), "--output", str(output)]
    main(["--planner", "scripted", *where, "--no-pictures", "--threads", "1"])
    assert {file.name for file in output.iterdir()} == {"episode.rrd", "report.md", "outcome.json"}
    outcome = json.loads((output / "outcome.json").read_text())
    assert outcome["success"] is False and outcome["planner"] == "scripted"
    times: dict[str, int] = {}
    for chunk in RrdReader(output / "episode.rrd").stream().to_chunks():
        if not chunk.is_static:
            times[chunk.entity_path] = times.get(chunk.entity_path, 0) + chunk.num_rows
    assert times["/world/pelvis"] == times["/world/box"] >= 5
    printed = capsys.readouterr().out
    assert "failure" in printed and str(output / "episode.rrd") in printed
    assert list(tmp_path.iterdir()) == [output]


def test_outcomes_in_words() -> None:
    assert outcome_text(EpisodeSummary(True, None, 9.5, {"lift": 7.0}, {})) == "success after 9.5 s"
    failed = EpisodeSummary(False, "drop", 8.0, {"approach": 3.0, "lift": 7.0}, {})
    assert outcome_text(failed) == "failure (drop) after 8.0 s, after the stage 'lift'"
    assert "before the first stage" in outcome_text(EpisodeSummary(False, "fall", 1.0, {}, {}))


def test_bad_input_is_refused_in_one_sentence(untrained_controller: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--planner", str(tmp_path), "--controller", str(untrained_controller)])
    assert "planner.json is missing" in str(stop.value) and "\n" not in str(stop.value)
