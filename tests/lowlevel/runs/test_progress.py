"""Progress where there is a terminal and where there is none."""

import io

import pytest
from rich.console import Console

from lowlevel.runs import progress
from lowlevel.runs.progress import ProgressReport


def output_of(monkeypatch: pytest.MonkeyPatch, interval: float, terminal: bool) -> str:
    monkeypatch.setattr(progress, "LINE_INTERVAL", interval)
    console = Console(file=io.StringIO(), force_terminal=terminal, width=120)
    report = ProgressReport(console=console)
    # Not started: nothing but the lines is printed.
    task = report.add_task("starting", total=4)
    for done in range(1, 4):
        report.update(task, completed=done, description=f"step {done}")
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_a_log_file_gets_lines_with_percentage_and_description(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = output_of(monkeypatch, interval=0.0, terminal=False).splitlines()
    assert len(lines) == 3
    assert lines[1].split()[0] == "50.0%" and lines[1].endswith("step 2")


def test_lines_are_rare_and_a_terminal_gets_none(monkeypatch: pytest.MonkeyPatch) -> None:
    assert output_of(monkeypatch, interval=1000.0, terminal=False) == ""
    assert output_of(monkeypatch, interval=0.0, terminal=True) == ""


@pytest.mark.parametrize(("hidden", "printed"), [(False, "stage [2] begins\n"), (True, "")])
def test_what_is_said_stays_and_only_one_rank_says_it(hidden: bool, printed: str) -> None:
    console = Console(file=io.StringIO(), width=120)
    ProgressReport(hidden=hidden, console=console).say("stage [2] begins")
    assert console.file.getvalue() == printed  # type: ignore[attr-defined]
