"""Means over seeds with bootstrap intervals.

Letters: S seeds, R resamples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Interval:
    """A statistic of several values, and where it would lie with other seeds.

    ``low`` and ``high`` are equal to ``middle`` when there is one value only.
    """

    middle: float
    low: float
    high: float
    count: int


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    r"""Return the mean of the middle half of the values along the last axis.

    .. math:: \frac{1}{S - 2m} \sum_{i=m+1}^{S-m} x_{(i)}, \qquad m = \lfloor S / 4 \rfloor

    Args:
        values: ``[..., S]``.

    Reference:
        Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
        2021, arXiv 2108.13264.

    Example:
        >>> float(interquartile_mean(np.array([0.0, 2.0, 4.0, 100.0])))
        3.0
    """
    cut = values.shape[-1] // 4
    middle: np.ndarray = np.sort(values, axis=-1)[..., cut : values.shape[-1] - cut].mean(-1)
    return middle


def bootstrap(
    values: Sequence[float],
    statistic: Callable[[np.ndarray], np.ndarray] = lambda sample: sample.mean(-1),
    *,
    level: float = 0.95,
    resamples: int = 10_000,
) -> Interval:
    """Return a statistic over seeds with its percentile bootstrap interval.

    Args:
        values: one per seed, ``[S]``.
        statistic: of samples ``[R, S]``, along the last axis. Default: the mean.
        level: share of the resamples within the interval.
        resamples: R, drawn from a fixed seed.

    Raises:
        ValueError: if there is no value, or ``level`` is not within (0, 1).

    Reference:
        Efron, "Bootstrap methods: another look at the jackknife", 1979.

    Example:
        >>> bootstrap([1.0, 2.0, 3.0]).middle
        2.0
    """
    if not values:
        raise ValueError("bootstrap needs one value or more; got none.")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be in (0, 1); got {level}.")
    sample = np.asarray(values, dtype=float)
    middle = float(statistic(sample[None])[0])
    if len(sample) == 1:
        return Interval(middle, middle, middle, 1)
    draws = np.random.default_rng(0).integers(len(sample), size=(resamples, len(sample)))
    outcomes = statistic(sample[draws])
    low, high = np.quantile(outcomes, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return Interval(middle, float(low), float(high), len(sample))
