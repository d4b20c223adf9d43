from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from rerun.chunk import Chunk, RrdReader

from evaluation.pictures.recording import EpisodeRecording, Recorder, map_points, measured_posture
from evaluation.protocols.arena import Arena, constant
from highlevel.pictures.visuals import VisualTwin
from lowlevel.control.controller import Controller
from lowlevel.world.terrain import TerrainConfig
from robots.errors import PilotError
from robots.g1.constants import HAND_BODIES


@pytest.fixture(scope="module")
def arena(untrained_controller: Path) -> Arena:
    terrain = TerrainConfig(tiles=("slabs",), tile_size=4.0)
    return Arena(Controller.load(untrained_controller), terrain, num_threads=1, batch=1)


@pytest.fixture(scope="module")
def twin(arena: Arena) -> VisualTwin:
    return VisualTwin(arena.world.terrain.add_to)


def by_entity(path: Path) -> dict[str, list[Chunk]]:
    chunks: dict[str, list[Chunk]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        chunks.setdefault(chunk.entity_path.lstrip("/"), []).append(chunk)
    return chunks


def column(chunks: list[Chunk], name: str) -> list:
    """All values of the component whose column name ends in ``name``, static chunks left out."""
    values = []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        for field in batch.schema.names:
            if field.endswith(name) and not chunk.is_static:
                values += batch.column(field).to_pylist()
    return values


def test_an_episode_can_be_read_back(arena: Arena, twin: VisualTwin, tmp_path: Path) -> None:
    command = arena.controller.command_space.neutral()
    path = tmp_path / "episode.rrd"
    hand = HAND_BODIES[0]
    places, commanded = [], []
    with Recorder(path) as recorder:
        recording = EpisodeRecording(recorder, twin, experts=4)
        for moment in arena.run([constant(0, 0.1, command, flag=1.0)]):
            recording.add(
                time=(moment.step + 1) * arena.period,
                simulation=arena.simulation,
                row=0,
                measured=moment.measured,
                command=moment.command,
                gate=moment.gate,
                elevation=moment.elevation,
                stage="first" if moment.step < 3 else "second",
            )
            places.append(twin.data.body(hand).xpos.copy())
            commanded.append(moment.command[0, 3].item())
        assert not path.exists(), "the file must not appear before it is complete"
    chunks = by_entity(path)
    translations = [row[0] for row in column(chunks[f"world/{hand}"], "translation")]
    np.testing.assert_allclose(translations, places, atol=1e-5)
    assert any(chunk.is_static for name, group in chunks.items() if "mesh_" in name for chunk in group)
    heights = column(chunks["tracking/base_height"], "scalars")
    np.testing.assert_allclose([row[0] for row in heights], commanded, atol=1e-5)
    np.testing.assert_allclose(np.sum(column(chunks["experts"], "scalars"), axis=1), 1.0, atol=1e-5)
    assert len(column(chunks["world/elevation"], "positions")[0]) == 121
    assert [row[0] for row in column(chunks["stage"], "text")] == ["first", "second"]
    assert [file.name for file in tmp_path.iterdir()] == ["episode.rrd"]


def test_a_failure_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), Recorder(tmp_path / "episode.rrd") as recorder:
        recorder.set_time(0.0)
        recorder.show_text("stage", "never to be seen")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_live_view_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ValueError, match="needs a display"):
        Recorder(None, live=True)


def test_the_twin_has_the_simulated_pose_and_sizes(arena: Arena, twin: VisualTwin) -> None:
    (moment,) = list(arena.run([constant(0, 0.02, arena.controller.command_space.neutral(), flag=1.0)]))
    twin.adopt_sizes(arena.simulation, 0)
    twin.follow(arena.simulation, 0)
    np.testing.assert_allclose(twin.data.body("pelvis").xpos, moment.measured.robot.base_position[0], atol=1e-6)
    simulated = arena.simulation.robot_model(0)
    np.testing.assert_array_equal(twin.model.geom("terrain_3").size, simulated.geom("terrain_3").size)
    assert twin.model.nmesh > 20 and simulated.nmesh == 0


def test_a_twin_of_another_scene_is_refused(arena: Arena) -> None:
    def add_box(spec: mujoco.MjSpec) -> None:
        body = spec.worldbody.add_body(name="crate", pos=[1, 0, 1])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1])

    with pytest.raises(ValueError, match="add the same objects to both"):
        VisualTwin(add_box).follow(arena.simulation, 0)


def test_map_points_lie_on_the_ground(arena: Arena) -> None:
    neutral = arena.controller.command_space.neutral()
    (moment,) = list(arena.run([constant(1, 0.02, neutral, flag=1.0)]))
    measured = moment.measured
    exact = arena.world.elevation(measured)
    points = map_points(measured, exact)[0]
    ground = arena.world.terrain.height(points[:, :2])
    assert ground.max() > 0.01
    np.testing.assert_allclose(points[:, 2], ground, atol=1e-5)
    center = points[60]
    np.testing.assert_allclose(center[:2], measured.robot.base_position[0, :2], atol=1e-5)
    ahead = points[115, :2] - center[:2]
    yaw = measured.heading[0]
    np.testing.assert_allclose(ahead, 0.5 * torch.stack([torch.cos(yaw), torch.sin(yaw)]), atol=1e-5)


def test_measured_posture_inverts_the_command_convention(arena: Arena) -> None:
    """R = Rz(yaw) Ry(pitch) Rx(roll), built here from matrices."""
    from dataclasses import replace

    neutral = arena.controller.command_space.neutral()
    (moment,) = list(arena.run([constant(1, 0.02, neutral, flag=1.0)]))
    roll, pitch, yaw = 0.3, 1.2, -0.7

    def turn(axis: int, angle: float) -> np.ndarray:
        matrix, (i, j) = np.eye(3), [(1, 2), (2, 0), (0, 1)][axis]
        matrix[i, i] = matrix[j, j] = np.cos(angle)
        matrix[j, i], matrix[i, j] = np.sin(angle), -np.sin(angle)
        return matrix

    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, (turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)).flatten())
    measured = replace(moment.measured, torso_orientation=torch.tensor(quaternion[None], dtype=torch.float32))
    np.testing.assert_allclose(measured_posture(measured)[0, 4:7], [roll, pitch, yaw], atol=1e-5)


@pytest.mark.parametrize("fails", ["spawn", "flush"])
def test_a_viewer_that_is_missing_or_does_not_answer_is_named(fails: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise RuntimeError("Failed to find Rerun Viewer executable in PATH.\n\nYou can install it.")

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr("rerun.RecordingStream.spawn", lambda stream: None)
    monkeypatch.setattr(f"rerun.RecordingStream.{fails}", fail)
    with pytest.raises(
        PilotError, match=r"^no live view \(Failed to find Rerun Viewer executable in PATH\): leave out"
    ):
        Recorder(None, live=True)
