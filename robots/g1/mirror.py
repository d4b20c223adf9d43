"""Left-right mirroring of joint vectors: the symmetry of the robot about its sagittal (x-z) plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robots.g1.constants import ARM_JOINTS, JOINT_NAMES, LOWER_JOINTS


@dataclass(frozen=True)
class Mirror:
    """A signed permutation: ``mirrored[i] = sign[i] * original[index[i]]`` along the last axis.

    ``index`` (D,) integers and ``sign`` (D,) of +1 or -1. Applying it twice is the identity.
    """

    index: np.ndarray
    sign: np.ndarray

    def __post_init__(self) -> None:
        if self.index.shape != self.sign.shape:
            raise ValueError(f"index has shape {self.index.shape} but sign has shape {self.sign.shape}")

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Mirror ``values`` (..., D)."""
        return values[..., self.index] * self.sign

    def repeated(self, times: int) -> Mirror:
        """The mirror of ``times`` concatenated copies of the vector, such as a history of frames."""
        size = len(self.index)
        index = (np.arange(times)[:, None] * size + self.index[None, :]).reshape(-1)
        return Mirror(index, np.tile(self.sign, times))


def signs(*values: float) -> Mirror:
    """A mirror that flips signs and moves nothing, one sign per component."""
    return Mirror(np.arange(len(values)), np.array(values, dtype=float))


VECTOR = signs(1, -1, 1)
"""Polar vectors: positions, linear velocities, forces, gravity."""
AXIAL_VECTOR = signs(-1, 1, -1)
"""Axial vectors: angular velocities, torques."""
PAIR = Mirror(np.array([1, 0]), np.ones(2))
"""One number for the left and one for the right."""
PAIR_OF_VECTORS = Mirror(np.array([3, 4, 5, 0, 1, 2]), np.tile(VECTOR.sign, 2))
"""A polar vector for the left and one for the right."""


def concatenate(*mirrors: Mirror) -> Mirror:
    """The mirror of the concatenation of the vectors that ``mirrors`` act on."""
    offsets = np.cumsum([0, *(len(mirror.index) for mirror in mirrors[:-1])])
    index = np.concatenate([mirror.index + offset for mirror, offset in zip(mirrors, offsets, strict=True)])
    return Mirror(index, np.concatenate([mirror.sign for mirror in mirrors]))


def _partner(name: str) -> str:
    if name.startswith("left_"):
        return name.replace("left_", "right_", 1)
    if name.startswith("right_"):
        return name.replace("right_", "left_", 1)
    return name


def _joint_mirror(names: tuple[str, ...]) -> Mirror:
    # Pitch axes are normal to the sagittal plane and keep their sign; roll and yaw axes lie in it and flip.
    pitch_like = ("pitch", "knee", "elbow")
    index = np.array([names.index(_partner(name)) for name in names])
    sign = np.array([1.0 if any(word in name for word in pitch_like) else -1.0 for name in names])
    return Mirror(index, sign)


JOINTS_MIRROR = _joint_mirror(JOINT_NAMES)
"""Mirror of a 29-joint vector."""
LOWER_MIRROR = _joint_mirror(JOINT_NAMES[LOWER_JOINTS])
"""Mirror of the 15 leg and waist joints."""
ARMS_MIRROR = _joint_mirror(JOINT_NAMES[ARM_JOINTS])
"""Mirror of the 14 arm joints."""


def both_arms(left: Sequence[float]) -> np.ndarray:
    """Arm joints (14,) whose left seven are ``left`` and whose right seven are its mirror image."""
    alone = np.concatenate([left, np.zeros(len(left))])
    return alone + ARMS_MIRROR(alone)
