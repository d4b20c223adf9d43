"""Counter-based draws: independent of batch and order, and uniform."""

from __future__ import annotations

import numpy as np
import torch

from lowlevel.runs.draws import uniform


def test_a_draw_depends_on_seed_episode_stream_and_position_only() -> None:
    together = uniform(7, torch.tensor([3, 11, 5]), 2, 6)
    alone = uniform(7, torch.tensor([11]), 2, 9)
    torch.testing.assert_close(together[1], alone[0, :6], rtol=0, atol=0)
    for other in (
        uniform(8, torch.tensor([11]), 2, 6),
        uniform(7, torch.tensor([12]), 2, 6),
        uniform(7, torch.tensor([11]), 3, 6),
    ):
        assert not torch.equal(other[0], alone[0, :6])


def test_draws_are_uniform_and_uncorrelated() -> None:
    numbers = uniform(0, torch.arange(20_000), 1, 8).numpy()
    assert numbers.min() >= 0.0 and numbers.max() < 1.0
    for column in numbers.T:
        counts, _ = np.histogram(column, bins=10, range=(0.0, 1.0))
        # Chi-squared with 9 degrees of freedom: 99.9 % lie below 27.9.
        assert ((counts - 2000) ** 2 / 2000).sum() < 27.9
    correlation = np.corrcoef(numbers.T) - np.eye(8)
    assert np.abs(correlation).max() < 0.03
    assert abs(np.corrcoef(numbers[:-1, 0], numbers[1:, 0])[0, 1]) < 0.03
