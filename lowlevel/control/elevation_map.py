"""Geometry of the egocentric elevation map that policy, critic and controller see (paper III-A-1)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from robots.g1.mirror import Mirror

MAP_CELLS = 11
"""Cells per side."""
MAP_RESOLUTION = 0.1
"""Cell size [m]."""
MAP_SIZE = MAP_CELLS * MAP_CELLS

_cells = np.arange(MAP_SIZE).reshape(MAP_CELLS, MAP_CELLS)
MAP_MIRROR = Mirror(_cells[:, ::-1].reshape(-1), np.ones(MAP_SIZE))
"""Left-right mirror of a flattened map, rows along x and columns along y."""


def map_points(device: torch.device | str = "cpu") -> Tensor:
    """Centers of the cells (MAP_SIZE, 2) [m] in the heading frame, relative to the base."""
    line = (torch.arange(MAP_CELLS, device=device) - MAP_CELLS // 2) * MAP_RESOLUTION
    return torch.stack(torch.meshgrid(line, line, indexing="ij"), -1).reshape(MAP_SIZE, 2)
