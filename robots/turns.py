"""Turns about fixed axes, for many angles at once.

The matrix of a turn is linear in sine and cosine of its angle (Rodrigues): whatever is built from one turn, such as
a joint's transformation, needs three constants and two multiplications.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def turn_basis(axes: Sequence[int]) -> NDArray[np.float64]:
    """Constant, sine and cosine parts (3, K, 3, 3) of turns about K coordinate ``axes``: 0 is x, 1 is y, 2 is z."""
    unit = np.eye(3)[list(axes)]
    along = unit[:, :, None] * unit[:, None, :]
    across = np.cross(unit[:, None, :], np.eye(3)).transpose(0, 2, 1)
    return np.stack([along, across, np.eye(3) - along])


def blend(basis: Tensor, angles: Tensor) -> Tensor:
    """``basis[0] + sin(angles) * basis[1] + cos(angles) * basis[2]`` for angles [rad] that broadcast with a part."""
    return torch.addcmul(torch.addcmul(basis[0], torch.sin(angles), basis[1]), torch.cos(angles), basis[2])
