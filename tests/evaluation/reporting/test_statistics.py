from __future__ import annotations

import numpy as np
import pytest

from evaluation.reporting.statistics import mean_figure, mean_interval, quantile_figure, share_figure, wilson_interval


@pytest.mark.parametrize(
    ("successes", "trials", "lower", "upper"),
    [
        # Lower ends to two digits, as commonly tabulated; 0/n mirrors n/n.
        (5, 5, 0.57, 1.0),
        (50, 50, 0.93, 1.0),
        (100, 100, 0.96, 1.0),
        (90, 100, 0.83, 0.94),
        (0, 5, 0.0, 0.43),
    ],
)
def test_wilson_interval_agrees_with_tables(successes: int, trials: int, lower: float, upper: float) -> None:
    low, high = wilson_interval(successes, trials)
    assert low == pytest.approx(lower, abs=0.006)
    assert high == pytest.approx(upper, abs=0.006)


def test_wilson_interval_of_950_in_1000() -> None:
    low, high = wilson_interval(950, 1000)
    assert low == pytest.approx(0.935, abs=5e-4)
    assert high == pytest.approx(0.962, abs=5e-4)


@pytest.mark.parametrize(("successes", "trials"), [(7, 20), (1, 3), (250, 400)])
def test_wilson_ends_are_where_the_score_test_turns(successes: int, trials: int) -> None:
    """By definition the ends solve |share - p| = z sqrt(p (1 - p) / n)."""
    for p in wilson_interval(successes, trials):
        z = abs(successes / trials - p) / np.sqrt(p * (1.0 - p) / trials)
        assert z == pytest.approx(1.959964, abs=1e-5)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (3, 2), (-1, 2)])
def test_wilson_refuses_impossible_counts(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match="give no share"):
        wilson_interval(successes, trials)


def test_mean_interval_is_the_normal_one_for_many_normal_episodes() -> None:
    values = np.random.default_rng(1).normal(3.0, 0.5, size=400)
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    low, high = mean_interval(values)
    assert low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_mean_interval_covers_the_mean_of_skewed_episodes() -> None:
    rng = np.random.default_rng(2)
    hits = [low <= 1.0 <= high for low, high in (mean_interval(rng.exponential(size=60)) for _ in range(200))]
    assert 0.87 <= np.mean(hits) <= 0.99


def test_mean_interval_refuses_one_episode() -> None:
    with pytest.raises(ValueError, match="at least two"):
        mean_interval([1.0])


def test_figures_leave_out_episodes_without_a_value() -> None:
    figure = mean_figure([1.0, float("nan"), 3.0], "m")
    assert (figure.value, figure.unit, figure.n) == (2.0, "m", 2)
    assert figure.ci95 is not None and figure.ci95[0] >= 1.0 and figure.ci95[1] <= 3.0
    nothing = mean_figure([float("nan")], "m")
    assert nothing.value is None and nothing.ci95 is None and nothing.n == 0


def test_share_figure() -> None:
    figure = share_figure([True] * 90 + [False] * 10)
    assert figure.value == pytest.approx(0.9) and figure.n == 100
    assert figure.ci95 == wilson_interval(90, 100)
    assert share_figure([]).value is None


def test_quantile_interval_covers_the_quantile() -> None:
    rng = np.random.default_rng(3)
    truth = -np.log(0.1)
    hits = []
    for _ in range(200):
        figure = quantile_figure(rng.exponential(size=400), 0.9, "ms")
        assert figure.ci95 is not None and figure.value is not None
        assert figure.ci95[0] <= figure.value <= figure.ci95[1]
        hits.append(figure.ci95[0] <= truth <= figure.ci95[1])
    assert 0.9 <= np.mean(hits) <= 0.99
