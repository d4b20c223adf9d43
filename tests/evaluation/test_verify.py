"""verify-policy: it measures what a policy does, and refuses a card that says otherwise."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from evaluation.baselines.onnx_policy import CARDS
from evaluation.protocols.arena import Arena, constant
from evaluation.protocols.skills import FLAT
from evaluation.verify import TESTS, TOLERANCE, deviations, main, told, told_speeds
from lowlevel.control.controller import Controller


def test_cards_state_every_test_and_nothing_else() -> None:
    for path in CARDS.glob("*.json"):
        assert json.loads(path.read_text())["verified"].keys() == TESTS.keys(), path.name


def test_what_deviates_by_more_than_the_tolerance_is_named() -> None:
    stated = {"stands": 1.0, "walks at 0.5 m/s": 0.5}
    assert deviations({"stands": 1.0, "walks at 0.5 m/s": 0.5 + 0.9 * TOLERANCE}, stated) == []
    wrong = deviations({"stands": 0.5, "walks at 0.5 m/s": 0.2}, stated)
    assert wrong == ["stands: 0.500 instead of 1.000", "walks at 0.5 m/s: 0.200 instead of 0.500 m/s"]


def test_commands_are_told_in_full_to_who_supports_them(untrained_controller: Path) -> None:
    controller = Controller.load(untrained_controller)
    assert told_speeds(controller)["turns at 0.6 rad/s"] == pytest.approx(0.6)
    command = told(TESTS["walks and turns"], Arena(controller, FLAT, batch=1).space)
    assert command[:3].tolist() == pytest.approx([0.5, 0.0, 0.4])


def test_the_command_measures_a_controller(
    untrained_controller: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evaluation.verify.EPISODES", 2)
    main([str(untrained_controller)])
    out = capsys.readouterr().out
    rows = {cells[1].strip(): cells for line in out.splitlines() if (cells := line.split("|"))[2:]}
    controller = Controller.load(untrained_controller)
    arena = Arena(controller, FLAT, batch=2)
    episodes = [constant(seed, 20.0, told(TESTS["stands"], arena.space), flag=1.0) for seed in range(2)]
    falls = sum(int(moment.fell.sum()) for moment in arena.run(episodes))
    assert float(rows["stands"][4]) == 1.0 - falls / 2 and abs(float(rows["walks at 0.9 m/s"][4])) < 0.3
    assert rows["walks at 0.9 m/s"][3].strip() == "0.900" and rows["walks at 0.9 m/s"][5].strip() == "–"
    stated = json.loads(out[out.index("{") :])
    assert stated.keys() == TESTS.keys()
