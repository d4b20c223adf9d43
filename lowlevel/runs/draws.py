"""Random numbers that depend on nothing but seed, episode and purpose.

An episode is identified by its number. Its draws do not depend on how many robots run side by side, on which
of them runs it, or on what was drawn before, so a list of numbered episodes is the same for every planner.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from robots.errors import PilotError

MOST_SEED = 2**63 - 1
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def _mix(values: np.ndarray) -> np.ndarray:
    """SplitMix64's finalizer: a bijection of 64-bit integers that scatters neighboring inputs."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def require_seed(seed: int) -> None:
    """Check that ``seed`` is one for every generator here.

    Raises:
        PilotError: if it is negative or above MOST_SEED.
    """
    if not 0 <= seed <= MOST_SEED:
        raise PilotError(f"the seed is {seed}, but it must be between 0 and 2^63 - 1")


def uniform(seed: int, episode: Tensor, stream: int, count: int) -> Tensor:
    """Numbers in [0, 1), (n, ``count``) float32, for episodes ``episode`` (n,).

    Args:
        seed: seed of the whole experiment, not negative.
        episode: episode numbers, not negative.
        stream: what the numbers are for; other streams are independent.
        count: numbers per episode.

    Raises:
        PilotError: if the seed is negative or above MOST_SEED.
    """
    require_seed(seed)
    with np.errstate(over="ignore"):
        key = _mix(np.array([seed], dtype=np.uint64) + _GOLDEN)
        key = _mix(key + np.uint64(stream) * _GOLDEN)
        key = _mix(key + episode.cpu().numpy().astype(np.uint64) * _GOLDEN)
        bits = _mix(key[:, None] + np.arange(1, count + 1, dtype=np.uint64) * _GOLDEN)
    return torch.from_numpy(((bits >> np.uint64(40)).astype(np.float64) * 2.0**-24).astype(np.float32))
