"""Nominal poses: for every torso posture, leg and waist joints that hold it in balance on two flat feet.

A posture is (h, roll, pitch, yaw): height of the pelvis above the soles [m] and attitude of ``torso_link`` in
the heading frame [rad], R = Rz(yaw) Ry(pitch) Rx(roll). :class:`NominalPose` interpolates a table that
:mod:`robots.g1.nominal_pose_solver` computes, and says which postures can be held at all.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

PATH = Path(__file__).with_name("nominal_pose.npz")
"""The table shipped with the package."""

NUM_LOWER_JOINTS = 15
NUM_LEG_JOINTS = 12


class NominalStance(NamedTuple):
    """What the table holds for N postures."""

    position: Tensor
    """Leg and waist joints (N, 15) [rad]."""
    torque: Tensor
    """What holds them against gravity with the weight on both feet (N, 15) [N m]: PD targets of position +
    torque / stiffness do not sag."""
    shift: Tensor
    """Change of the leg joints (N, 12, 2) [rad/m] that moves the pelvis along x and y over the standing feet."""


@dataclass(frozen=True)
class Axis:
    """A uniform grid axis of ``size`` >= 2 nodes from ``start`` to ``stop``."""

    start: float
    stop: float
    size: int

    @property
    def step(self) -> float:
        """Distance between neighbouring nodes."""
        return (self.stop - self.start) / (self.size - 1)


def interpolate(axes: Sequence[Axis], table: Tensor, point: Tensor) -> Tensor:
    """Multilinear interpolation; points outside the grid are moved to its border.

    ``table`` (A * B * ..., C) holds C values for every node of the grid of D ``axes`` in row-major order,
    ``point`` is (N, D); returns (N, C). The 2^D corners around each point are gathered and summed at once.
    """
    index = torch.zeros(len(point), 1, dtype=torch.long, device=point.device)
    weight = torch.ones(len(point), 1, dtype=point.dtype, device=point.device)
    for axis, coordinate in zip(axes, point.unbind(1), strict=True):
        scaled = ((coordinate - axis.start) / axis.step).clamp(0.0, axis.size - 1.0)
        below = scaled.floor().clamp(max=axis.size - 2.0)
        fraction = scaled - below
        corner = torch.stack([below, below + 1.0], dim=1).long()
        share = torch.stack([1.0 - fraction, fraction], dim=1)
        index = (index[:, :, None] * axis.size + corner[:, None, :]).flatten(1)
        weight = (weight[:, :, None] * share[:, None, :]).flatten(1)
    return functional.embedding_bag(index, table, mode="sum", per_sample_weights=weight)


@dataclass(frozen=True)
class NominalPose:
    """The table on one device.

    ``axes``: height [m], roll, pitch, yaw [rad] of the posture grid. ``values`` (nodes, 54): joint positions
    [rad] and static gravity torques [N m] of the 15 leg and waist joints, shift of the 12 leg joints [rad/m].
    ``roll_limit`` (nodes of height x |yaw|, 1) and ``pitch_limits`` (nodes of height x |roll| x |yaw|, 2) bound
    the postures that can be held [rad].
    """

    axes: tuple[Axis, Axis, Axis, Axis]
    values: Tensor
    roll_limit: Tensor
    pitch_limits: Tensor

    @classmethod
    def load(cls, device: str | torch.device = "cpu", path: Path = PATH) -> NominalPose:
        """Read the table.

        Raises:
            FileNotFoundError: if there is no file at ``path``.
            ValueError: if the file is not a nominal-pose table.
        """
        remedy = "regenerate it with 'python -m robots.g1.nominal_pose_solver'"
        if not path.is_file():
            raise FileNotFoundError(f"the nominal-pose table {path} is missing: {remedy}")
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            height, roll, pitch, yaw = (arrays[name] for name in ("height", "roll", "pitch", "yaw"))
            grid = (len(height), len(roll), len(pitch), len(yaw))
            half = (len(height), len(roll) // 2 + 1, len(yaw) // 2 + 1)
            nodes = int(np.prod(grid))
            columns = [arrays[name].reshape(nodes, -1) for name in ("positions", "torques", "shifts")]
            values = np.concatenate(columns, axis=-1).reshape(nodes, 2 * NUM_LOWER_JOINTS + 2 * NUM_LEG_JOINTS)
            roll_limit = arrays["roll_limit"].reshape(half[0] * half[2], 1)
            pitch_limits = arrays["pitch_limits"].reshape(int(np.prod(half)), 2)
        except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} is not a nominal-pose table ({error}): {remedy}") from error

        def tensor(array: np.ndarray) -> Tensor:
            if not np.isfinite(array).all():
                raise ValueError(f"the nominal-pose table {path} holds numbers that are not finite: {remedy}")
            return torch.as_tensor(array, dtype=torch.float32, device=device)

        axes = tuple(Axis(float(axis[0]), float(axis[-1]), len(axis)) for axis in (height, roll, pitch, yaw))
        return cls(axes, tensor(values), tensor(roll_limit), tensor(pitch_limits))  # type: ignore[arg-type]

    def lookup(self, posture: Tensor) -> NominalStance:
        """The stance for each ``posture`` (N, 4); postures outside the grid are moved to its border."""
        values = interpolate(self.axes, self.values, posture)
        position, torque, shift = values.split([NUM_LOWER_JOINTS, NUM_LOWER_JOINTS, 2 * NUM_LEG_JOINTS], dim=1)
        return NominalStance(position, torque, shift.unflatten(1, (NUM_LEG_JOINTS, 2)))

    def clamp(self, posture: Tensor) -> Tensor:
        """Move ``posture`` (N, 4) into the region that can be held: the one feasibility rule for commands.

        Height and yaw keep to their ranges, roll to a limit that depends on both, and pitch to limits that
        depend on all three. Postures inside stay exactly as they are, so clamping twice changes nothing.
        """
        height_axis, roll_axis, _, yaw_axis = self.axes
        half_roll = Axis(0.0, roll_axis.stop, roll_axis.size // 2 + 1)
        half_yaw = Axis(0.0, yaw_axis.stop, yaw_axis.size // 2 + 1)
        height = posture[:, 0].clamp(height_axis.start, height_axis.stop)
        yaw = posture[:, 3].clamp(yaw_axis.start, yaw_axis.stop)
        limit = interpolate((height_axis, half_yaw), self.roll_limit, torch.stack([height, yaw.abs()], dim=1))[:, 0]
        roll = torch.minimum(torch.maximum(posture[:, 1], -limit), limit)
        where = torch.stack([height, roll.abs(), yaw.abs()], dim=1)
        lower, upper = interpolate((height_axis, half_roll, half_yaw), self.pitch_limits, where).unbind(1)
        pitch = torch.minimum(torch.maximum(posture[:, 2], lower), upper)
        return torch.stack([height, roll, pitch, yaw], dim=1)
