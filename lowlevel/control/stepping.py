"""When a robot that is told to stand must step.

Feet that stay where they are hold a push of some 0.3 m/s. A robot that is pushed harder must step, and its policy knows
how to; but its gait clock rests. The clock runs for two steps when the pelvis moves fast.
"""

from __future__ import annotations

import torch
from torch import Tensor

LARGEST_SPEED = 0.25
"""Horizontal speed of the pelvis at which a robot steps [m/s]. At rest 99.9 % of the steps are slower, while it
bends 90 %."""


def swing_first(velocity: Tensor) -> Tensor:
    """The foot to swing first (N,): 1 left, -1 right, 0 none, for pelvis ``velocity`` (N, >= 2) [m/s], heading frame.

    A robot that moves to its right slows down over the right foot, and the left one is free.
    """
    moves = velocity[:, :2].norm(dim=1) > LARGEST_SPEED
    return torch.where(velocity[:, 1] < 0.0, 1.0, -1.0) * moves
