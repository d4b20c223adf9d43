from __future__ import annotations

import subprocess
from pathlib import Path

import matplotlib.image
import mujoco
import numpy as np
import pytest

from highlevel.pictures import painter as pictures
from highlevel.pictures.painter import (
    NoOpenGLError,
    Painter,
    film_strip,
    find_platform,
    following_camera,
    save_picture,
)
from highlevel.pictures.visuals import VisualTwin


@pytest.fixture(scope="module")
def twin() -> VisualTwin:
    twin = VisualTwin()
    twin.data.qpos[:3] = [1.0, 2.0, 0.78]
    twin.data.qpos[3:7] = [1.0, 0.0, 0.0, 0.0]
    mujoco.mj_forward(twin.model, twin.data)
    return twin


def test_the_camera_follows_position_and_heading(twin: VisualTwin) -> None:
    camera = following_camera(twin.model, twin.data, azimuth=180.0)
    np.testing.assert_allclose(camera.lookat[:2], [1.0, 2.0])
    turned = mujoco.MjData(twin.model)
    turned.qpos[:] = twin.data.qpos
    turned.qpos[3:7] = [np.cos(0.5), 0.0, 0.0, np.sin(0.5)]
    mujoco.mj_forward(twin.model, turned)
    after = following_camera(twin.model, turned, azimuth=180.0)
    assert after.azimuth - camera.azimuth == pytest.approx(np.degrees(1.0), abs=1e-3)


def test_without_opengl_there_is_one_clear_sentence(monkeypatch: pytest.MonkeyPatch, twin: VisualTwin) -> None:
    def refuse(command: list[str], **options: object) -> subprocess.CompletedProcess:
        return subprocess.CompletedProcess(command, returncode=1)

    monkeypatch.setattr(pictures.subprocess, "run", refuse)
    find_platform.cache_clear()
    try:
        with pytest.raises(NoOpenGLError, match="install libegl1 and libgl1-mesa-dri, or libosmesa6") as failure:
            Painter(twin.model)
        assert "\n" not in str(failure.value)
    finally:
        find_platform.cache_clear()


def test_a_picture_shows_the_robot_in_front_of_the_camera(twin: VisualTwin, tmp_path: Path, has_opengl: bool) -> None:
    if not has_opengl:
        pytest.skip("this machine cannot render")
    path = tmp_path / "picture.png"
    with Painter(twin.model, width=160, height=120) as painter:
        camera = following_camera(twin.model, twin.data)
        pixels = painter.draw(twin.data, camera)
        save_picture(path, pixels)
        away = mujoco.MjData(twin.model)
        away.qpos[:] = twin.data.qpos
        away.qpos[:3] = [1.0, 2.0, -5.0]
        mujoco.mj_forward(twin.model, away)
        empty = painter.draw(away, camera)
        away.qpos[:3] = [1.0, 2.0, 1.28]
        mujoco.mj_forward(twin.model, away)
        raised = painter.draw(away, camera)
    assert pixels.shape == (120, 160, 3)

    def robot(image: np.ndarray) -> np.ndarray:
        return np.abs(image.astype(int) - empty.astype(int)).sum(axis=2) > 30

    assert robot(pixels)[40:80, 60:100].mean() > 0.1, "the middle of the picture does not show the robot"
    rows = [np.nonzero(robot(image))[0].mean() for image in (pixels, raised)]
    assert rows[1] < rows[0] - 10, "the picture is upside down"
    stored = matplotlib.image.imread(path)
    np.testing.assert_allclose(stored[..., :3], pixels / 255.0, atol=0.01)


def test_a_film_strip_shows_the_middle_of_each_picture() -> None:
    first = np.zeros((70, 100, 3), dtype=np.uint8)
    first[5:65, 30:70] = 200  # the middle 60 x 40
    second = np.full((70, 100, 3), 50, dtype=np.uint8)
    second[5:65:2, 30:70] = 150  # scaled down by two, its rows are averaged
    strip = film_strip([first, second], width=20, height=30)
    assert strip.shape == (30, 40, 3)
    assert (strip[:, :20] == 200).all()
    assert (strip[:, 20:] == 100).all()
    with pytest.raises(ValueError, match="at least one"):
        film_strip([], 20, 30)
    with pytest.raises(ValueError, match="100 x 70 pixels cannot be scaled down to 20 x 90"):
        film_strip([first], 20, 90)
