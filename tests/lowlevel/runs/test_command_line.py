"""What a user can mend ends a command in one sentence; a bug keeps its traceback."""

import pytest

from lowlevel.runs.command_line import command_line
from robots.errors import PilotError


def test_what_a_user_can_mend_is_one_sentence() -> None:
    with (
        pytest.raises(SystemExit, match=r"^train-lowlevel: there is no such preset$"),
        command_line("train-lowlevel", ""),
    ):
        raise PilotError("there is no such preset")


@pytest.mark.parametrize(
    "bug", [ValueError("zip() argument 2 is shorter"), KeyError("phase"), OSError("no space left")]
)
def test_a_bug_keeps_its_traceback(bug: Exception) -> None:
    with pytest.raises(type(bug)) as caught, command_line("train-lowlevel", ""):
        raise bug
    assert caught.value is bug


def test_ctrl_c_says_what_it_leaves(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped, command_line("benchmark", "nothing was written"):
        raise KeyboardInterrupt
    assert stopped.value.code == 130
    assert capsys.readouterr().err == "benchmark: nothing was written\n"
