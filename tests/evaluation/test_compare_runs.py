"""Training curves side by side: averages, the picture, and refusals."""

import json
from pathlib import Path

import numpy as np
import pytest

from evaluation.compare_runs import PANELS, main, read_curves
from lowlevel.runs.run_folder import LOG_FILE


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A log of 12 updates in which every figure is the number of the update."""
    folder = tmp_path / "run"
    folder.mkdir()
    lines = [json.dumps({"steps": 1000 * i} | dict.fromkeys(PANELS, float(i))) for i in range(12)]
    (folder / LOG_FILE).write_text("\n".join(["{}", *lines]) + "\n")
    return folder


def test_curves_are_averages_over_the_window(run: Path) -> None:
    steps, curves = read_curves(run, window=3)
    np.testing.assert_allclose(steps, 1000.0 * np.arange(1, 11))
    assert set(curves) == set(PANELS)
    np.testing.assert_allclose(curves["tracking/E_v"], np.arange(1, 11))


def test_command_draws_a_picture(run: Path, tmp_path: Path) -> None:
    main([str(run), str(run), "--output", str(tmp_path / "pictures" / "curves.png")])
    assert (tmp_path / "pictures" / "curves.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("arguments", [["missing"], ["{run}", "--window", "20"], ["{run}", "--window", "0"], []])
def test_bad_input_is_one_sentence(run: Path, tmp_path: Path, arguments: list[str]) -> None:
    output = tmp_path / "curves.png"
    with pytest.raises(SystemExit) as stopped:
        main([argument.format(run=run) for argument in arguments] + ["--output", str(output)])
    message = str(stopped.value)
    assert message.startswith("evaluation.compare_runs: ") and "\n" not in message
    assert not output.exists()


def test_damaged_logs_and_ambiguous_names_are_refused(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "elsewhere" / run.name
    other.mkdir(parents=True)
    (other / LOG_FILE).write_text("{")
    with pytest.raises(SystemExit, match="is damaged"):
        main([str(other), "--output", str(tmp_path / "curves.png")])
    (other / LOG_FILE).write_text((run / LOG_FILE).read_text())
    with pytest.raises(SystemExit, match="same name"):
        main([str(run), str(other), "--output", str(tmp_path / "curves.png")])
    with pytest.raises(SystemExit, match="names no picture"):
        main([str(run), "--output", str(tmp_path)])
    assert not (tmp_path / "curves.png").exists()
