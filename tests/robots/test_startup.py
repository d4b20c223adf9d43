"""What is in the way of an import is named, or done without."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("name", ["robots", "tasks", "evaluation"])
def test_another_package_of_the_same_name_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text("")
    result = subprocess.run([sys.executable, "-c", "import highlevel"], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode != 0
    assert f"the package '{name}' that Python finds is {tmp_path / name}" in result.stderr


def test_pictures_alone_need_the_library_that_mujoco_gl_names(tmp_path: Path) -> None:
    program = (
        "import ctypes.util; ctypes.util.find_library = lambda name: None; import evaluation.lowlevel, mujoco; "
        "print(mujoco.MjModel)"
    )
    result = subprocess.run(
        [sys.executable, "-W", "always", "-c", program],
        env={**os.environ, "MUJOCO_GL": "osmesa"},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert "there is no OSMesa here: no pictures" in result.stderr
