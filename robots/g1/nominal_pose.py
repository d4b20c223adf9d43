"""Nominal poses: for every torso posture, leg and waist joints that hold it in balance on two flat feet.

A posture is (h, roll, pitch, yaw): height of the pelvis above the soles [m] and attitude of ``torso_link`` in
the heading frame [rad], R = Rz(yaw) Ry(pitch) Rx(roll). :class:`NominalPose` interpolates a table that
:mod:`robots.g1.nominal_pose_solver` computes, and says which postures can be held at all.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from robots.errors import PilotError

PATH = Path(__file__).with_name("nominal_pose.npz")
"""The table shipped with the package."""

NUM_LOWER_JOINTS = 15


class NominalStance(NamedTuple):
    """What the table holds for N postures."""

    position: Tensor
    """Leg and waist joints (N, 15) [rad]."""
    torque: Tensor
    """What holds them against gravity with the weight on both feet (N, 15) [N m]: PD targets of position +
    torque / stiffness do not sag."""


@dataclass(frozen=True)
class Axis:
    """A uniform grid axis of ``size`` >= 2 nodes from ``start`` to ``stop``."""

    start: float
    stop: float
    size: int

    @property
    def step(self) -> float:
        """Distance between neighboring nodes."""
        return (self.stop - self.start) / (self.size - 1)


class GridTable:
    """Multilinear interpolation in a table over a grid of D axes; points outside are moved to the grid's border."""

    def __init__(self, axes: Sequence[Axis], values: Tensor) -> None:
        """``values`` (A * B * ..., C): C numbers for every node of the grid, in row-major order."""

        def row(numbers: Sequence[float]) -> Tensor:
            return torch.tensor(numbers, dtype=torch.float32, device=values.device)

        sizes = [axis.size for axis in axes]
        strides = [math.prod(sizes[i + 1 :]) for i in range(len(sizes))]
        self.values = values
        self._start, self._step = row([axis.start for axis in axes]), row([axis.step for axis in axes])
        self._last_node, self._last_cell = row([size - 1.0 for size in sizes]), row([size - 2.0 for size in sizes])
        self._first_node = torch.zeros_like(self._last_node)
        self._strides = row(strides)
        corners = torch.cartesian_prod(*[torch.arange(2.0, device=values.device)] * len(sizes))
        self._corner_index = (corners @ self._strides).long()
        # A corner's share along an axis is the fraction or one minus it: bias + slope * fraction.
        self._bias, self._slope = 1.0 - corners, 2.0 * corners - 1.0

    def __call__(self, point: Tensor) -> Tensor:
        """Interpolate at ``point`` (N, D), giving (N, C): the 2^D corners around each point are weighted and summed."""
        scaled = ((point - self._start) / self._step).clamp(self._first_node, self._last_node)
        below = torch.minimum(scaled.floor(), self._last_cell)
        fraction = (scaled - below).unsqueeze(1)
        weight = torch.addcmul(self._bias, self._slope, fraction).prod(dim=2)
        index = (below @ self._strides).long().unsqueeze(1) + self._corner_index
        return torch.bmm(weight.unsqueeze(1), functional.embedding(index, self.values)).squeeze(1)


class NominalPose:
    """The table on one device: stances, and the limits of the postures that can be held."""

    def __init__(
        self, axes: tuple[Axis, Axis, Axis, Axis], values: Tensor, roll_limit: Tensor, pitch_limits: Tensor
    ) -> None:
        """``axes``: height [m], roll, pitch, yaw [rad] of the posture grid.

        ``values`` (nodes, 30): joint positions [rad] and static gravity torques [N m] of the 15 leg and waist joints.
        ``roll_limit`` (nodes of height x |yaw|, 1) and ``pitch_limits`` (nodes of
        height x |roll| x |yaw|, 2) bound the postures that can be held [rad].
        """
        self.axes, self.values, self.roll_limit, self.pitch_limits = axes, values, roll_limit, pitch_limits
        height, roll, _, yaw = axes
        half_roll, half_yaw = (Axis(0.0, axis.stop, axis.size // 2 + 1) for axis in (roll, yaw))
        self._stance = GridTable(axes, values)
        self._roll_limit = GridTable((height, half_yaw), roll_limit)
        self._pitch_limits = GridTable((height, half_roll, half_yaw), pitch_limits)
        self._lowest = torch.tensor([axis.start for axis in axes], device=values.device)
        self._highest = torch.tensor([axis.stop for axis in axes], device=values.device)

    @classmethod
    def load(cls, device: str | torch.device = "cpu", path: Path = PATH) -> NominalPose:
        """Read the table.

        Raises:
            PilotError: if there is no file at ``path``.
            PilotError: if the file is not a nominal-pose table.
        """
        remedy = "regenerate it with 'python -m robots.g1.nominal_pose_solver'"
        if not path.is_file():
            raise PilotError(f"the nominal-pose table {path} is missing: {remedy}")
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            height, roll, pitch, yaw = (arrays[name] for name in ("height", "roll", "pitch", "yaw"))
            grid = (len(height), len(roll), len(pitch), len(yaw))
            half = (len(height), len(roll) // 2 + 1, len(yaw) // 2 + 1)
            nodes = int(np.prod(grid))
            columns = [arrays[name].reshape(nodes, -1) for name in ("positions", "torques")]
            values = np.concatenate(columns, axis=-1).reshape(nodes, 2 * NUM_LOWER_JOINTS)
            roll_limit = arrays["roll_limit"].reshape(half[0] * half[2], 1)
            pitch_limits = arrays["pitch_limits"].reshape(int(np.prod(half)), 2)
        except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise PilotError(f"{path} is not a nominal-pose table ({error}): {remedy}") from error

        def tensor(array: np.ndarray) -> Tensor:
            if not np.isfinite(array).all():
                raise PilotError(f"the nominal-pose table {path} holds numbers that are not finite: {remedy}")
            return torch.as_tensor(array, dtype=torch.float32, device=device)

        axes = tuple(Axis(float(axis[0]), float(axis[-1]), len(axis)) for axis in (height, roll, pitch, yaw))
        return cls(axes, tensor(values), tensor(roll_limit), tensor(pitch_limits))  # type: ignore[arg-type]

    def lookup(self, posture: Tensor) -> NominalStance:
        """The stance for each ``posture`` (N, 4); postures outside the grid are moved to its border."""
        values = self._stance(posture)
        return NominalStance(*values.split(NUM_LOWER_JOINTS, dim=1))

    def clamp(self, posture: Tensor) -> Tensor:
        """Move ``posture`` (N, 4) into the region that can be held: the one feasibility rule for commands.

        Height and yaw keep to their ranges, roll to a limit that depends on both, and pitch to limits that
        depend on all three. Postures inside stay exactly as they are, so clamping twice changes nothing.
        """
        height, roll, pitch, yaw = posture.clamp(self._lowest, self._highest).unbind(1)
        limit = self._roll_limit(torch.stack([height, yaw.abs()], dim=1))[:, 0]
        roll = roll.clamp(-limit, limit)
        lower, upper = self._pitch_limits(torch.stack([height, roll.abs(), yaw.abs()], dim=1)).unbind(1)
        return torch.stack([height, roll, pitch.clamp(lower, upper), yaw], dim=1)
