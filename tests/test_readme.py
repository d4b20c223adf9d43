"""What the README shows works as it stands there."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from evaluation import benchmark, demo
from evaluation import highlevel as evaluate_highlevel
from evaluation import lowlevel as evaluate_lowlevel
from highlevel import train as train_highlevel
from lowlevel import train as train_lowlevel

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_examples_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    examples = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names: list[dict[str, object]] = [{} for _ in examples]
    for example, defined in zip(examples, names, strict=True):
        exec(compile(example, "README.md", "exec"), defined)
    controller, task = names
    targets = controller["targets"]
    assert isinstance(targets, torch.Tensor)
    assert targets.shape == (1, 29) and targets.isfinite().all()
    assert isinstance(task["reward"], float)


def test_every_option_that_is_shown_exists(capsys: pytest.CaptureFixture[str]) -> None:
    commands = {
        "train-lowlevel": train_lowlevel.main,
        "train-highlevel": train_highlevel.main,
        "evaluate-lowlevel": evaluate_lowlevel.main,
        "evaluate-highlevel": evaluate_highlevel.main,
        "run-demo": demo.main,
        "benchmark": benchmark.main,
    }
    lines = re.findall(r"^    (.+)$", README, flags=re.MULTILINE)
    # Inline code may go on in the next line.
    shown = [*lines, *(" ".join(code.split()) for code in re.findall(r"`([^`]+)`", README))]
    used = {
        name: {option for line in shown if re.search(rf"(^|[ =]){name}( |$)", line) for option in _options(line)}
        for name in commands
    }
    assert sum(map(len, used.values())) > 10
    for name, main in commands.items():
        with pytest.raises(SystemExit):
            main(["--help"])
        assert used[name] <= _options(capsys.readouterr().out), name


def _options(text: str) -> set[str]:
    return set(re.findall(r"(?<![\w-])--[a-z][a-z0-9.-]*", text))


@pytest.mark.parametrize("report", ["lift-box-planner", "lift-box-seed-1", "lift-box-seed-2", "lift-box-scripted"])
def test_success_rates_are_those_of_the_reports(report: str) -> None:
    figures = json.loads((ROOT / "docs" / "reports" / report / "metrics.json").read_text())["figures"]
    shares = (_share(figures[name]) for name in ("full", "lift_up", "fall_rate"))
    time = figures["success_time"]["value"]
    assert f"| {' | '.join(shares)} | {time:.1f} s |" in README


@pytest.mark.parametrize(
    "condition", ["slippery", "late-20ms", "late-40ms", "other-gains", "weak-motors", "weak-waist"]
)
def test_success_under_a_condition_is_that_of_its_report(condition: str) -> None:
    content = json.loads((ROOT / "docs" / "reports" / f"lift-box-{condition}" / "metrics.json").read_text())
    assert content["condition"] == condition
    assert f"| {_share(content['figures']['full'])} |" in README


def test_tracking_figures_are_those_of_the_report() -> None:
    figures = json.loads((ROOT / "docs" / "reports" / "lowlevel-simple" / "metrics.json").read_text())["figures"]
    for name, digits in (("E_v", 3), ("E_omega", 3), ("E_h", 4), ("E_arm", 3)):
        low, high = figures[name]["ci95"]
        assert f"| {figures[name]['value']:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}] |" in README, name
    for name in ("fall_rate", "deep_bend_success", "stop_rest", "push_success"):
        assert f"| {_share(figures[name])} |" in README, name


def _share(figure: dict[str, Any]) -> str:
    low, high = figure["ci95"]
    return f"{100 * figure['value']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def test_every_file_that_is_linked_exists() -> None:
    links = re.findall(r"\]\((?!http)([^)#]+)", README)
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []
