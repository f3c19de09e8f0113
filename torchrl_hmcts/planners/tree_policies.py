"""Tree policies: which option a descent takes in a node."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class UCT:
    r"""Upper confidence bounds applied to trees.

    .. math:: \arg\max_j\; X_j + c \sqrt{\ln n / n_j}

    :math:`X_j = R_j + D_j V_j` is the value of option :math:`j`, :math:`n_j` its visits, :math:`n`
    the visits of the node (its own evaluation included). An option without visits comes first.

    Args:
        c: exploration constant, in units of the return. Default ``1.0``.

    Raises:
        ValueError: if ``c`` is negative or not finite.

    Reference:
        Kocsis and Szepesvari, "Bandit based Monte-Carlo planning", 2006; dissertation, section
        2.4.2.

    Example:
        >>> UCT(c=0.5).c
        0.5
    """

    c: float = 1.0

    def __post_init__(self) -> None:
        _check("UCT", self.c)


@dataclass(frozen=True)
class PUCT:
    r"""Predictor upper confidence bounds: exploration in proportion to a prior.

    .. math:: \arg\max_a\; Q(s,a) + c\, P(s,a)\, \frac{\sqrt{\sum_b N(s,b)}}{1 + N(s,a)}

    Args:
        c: exploration constant, in units of the return. Default ``1.25``.
        unvisited_value: Q of an option without visits. Default ``0.0``.

    Raises:
        ValueError: if ``c`` is negative or not finite.

    Reference:
        Silver et al., 2017; dissertation, section 5.2.1.

    Example:
        >>> PUCT(c=2.0).unvisited_value
        0.0
    """

    c: float = 1.25
    unvisited_value: float = 0.0

    def __post_init__(self) -> None:
        _check("PUCT", self.c)


TreePolicy = UCT | PUCT


def _check(name: str, c: float) -> None:
    if not (math.isfinite(c) and c >= 0.0):
        raise ValueError(f"{name} needs an exploration constant c >= 0 that is finite; got {c}.")
