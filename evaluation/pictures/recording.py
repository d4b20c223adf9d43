"""Recordings for the rerun viewer. This is the only module that imports rerun.

Geometry is logged once, under the entity of the body that carries it; after that a moment is one transform
per body, a few curves, the elevation map as points, and the stage as text.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import torch
from torch import Tensor

from evaluation.protocols.arena import Arena, Episode
from highlevel.pictures.visuals import VISIBLE_GROUPS, VisualTwin
from lowlevel.commands import ARMS, HEIGHT, TORSO, VELOCITY
from lowlevel.control.elevation_map import MAP_CELLS, MAP_RESOLUTION
from lowlevel.world.measures import Measurement
from lowlevel.world.simulation import BatchSimulation
from robots.errors import PilotError
from robots.g1.constants import ARM_JOINTS, JOINT_NAMES
from robots.rotations import rotate_about_vertical

APPLICATION = "open_pilot"
TIMELINE = "time"
_CURVES = ("vx", "vy", "yaw_rate", "base_height", "torso_roll", "torso_pitch", "torso_yaw")
_ARM_CURVES = tuple(name.removesuffix("_joint") for name in JOINT_NAMES[ARM_JOINTS])
_FLOOR_HALF_SIZE = 15.0


_VIEWER_SECONDS = 5.0
"""How long a viewer may take to answer once it has been started [s]."""


def _open_viewer(stream: rr.RecordingStream) -> None:
    try:
        stream.spawn()
        stream.flush(timeout_sec=_VIEWER_SECONDS)
    except RuntimeError as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise PilotError(f"no live view ({reason}): leave out --live and open the recording") from error


class Recorder:
    """A stream to a file, a viewer, or both. A context manager: the file appears at the end of the block.

    Args:
        path: the ``.rrd`` file, or None. An exception or Ctrl-C in the block leaves no file.
        live: open a viewer and stream to it.

    Raises:
        PilotError: if a viewer is wanted where there is no display or no viewer, or where it does not answer.
    """

    def __init__(self, path: Path | None, live: bool = False) -> None:
        if live and sys.platform.startswith("linux") and not ({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ)):
            raise PilotError("a live view needs a display: leave out --live and open the recording")
        self._path = path
        self._partial = None if path is None else path.with_name(f".{path.name}.partial")
        self.stream = rr.RecordingStream(APPLICATION)
        sinks: list[rr.GrpcSink | rr.FileSink] = []
        if live:
            _open_viewer(self.stream)
            sinks.append(rr.GrpcSink())
        if self._partial is not None:
            sinks.append(rr.FileSink(self._partial))
        if sinks:
            self.stream.set_sinks(*sinks, default_blueprint=_blueprint())

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stream.flush()
        self.stream.disconnect()
        if self._partial is None or self._path is None:
            return
        if kind is None:
            os.replace(self._partial, self._path)
        else:
            self._partial.unlink(missing_ok=True)

    def set_time(self, seconds: float) -> None:
        """Everything logged from now on happened at this time."""
        self.stream.set_time(TIMELINE, duration=seconds)

    def show_scene(self, model: mujoco.MjModel) -> None:
        """Log all visible geometry of ``model`` once.

        Raises:
            PilotError: if a visible geom is neither mesh, box nor plane.
        """
        self.stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for body in range(model.nbody):
            first, count = model.body_geomadr[body], model.body_geomnum[body]
            geoms = [g for g in range(first, first + count) if model.geom_group[g] in VISIBLE_GROUPS]
            boxes = [g for g in geoms if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX]
            if boxes:
                self.stream.log(f"{_entity(model, body)}/boxes", _boxes(model, boxes), static=True)
            for geom in geoms:
                if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                    self.stream.log(f"{_entity(model, body)}/mesh_{geom}", _mesh(model, geom), static=True)
                elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                    self.stream.log(f"{_entity(model, body)}/floor", _floor(), static=True)
                elif geom not in boxes:
                    kind = mujoco.mjtGeom(model.geom_type[geom]).name
                    raise ValueError(f"cannot record geom {model.geom(geom).name!r} of type {kind}")

    def show_pose(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Log where all moving bodies are."""
        for body in range(1, model.nbody):
            if model.body_weldid[body] != 0:
                w, x, y, z = data.xquat[body]
                pose = rr.Transform3D(translation=data.xpos[body], quaternion=rr.Quaternion(xyzw=[x, y, z, w]))
                self.stream.log(_entity(model, body), pose)

    def name_series(self, path: str, names: list[str]) -> None:
        """Give the curves of ``path`` their names; once."""
        self.stream.log(path, rr.SeriesLines(names=names), static=True)

    def show_series(self, path: str, values: np.ndarray) -> None:
        """Log one value for each curve of ``path``."""
        self.stream.log(path, rr.Scalars(values))

    def show_points(self, path: str, points: np.ndarray) -> None:
        """Log points (N, 3) [m], world frame."""
        self.stream.log(path, rr.Points3D(points, radii=0.012, colors=[255, 170, 40]))

    def show_text(self, path: str, text: str) -> None:
        """Log a line of text."""
        self.stream.log(path, rr.TextLog(text))


