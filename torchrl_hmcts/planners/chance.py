"""Chance: how often a search asks a stochastic simulator for the same option."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ProgressiveWidening:
    r"""Draws another outcome of an option as its visits grow.

    An option visited :math:`N(s,o)` times has been simulated at most

    .. math:: \lceil k\, N(s,o)^\alpha \rceil

    times. Equal next states are one outcome, counted twice; the option's value is the mean over
    the outcomes drawn, and descents go to them in proportion. A planner without it simulates each
    option of a node once, which is right for a deterministic simulator only.

    Args:
        k: Default 1.
        alpha: 0 for ``k`` outcomes at most, 1 for a new draw at every visit. Default 0.5.

    Raises:
        ValueError: if ``k`` is not positive, or ``alpha`` is not in [0, 1].

    Reference:
        Couetoux et al., "Continuous upper confidence trees", 2011 (double progressive widening).

    Example:
        >>> ProgressiveWidening(k=2.0)
        ProgressiveWidening(k=2.0, alpha=0.5)
    """

    k: float = 1.0
    alpha: float = 0.5

    def __post_init__(self) -> None:
        if not (math.isfinite(self.k) and self.k > 0.0):
            raise ValueError(f"ProgressiveWidening needs k > 0 that is finite; got {self.k}.")
        if not 0.0 <= self.alpha <= 1.0:
            raise ValueError(f"ProgressiveWidening needs alpha in [0, 1]; got {self.alpha}.")
