"""Final choices: which option a finished search recommends."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BestPlan:
    """The first option of the plan with the highest return; without a plan, the most visited one.

    Example:
        >>> BestPlan()
        BestPlan()
    """


@dataclass(frozen=True)
class MostVisited:
    """The option of the root with the most visits (ties: the higher value, then the lower index).

    Example:
        >>> MostVisited()
        MostVisited()
    """


@dataclass(frozen=True)
class HighestValue:
    """The option of the root with the highest value (ties: the lower index).

    Example:
        >>> HighestValue()
        HighestValue()
    """


FinalChoice = BestPlan | MostVisited | HighestValue