class EpisodeRecording:
    """Turns the moments of one robot's episode into what a viewer shows.

    Args:
        recorder: where to.
        twin: the scene's visual double; its sizes must be final.
        experts: number of experts of the policy.
    """

    def __init__(self, recorder: Recorder, twin: VisualTwin, experts: int) -> None:
        self._recorder, self._twin = recorder, twin
        self._stage = ""
        recorder.set_time(0.0)
        recorder.show_scene(twin.model)
        for folder, names in (("tracking", _CURVES), ("arms", _ARM_CURVES)):
            for name in names:
                recorder.name_series(f"{folder}/{name}", ["commanded", "measured"])
        recorder.name_series("experts", [f"expert {number + 1}" for number in range(experts)])

    def add(
        self,
        time: float,
        simulation: BatchSimulation,
        row: int,
        measured: Measurement,
        command: Tensor,
        gate: Tensor,
        elevation: Tensor,
        stage: str = "",
    ) -> None:
        """Log one instant of robot ``row``.

        Args:
            time: since the episode began [s].
            simulation: in the state to show.
            row: which robot.
            measured: of all robots.
            command: clamped commands (N, 21).
            gate: expert activations (N, experts).
            elevation: vertical distances base - terrain (N, 121) [m].
            stage: logged when it changes.
        """
        recorder = self._recorder
        recorder.set_time(time)
        self._twin.follow(simulation, row)
        recorder.show_pose(self._twin.model, self._twin.data)
        actual = measured_posture(measured)[row].numpy()
        wanted = command[row].numpy()
        for index, name in enumerate(_CURVES):
            recorder.show_series(f"tracking/{name}", np.array([wanted[index], actual[index]]))
        joints = measured.robot.joint_position[row, ARM_JOINTS].numpy()
        for index, name in enumerate(_ARM_CURVES):
            recorder.show_series(f"arms/{name}", np.array([wanted[ARMS][index], joints[index]]))
        recorder.show_series("experts", gate[row].numpy())
        recorder.show_points("world/elevation", map_points(measured, elevation)[row].numpy())
        if stage != self._stage:
            self._stage = stage
            recorder.show_text("stage", stage)


def record_episodes(arena: Arena, episodes: Sequence[Episode], folder: Path) -> list[Path]:
    """Run a batch of low-level episodes and write one file for each; a repeated episode goes as before."""
    twin = VisualTwin(arena.world.terrain.add_to)
    experts = arena.experts
    paths = [folder / f"episode_{number}.rrd" for number in range(len(episodes))]
    with ExitStack() as stack:
        films = [EpisodeRecording(stack.enter_context(Recorder(path)), twin, experts) for path in paths]
        for moment in arena.run(episodes):
            for row, film in enumerate(films):
                if moment.active[row]:
                    film.add(
                        time=(moment.step + 1) * arena.period,
                        simulation=arena.simulation,
                        row=row,
                        measured=moment.measured,
                        command=moment.command,
                        gate=moment.gate,
                        elevation=moment.elevation,
                        stage="fell" if moment.fell[row] else "",
                    )
    return paths


