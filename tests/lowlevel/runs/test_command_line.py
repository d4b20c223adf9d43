"""What a user can mend ends a command in one sentence; a bug keeps its traceback."""

import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from lowlevel.runs.command_line import command_line
from lowlevel.runs.interrupts import stop_on_signals
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_every_signal_that_ends_a_process_ends_it_in_order(
    number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as stopped, command_line("benchmark", "nothing was written"):
        signal.raise_signal(number)
    assert stopped.value.code == 130 and capsys.readouterr().err == "benchmark: nothing was written\n"
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_loop_is_asked_to_stop_and_is_not_cut_off(number: signal.Signals) -> None:
    requests: list[int] = []
    with stop_on_signals(lambda: requests.append(1)):
        signal.raise_signal(number)
    assert requests == [1]


def test_a_training_can_be_started_in_any_thread() -> None:
    def run() -> bool:
        with stop_on_signals(lambda: None):
            return True

    with ThreadPoolExecutor(1) as executor:
        assert executor.submit(run).result()
