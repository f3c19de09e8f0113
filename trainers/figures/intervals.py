"""Means and shares with their intervals; S seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

_RESAMPLES = 10_000


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    r"""Return the mean of the middle half of the values ``[..., S]`` along the last axis.

    .. math:: \frac{1}{S - 2m} \sum_{i=m+1}^{S-m} x_{(i)}, \qquad m = \lfloor S / 4 \rfloor

    Reference:
        Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
        2021, arXiv 2108.13264.
    """
    cut = values.shape[-1] // 4
    middle: np.ndarray = np.sort(values, axis=-1)[..., cut : values.shape[-1] - cut].mean(-1)
    return middle


def bootstrap(
    values: Sequence[float],
    statistic: Callable[[np.ndarray], np.ndarray] = lambda sample: sample.mean(-1),
) -> tuple[float, float, float]:
    """Return a statistic over seeds ``[S]``, and its 95 % percentile bootstrap interval.

    Of one value, the interval is the value. The statistic is taken along the last axis.

    Reference:
        Efron, "Bootstrap methods: another look at the jackknife", 1979.
    """
    sample = np.asarray(values, dtype=float)
    draws = np.random.default_rng(0).integers(len(sample), size=(_RESAMPLES, len(sample)))
    low, high = np.quantile(statistic(sample[draws]), [0.025, 0.975])
    return float(statistic(sample[None])[0]), float(low), float(high)


def wilson(successes: int, trials: int) -> tuple[float, float]:
    r"""Return the 95 % interval of a share, Wilson's.

    .. math:: \frac{1}{1 + z^2 / n} \left(\hat p + \frac{z^2}{2n}
        \pm z \sqrt{\frac{\hat p (1 - \hat p)}{n} + \frac{z^2}{4n^2}}\right), \qquad z = 1.96

    Reference:
        Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    """
    z, share = 1.959964, successes / trials
    middle = share + z**2 / (2 * trials)
    half = z * np.sqrt(share * (1 - share) / trials + (z / (2 * trials)) ** 2)
    low, high = ((middle + sign * half) / (1 + z**2 / trials) for sign in (-1, 1))
    return max(0.0, round(float(low), 4)), min(1.0, round(float(high), 4))
