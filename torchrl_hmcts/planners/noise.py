"""Root noise: lets a search for training look at options that its prior thinks little of."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class DirichletNoise:
    r"""Mixes noise into the prior of the root's options.

    .. math:: P(s, a) \leftarrow (1 - \epsilon)\, P(s, a) + \epsilon\, \eta_a,
              \qquad \eta \sim \mathrm{Dir}(\alpha)

    The prior of the options that may be taken is scaled to sum to 1 first. After a subtree is
    reused the new root gets noise of its own.

    Args:
        alpha: of the Dirichlet distribution, about 10 over the number of options. Default 0.3.
        fraction: :math:`\epsilon`. Default 0.25.

    Raises:
        ValueError: if a number is out of range.

    Reference:
        Silver et al., "Mastering the game of Go without human knowledge", 2017.

    Example:
        >>> DirichletNoise(alpha=2.5)
        DirichletNoise(alpha=2.5, fraction=0.25)
    """

    alpha: float = 0.3
    fraction: float = 0.25

    def __post_init__(self) -> None:
        if not (math.isfinite(self.alpha) and self.alpha > 0.0):
            raise ValueError(f"DirichletNoise needs alpha > 0; got {self.alpha}.")
        if not 0.0 <= self.fraction <= 1.0:
            raise ValueError(f"DirichletNoise needs a fraction in [0, 1]; got {self.fraction}.")
