"""``python -m evaluation.gallery``: one picture of what a controller does for a few commands, side by side."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro

from evaluation.baselines.onnx_policy import load_controller
from evaluation.protocols.arena import Arena, constant
from evaluation.protocols.skills import HOLDING_ARMS
from evaluation.reporting.reports import check_output
from highlevel.pictures.painter import Painter, film_strip, following_camera, save_picture
from highlevel.pictures.visuals import VisualTwin
from highlevel.registry import find_controller
from lowlevel.commands import ARMS, HEIGHT, TORSO, VELOCITY
from lowlevel.control.whole_body import Supports, WholeBodyController
from lowlevel.runs.command_line import command_line
from lowlevel.world.terrain import TerrainConfig
from robots.errors import PilotError

DURATION = 5.0
"""How long a command lasts until the picture is taken [s]."""


@dataclass(frozen=True)
class Pose:
    """A command; what is not said is neutral."""

    name: str
    forward: float = 0.0
    """[m/s]"""
    yaw_rate: float = 0.0
    """[rad/s]"""
    height: float | None = None
    """[m]"""
    pitch: float = 0.0
    """[rad]"""
    yaw: float = 0.0
    """[rad]"""
    holds: bool = False
    """Arms as if they held a box."""


POSES = (
    Pose("standing"),
    Pose("walking at 0.5 m/s", forward=0.5),
    Pose("in a curve at 0.9 m/s and 0.7 rad/s", forward=0.9, yaw_rate=0.7),
    Pose("walking with the arms held out at a height of 0.68 m", forward=0.4, height=0.68, holds=True),
    Pose("torso turned by 0.6 rad at 0.6 m", height=0.6, yaw=0.6, holds=True),
    Pose("bent to 1.2 rad at 0.38 m", height=0.38, pitch=1.2),
)


@dataclass(frozen=True)
class Arguments:
    """Draw a controller in a few commands, on slabs of up to 4 cm."""

    controller: Path | None = None
    """Its folder, pilot-g1-simple by default, or the ONNX file of somebody else's policy that has a card."""
    output: Path = Path("runs/controller.png")
    """The picture; one of that name is replaced."""
    seed: int = 0
    """Of friction, start and observation noise."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``python -m evaluation.gallery``."""
    parsed = tyro.cli(Arguments, args=arguments)
    with command_line("evaluation.gallery", "interrupted, nothing was written"):
        _run(parsed)


def _run(arguments: Arguments) -> None:
    torch.set_num_threads(1)
    controller = arguments.controller or find_controller(None)
    if arguments.output.is_dir():
        raise PilotError(f"--output is the picture, but {arguments.output} is a folder: name a file in it")
    check_output(arguments.output.parent)
    pixels, fallen = draw(load_controller(controller)[1], arguments.seed)
    if fallen:
        raise PilotError(f"the robot falls when told {fallen[0]!r}: there is nothing to draw")
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    save_picture(arguments.output, pixels)
    print(f"{arguments.output}: {', '.join(pose.name for pose in POSES)}")


def draw(
    controller: WholeBodyController, seed: int, supports: Supports | None = None, tile: str = "slabs"
) -> tuple[np.ndarray, list[str]]:
    """One strip with a picture of each of :data:`POSES`, left to right, and the names of those in which it has fallen.

    Commands are cut to ``supports``, by default what the controller can be told.

    Raises:
        NoOpenGLError: if this machine cannot render.
    """
    arena = Arena(controller, TerrainConfig(tiles=(tile,)), batch=len(POSES), supports=supports)
    neutral = arena.space.neutral()
    episodes = [constant(seed, DURATION, _command(pose, neutral), flag=1.0) for pose in POSES]
    down = torch.zeros(len(POSES), dtype=torch.bool)
    for moment in arena.run(episodes):
        down |= moment.fell | moment.failed
    twin = VisualTwin(arena.world.terrain.add_to)
    pictures = []
    with Painter(twin.model) as painter:
        for row in range(len(POSES)):
            twin.follow(arena.simulation, row)
            mujoco.mj_forward(twin.model, twin.data)
            pictures.append(painter.draw(twin.data, following_camera(twin.model, twin.data)))
    return film_strip(pictures), [pose.name for pose, fell in zip(POSES, down.tolist(), strict=True) if fell]


def _command(pose: Pose, neutral: torch.Tensor) -> torch.Tensor:
    """The command (21,) of ``pose``."""
    command = neutral.clone()
    command[VELOCITY] = torch.tensor([pose.forward, 0.0, pose.yaw_rate])
    if pose.height is not None:
        command[HEIGHT] = pose.height
    command[TORSO] = torch.tensor([0.0, pose.pitch, pose.yaw])
    if pose.holds:
        command[ARMS] = torch.tensor(HOLDING_ARMS, dtype=torch.float32)
    return command


if __name__ == "__main__":
    main(sys.argv[1:])
