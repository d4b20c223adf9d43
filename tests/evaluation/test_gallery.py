from __future__ import annotations

from pathlib import Path

import matplotlib.image
import pytest

from evaluation import gallery


def test_a_robot_that_falls_is_not_drawn(untrained_controller: Path, tmp_path: Path) -> None:
    output = tmp_path / "poses.png"
    with pytest.raises(SystemExit) as stop:
        gallery.main(["--controller", str(untrained_controller), "--output", str(output)])
    assert "the robot falls when told" in str(stop.value) and "\n" not in str(stop.value)
    assert not output.exists()
    with pytest.raises(SystemExit, match=f"{tmp_path} is a folder: name a file in it"):
        gallery.main(["--controller", str(untrained_controller), "--output", str(tmp_path)])


def test_every_pose_gets_its_part_of_the_picture(
    untrained_controller: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_opengl: bool
) -> None:
    if not has_opengl:
        pytest.skip("this machine cannot render")
    monkeypatch.setattr(gallery, "DURATION", 0.1)
    output = tmp_path / "new" / "poses.png"
    gallery.main(["--controller", str(untrained_controller), "--output", str(output)])
    pixels = matplotlib.image.imread(output)
    width = pixels.shape[1] // len(gallery.POSES)
    assert pixels.shape[:2] == (320, 240 * len(gallery.POSES))
    parts = [pixels[:, number * width : (number + 1) * width] for number in range(len(gallery.POSES))]
    assert all(part.std() > 0.05 for part in parts)
