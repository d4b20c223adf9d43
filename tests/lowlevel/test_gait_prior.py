"""The gait prior's stride comes to fit what is told, whatever the robot makes of it."""

import pytest
import torch

from lowlevel.gait_prior import GaitPrior, GaitPriorConfig


def test_the_stride_comes_to_fit_the_told_velocity() -> None:
    """A robot that creeps, walks too slowly, turns too fast, and turns when it is told to go sideways."""
    walked_per_stride = torch.tensor([[2.2, 0.0, 0.0], [0.0, 2.8, 0.0], [0.0, 0.4, 5.0]])
    creep = torch.tensor([0.12, 0.0, 0.0])
    prior, generator = GaitPrior(GaitPriorConfig()), torch.Generator().manual_seed(0)

    def walked(told: torch.Tensor) -> torch.Tensor:
        stride = torch.cat([told, torch.ones(len(told), 1)], dim=1) @ prior.stride.T
        return stride @ walked_per_stride.T + creep

    for _ in range(150):
        told = torch.tensor([1.0, 0.5, 0.8]) * (2.0 * torch.rand(4000, 3, generator=generator) - 1.0)
        noise = 0.2 * torch.randn(4000, 3, generator=generator)
        prior.observe(told, walked(told) + noise)
        prior.fit()
    told = torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0], [-0.4, 0.3, 0.0], [0.0, -0.3, 0.5]])
    torch.testing.assert_close(walked(told), told, atol=0.05, rtol=0.0)
    mixing = [prior.stride[row, column].item() for row, column in ((0, 1), (0, 2), (1, 0), (2, 0), (1, 3), (2, 3))]
    assert mixing == [0.0] * 6


def test_a_few_robots_fit_nothing() -> None:
    prior = GaitPrior(GaitPriorConfig())
    before = prior.stride
    prior.observe(torch.ones(100, 3), torch.zeros(100, 3))
    prior.fit()
    assert torch.equal(prior.stride, before)
    assert before.diagonal().tolist() == pytest.approx(GaitPriorConfig().stride)