def measured_posture(measured: Measurement) -> Tensor:
    """What a command asks for, as measured (N, 7): vx, vy, yaw rate, height, torso roll, pitch, yaw."""
    w, x, y, z = measured.torso_orientation.unbind(-1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    posture = torch.zeros(len(w), TORSO.stop)
    posture[:, VELOCITY] = torch.cat([measured.linear_velocity[:, :2], measured.yaw_rate[:, None]], -1)
    posture[:, HEIGHT] = measured.base_height
    posture[:, TORSO] = torch.stack([roll, pitch, yaw], -1)
    return posture


def map_points(measured: Measurement, elevation: Tensor) -> Tensor:
    """The elevation map (N, 121) as points on the ground (N, 121, 3) [m], world frame."""
    line = (torch.arange(MAP_CELLS) - MAP_CELLS // 2) * MAP_RESOLUTION
    offsets = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    base = measured.robot.base_position
    xy = base[:, None, :2] + rotate_about_vertical(measured.heading[:, None], offsets[None])
    return torch.cat([xy, (base[:, 2:] - elevation)[..., None]], -1)


# -- geometry ------------------------------------------------------------------------------------------------


def _entity(model: mujoco.MjModel, body: int) -> str:
    return "world" if body == 0 else f"world/{model.body(body).name}"


def _color(model: mujoco.MjModel, geom: int) -> np.ndarray:
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    return np.round(255 * rgba).astype(np.uint8)


def _boxes(model: mujoco.MjModel, geoms: list[int]) -> rr.Boxes3D:
    return rr.Boxes3D(
        centers=model.geom_pos[geoms],
        half_sizes=model.geom_size[geoms],
        quaternions=model.geom_quat[geoms][:, [1, 2, 3, 0]],
        colors=[_color(model, geom) for geom in geoms],
        fill_mode=rr.components.FillMode.Solid,
    )


def _mesh(model: mujoco.MjModel, geom: int) -> rr.Mesh3D:
    """The geom's mesh in the body's frame, with normals averaged over the faces at each vertex."""
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    first = model.mesh_faceadr[mesh]
    faces = model.mesh_face[first : first + model.mesh_facenum[mesh]]
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    vertices = vertices @ rotation.reshape(3, 3).T + model.geom_pos[geom]
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return rr.Mesh3D(
        vertex_positions=vertices.astype(np.float32),
        triangle_indices=faces,
        vertex_normals=(normals / np.maximum(lengths, 1e-12)).astype(np.float32),
        albedo_factor=_color(model, geom),
    )


def _floor() -> rr.Mesh3D:
    half = _FLOOR_HALF_SIZE
    return rr.Mesh3D(
        vertex_positions=[[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]],
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        vertex_normals=[[0, 0, 1]] * 4,
        albedo_factor=[130, 138, 146, 255],
    )


def _blueprint() -> rrb.Blueprint:
    """Robot on the left; curves, experts and stages on the right."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="world", name="robot"),
            rrb.Vertical(
                rrb.Tabs(
                    *(rrb.TimeSeriesView(origin=f"tracking/{name}", name=name) for name in _CURVES),
                    *(rrb.TimeSeriesView(origin=f"arms/{name}", name=name) for name in _ARM_CURVES),
                ),
                rrb.TimeSeriesView(origin="experts", name="experts"),
                rrb.TextLogView(origin="stage", name="stage"),
            ),
            column_shares=[3, 2],
        ),
        collapse_panels=True,
    )
