from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

import pytest
import torch
from safetensors.torch import load_file, save

from lowlevel.runs.files import atomic_write


def test_writes_replace_the_whole_file_and_leave_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    for content in ({"a": 1}, {"b": [1, 2]}):
        atomic_write(path, lambda file, content=content: file.write(json.dumps(content).encode()))
        assert json.loads(path.read_text()) == content
    assert [entry.name for entry in tmp_path.iterdir()] == ["state.json"]


def test_tensors_survive_the_round_trip(tmp_path: Path) -> None:
    state = {"weights": torch.randn(5, 3), "steps": 7, "rates": [0.1, 0.2], "name": "run"}
    atomic_write(tmp_path / "state.pt", lambda file: torch.save(state, file))
    loaded = torch.load(tmp_path / "state.pt", weights_only=True)
    assert torch.equal(loaded.pop("weights"), state.pop("weights")) and loaded == state
    tensors = {"x": torch.randn(4)}
    atomic_write(tmp_path / "weights.safetensors", lambda file: file.write(save(tensors)))
    assert torch.equal(load_file(tmp_path / "weights.safetensors")["x"], tensors["x"])


def test_a_writer_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "state"
    path.write_bytes(b"old")

    def fail(file: BinaryIO) -> None:
        file.write(b"half")
        raise RuntimeError("disk on fire")

    with pytest.raises(RuntimeError, match="disk on fire"):
        atomic_write(path, fail)
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["state"]


def test_kill_while_writing_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "state"
    path.write_bytes(b"old")
    program = """
import sys, time
from pathlib import Path
from typing import BinaryIO
from lowlevel.runs.files import atomic_write

def write(file):
    file.write(b"half of the new content")
    file.flush()
    print("writing", flush=True)
    time.sleep(60)

atomic_write(Path(sys.argv[1]), write)
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", program, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == b"writing"
        process.send_signal(signal.SIGKILL)
    assert path.read_bytes() == b"old"
    atomic_write(path, lambda file: file.write(b"new"))
    assert [entry.name for entry in tmp_path.iterdir()] == ["state"] and path.read_bytes() == b"new"


def test_files_have_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").write_bytes(b"x")
    atomic_write(tmp_path / "shared", lambda file: file.write(b"x"))
    assert (tmp_path / "shared").stat().st_mode == (tmp_path / "plain").stat().st_mode
