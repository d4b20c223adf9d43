"""Figures with 95 % intervals. The independent unit is the episode, never the control step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 4000
"""Bootstrap resamples; the Monte-Carlo error of an interval's ends is then about 2 % of its width."""


@dataclass(frozen=True)
class Figure:
    """A measured quantity, as it stands in ``metrics.json``."""

    value: float | None
    """None if no episode has anything to say about it."""
    unit: str
    ci95: tuple[float, float] | None
    """95 % interval; None for fewer than two episodes."""
    n: int
    """Episodes behind the figure."""


def wilson_interval(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Wilson score interval of a share.

    Raises:
        ValueError: if there are no trials, or more successes than trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes in {trials} trials give no share")
    interval = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(
    episode_means: Sequence[float] | np.ndarray, confidence: float = CONFIDENCE, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean over episodes.

    Errors are skewed and bounded below, and a few falls make a long tail: the interval need not be symmetric.

    Raises:
        ValueError: for fewer than two episodes.
    """
    values = np.asarray(episode_means, dtype=float)
    if len(values) < 2:
        raise ValueError("an interval of a mean takes at least two episodes")
    resampled = stats.bootstrap(
        (values,), np.mean, n_resamples=RESAMPLES, confidence_level=confidence, method="percentile", rng=seed
    )
    return float(resampled.confidence_interval.low), float(resampled.confidence_interval.high)


def mean_figure(episode_means: Sequence[float] | np.ndarray, unit: str) -> Figure:
    """Mean over episodes; entries that are NaN are episodes without a value and are left out."""
    values = np.asarray(episode_means, dtype=float)
    values = values[~np.isnan(values)]
    if len(values) == 0:
        return Figure(None, unit, None, 0)
    interval = mean_interval(values) if len(values) > 1 else None
    return Figure(float(values.mean()), unit, interval, len(values))


def share_figure(happened: Sequence[bool] | np.ndarray) -> Figure:
    """Share of episodes in which something happened, with its Wilson interval."""
    flags = np.asarray(happened, dtype=bool)
    if len(flags) == 0:
        return Figure(None, "1", None, 0)
    return Figure(float(flags.mean()), "1", wilson_interval(int(flags.sum()), len(flags)), len(flags))


def quantile_figure(samples: Sequence[float] | np.ndarray, quantile: float, unit: str) -> Figure:
    """A quantile of independent samples, with the distribution-free interval between two order statistics."""
    values = np.asarray(samples, dtype=float)
    value = float(np.quantile(values, quantile))
    interval = stats.quantile_test(values, q=value, p=quantile).confidence_interval(CONFIDENCE)
    # An end that so few samples cannot tell is that of the samples.
    ends = float(np.nanmax([interval.low, values.min()])), float(np.nanmin([interval.high, values.max()]))
    return Figure(value, unit, ends, len(values))
