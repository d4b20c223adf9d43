from __future__ import annotations

import numpy as np
import pytest
import torch

from lowlevel.networks.normalizer import RunningNormalizer
from lowlevel.runs.checks import NonFiniteError


def test_moments_equal_those_of_all_data_at_once() -> None:
    generator = np.random.default_rng(0)
    data = generator.normal(1000.0, [0.1, 1.0, 50.0], size=(5000, 3)).astype(np.float32)
    normalizer = RunningNormalizer(3)
    for part in np.split(data, [7, 100, 2500]):
        normalizer.update(torch.from_numpy(part))
    assert float(normalizer.count) == 5000
    np.testing.assert_allclose(normalizer.mean.numpy(), data.astype(np.float64).mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(normalizer.variance.numpy(), data.astype(np.float64).var(axis=0), rtol=1e-3)


def test_output_has_zero_mean_and_unit_deviation_except_in_fixed_columns() -> None:
    fixed = torch.tensor([False, True, False])
    normalizer = RunningNormalizer(3, fixed, floor=1e-4)
    data = 3.0 + 2.0 * torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(normalizer(data), data.clamp(-10, 10)), "identity before the first update"
    normalizer.update(data.view(100, 200, 3))
    scaled = normalizer(data)
    torch.testing.assert_close(scaled[:, [0, 2]].mean(dim=0), torch.zeros(2), atol=1e-3, rtol=0)
    torch.testing.assert_close(scaled[:, [0, 2]].std(dim=0), torch.ones(2), atol=1e-3, rtol=0)
    assert torch.equal(scaled[:, 1], data[:, 1].clamp(-10, 10))


def test_a_constant_column_does_not_explode_when_it_is_released() -> None:
    normalizer = RunningNormalizer(1)
    normalizer.update(torch.full((100, 1), 0.3))
    assert float(normalizer(torch.tensor([[0.3]]))) == pytest.approx(0.0, abs=1e-4)
    assert float(normalizer(torch.tensor([[5.0]]))) == 10.0, "clipped"


def test_a_value_that_is_not_finite_is_refused_and_changes_nothing() -> None:
    normalizer = RunningNormalizer(2)
    normalizer.update(torch.randn(50, 2))
    before = {name: value.clone() for name, value in normalizer.state_dict().items()}
    bad = torch.randn(50, 2)
    bad[3, 1] = float("inf")
    with pytest.raises(NonFiniteError, match="normalizer"):
        normalizer.update(bad)
    assert all(torch.equal(before[name], value) for name, value in normalizer.state_dict().items())


def test_state_restores_exactly() -> None:
    first, second = RunningNormalizer(2), RunningNormalizer(2)
    first.update(torch.randn(1000, 2) * 7 + 3)
    second.load_state_dict(first.state_dict())
    more = torch.randn(10, 2)
    for normalizer in (first, second):
        normalizer.update(more)
    assert torch.equal(first(more), second(more))


def test_a_mask_of_the_wrong_size_is_refused() -> None:
    with pytest.raises(ValueError, match="mask of fixed columns"):
        RunningNormalizer(3, torch.zeros(2, dtype=torch.bool))
