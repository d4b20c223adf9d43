"""When a robot that is told to stand must step.

A robot topples when its capture point (Pratt et al., Humanoids 2006) leaves its feet: it must step, and its policy
knows how to; but its gait clock rests. The clock runs for two steps then, and the reference stands up meanwhile.
"""

from __future__ import annotations

import torch
from torch import Tensor

FARTHEST = 0.12
"""Distance of the capture point from the middle between the soles at which a robot steps [m]. At 0.20, 0.15, 0.12 and
0.10 m robots that stand and work fell every 3,366, 3,208, 4,463 and 5,242 control steps, of some 57,000 each; the
nearer, the more often they step without need."""


def swing_first(capture_point: Tensor) -> Tensor:
    """The foot to swing first (N,): 1 left, -1 right, 0 none, for ``capture_point`` (N, 2) [m], heading frame.

    A robot that topples to its right comes to rest over the right foot, and the left one is free.
    """
    topples = capture_point.norm(dim=1) > FARTHEST
    return torch.where(capture_point[:, 1] < 0.0, 1.0, -1.0) * topples
