"""Pictures of given instants, rendered without a display. Nothing but pictures depends on OpenGL."""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import mujoco
import numpy as np
from matplotlib.image import imsave

from lowlevel.runs.files import atomic_write
from robots.errors import PilotError
from robots.g1.constants import PELVIS_BODY

PLATFORMS = ("egl", "osmesa")
"""OpenGL platforms that need no display: on a GPU or Mesa, preferred, and in software."""
_PROBE_SECONDS = 60.0


class NoOpenGLError(PilotError):
    """Pictures cannot be rendered on this machine; the message says what to install."""


class _Context(Protocol):
    def make_current(self) -> None: ...

    def free(self) -> None: ...


@functools.cache
def find_platform() -> str:
    """The first of :data:`PLATFORMS` that works here, or the one that MUJOCO_GL names if it works.

    Each is tried in a process of its own, because one that fails spoils its process for the next.

    Raises:
        NoOpenGLError: if none does.
    """
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    candidates = (wanted,) if wanted in PLATFORMS else PLATFORMS
    for platform in candidates:
        program = f"from mujoco.{platform} import GLContext; c = GLContext(8, 8); c.make_current(); c.free()"
        environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
        try:
            probe = subprocess.run(
                [sys.executable, "-c", program],
                env=environment | {"MUJOCO_GL": platform},
                capture_output=True,
                timeout=_PROBE_SECONDS,
            )
        except subprocess.TimeoutExpired:
            continue
        if probe.returncode == 0:
            return platform
    raise NoOpenGLError(
        f"no pictures: OpenGL without a display does not work here (tried {', '.join(candidates)}); install "
        "libegl1 and libgl1-mesa-dri, or libosmesa6"
    )


def _create_context(width: int, height: int) -> _Context:
    platform = find_platform()
    os.environ["PYOPENGL_PLATFORM"] = platform
    module: Any = importlib.import_module(f"mujoco.{platform}")
    context: _Context = module.GLContext(width, height)
    context.make_current()
    return context


class Painter:
    """Renders one model. A context manager: OpenGL's resources are freed at the end of the block.

    Args:
        model: what to draw.
        width: of the pictures, in pixels.
        height: of the pictures, in pixels.

    Raises:
        NoOpenGLError: if this machine cannot render.
    """

    def __init__(self, model: mujoco.MjModel, width: int = 960, height: int = 720) -> None:
        self.model = model
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
        model.vis.global_.offheight = max(height, model.vis.global_.offheight)
        self._context = _create_context(width, height)
        self._renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)
        self._scene = mujoco.MjvScene(model, maxgeom=20000)
        self._options = mujoco.MjvOption()

    def __enter__(self) -> Painter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free OpenGL's resources."""
        self._context.make_current()
        self._renderer.free()
        self._context.free()

    def draw(self, data: mujoco.MjData, camera: mujoco.MjvCamera) -> np.ndarray:
        """The scene as ``camera`` sees it (height, width, 3), 8 bits per color."""
        self._context.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, data, self._options, None, camera, every, self._scene)
        mujoco.mjr_render(self._viewport, self._scene, self._renderer)
        pixels = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._viewport, self._renderer)
        return pixels[::-1]  # OpenGL's first row is the lowest


def following_camera(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body: str = PELVIS_BODY,
    distance: float = 2.6,
    azimuth: float = 140.0,
    elevation: float = -15.0,
) -> mujoco.MjvCamera:
    """A camera that looks at ``body`` and turns with its heading.

    Args:
        model: the scene.
        data: its pose.
        body: what to look at.
        distance: from it [m].
        azimuth: of the line of sight, from the body's heading [degrees]; 180 looks at its face.
        elevation: of the line of sight [degrees], negative from above.
    """
    number = model.body(body).id
    rotation = data.xmat[number].reshape(3, 3)
    heading = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))
    camera = mujoco.MjvCamera()
    camera.lookat[:] = data.xpos[number] + np.array([0.0, 0.0, -0.05])
    camera.distance, camera.elevation = distance, elevation
    camera.azimuth = heading + azimuth
    return camera


def film_strip(pictures: Sequence[np.ndarray], width: int = 240, height: int = 320) -> np.ndarray:
    """``pictures`` (H, W, 3) next to each other (height, len * width, 3), each cut to its middle and scaled down.

    ``width`` and ``height`` are those of each part [pixels].

    Raises:
        ValueError: if there are none, or one is smaller than what it is to become.
    """
    if not pictures:
        raise ValueError("a film strip needs at least one picture")
    parts = []
    for pixels in pictures:
        rows, columns = pixels.shape[:2]
        scale = min(rows // height, columns // width)
        if scale < 1:
            raise ValueError(f"a picture of {columns} x {rows} pixels cannot be scaled down to {width} x {height}")
        top, left = (rows - scale * height) // 2, (columns - scale * width) // 2
        cut = pixels[top : top + scale * height, left : left + scale * width]
        parts.append(cut.reshape(height, scale, width, scale, 3).mean(axis=(1, 3)).round().astype(np.uint8))
    return np.hstack(parts)


def save_picture(path: Path, pixels: np.ndarray) -> None:
    """Write ``pixels`` (height, width, 3) as PNG."""
    atomic_write(path, lambda file: imsave(file, pixels, format="png"))
