"""Tasks are found by name, and unknown ones are refused in one sentence."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import gymnasium
import pytest

import highlevel
from highlevel.registry import environment_id, load_task, register_tasks, task_modules
from highlevel.task import Task


def test_every_task_folder_loads_and_is_registered() -> None:
    assert "lift_box" in task_modules()
    for name in task_modules():
        task = load_task(name)
        assert isinstance(task, Task) and task.name == name
        assert environment_id(name) in gymnasium.registry


def test_an_unknown_task_is_refused_with_the_list_of_tasks() -> None:
    with pytest.raises(ValueError, match=r"there is no task 'fly'; the tasks are: .*lift_box"):
        load_task("fly")


def test_highlevel_knows_no_task_by_name() -> None:
    source = Path(highlevel.__file__).parent
    names = {word for name in task_modules() for word in (name, name.replace("_", ""))}
    for path in source.rglob("*.py"):
        code = [line for line in path.read_text().splitlines() if '"""' not in line]
        for number, line in enumerate(code):
            is_default = path.name == "config.py" and 'task: str = "' in line
            is_prose = path.name in ("__init__.py", "task.py") and "``" in line
            if not (is_default or is_prose):
                assert not any(word in line.lower().replace("/", "") for word in names), f"{path.name}: {number}"


def test_a_folder_without_a_task_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import tasks

    folder = tmp_path / "empty_task"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    monkeypatch.setattr(tasks, "__path__", [*tasks.__path__, str(tmp_path)])
    with pytest.raises(ValueError, match="no attribute TASK"):
        load_task("empty_task")
    sys.modules.pop("tasks.empty_task", None)


def test_a_task_may_come_from_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("lift_it_too", "tasks.lift_box", "open_pilot.tasks")
    monkeypatch.setattr("highlevel.registry.metadata.entry_points", lambda group: [entry])
    assert load_task("lift_it_too").name == "lift_box"
    register_tasks()
    assert gymnasium.registry.pop("pilot/LiftItToo-v0") is not None
    twice = EntryPoint("lift_box", "elsewhere.lift_box", "open_pilot.tasks")
    monkeypatch.setattr("highlevel.registry.metadata.entry_points", lambda group: [twice])
    with pytest.raises(ValueError, match=r"elsewhere\.lift_box and tasks\.lift_box are both called 'lift_box'"):
        load_task("lift_box")
