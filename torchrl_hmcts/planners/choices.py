"""Final choices: which option a finished search recommends."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torchrl_hmcts.planners.search import Search


@dataclass(frozen=True)
class BestPlan:
    """The first option of the plan with the highest return; without a plan, the most visited one.

    Reference:
        This project's.

    Example:
        >>> BestPlan()
        BestPlan()
    """

    def choose(self, search: Search) -> np.ndarray:
        """Return an option for each root, int64 ``[B]``."""
        most_visited = MostVisited().choose(search)
        planned = [
            search.tree.options(b, int(node))[0] if node > 0 else most_visited[b]
            for b, node in enumerate(search.best_node)
        ]
        return np.array(planned, np.int64)


@dataclass(frozen=True)
class MostVisited:
    """The option of the root with the most visits (ties: the higher value, then the lower index).

    Reference:
        Chaslot et al., "Progressive strategies for Monte-Carlo tree search", 2008: the robust
        child.

    Example:
        >>> MostVisited()
        MostVisited()
    """

    def choose(self, search: Search) -> np.ndarray:
        """Return an option for each root, int64 ``[B]``."""
        visits, values = _root_options(search)
        order: np.ndarray = np.lexsort((-values, -visits), axis=-1)[:, 0]
        return order


@dataclass(frozen=True)
class HighestValue:
    """The option of the root with the highest value.

    Args:
        random_ties: draw among options of equal value, as there are many where rewards are rare,
            instead of taking the one of lower index. Default ``False``.

    Reference:
        Chaslot et al., "Progressive strategies for Monte-Carlo tree search", 2008: the max child.

    Example:
        >>> HighestValue(random_ties=True)
        HighestValue(random_ties=True)
    """

    random_ties: bool = False

    def choose(self, search: Search) -> np.ndarray:
        """Return an option for each root, int64 ``[B]``."""
        values = _root_options(search)[1]
        choice: np.ndarray = values.argmax(-1)
        if self.random_ties:
            for b, row in enumerate(values):
                best = np.flatnonzero(row == row[choice[b]])
                choice[b] = search.generator(b, "choice").choice(best)
        return choice


@dataclass(frozen=True)
class SampledVisits:
    r"""An option drawn in proportion to its visits, sharpened by a temperature.

    .. math:: P(a) \propto N(s, a)^{1 / T}

    Args:
        temperature: T. Default 1; towards 0 it becomes :class:`MostVisited`.

    Raises:
        ValueError: if the temperature is not positive.

    Reference:
        Silver et al., "Mastering the game of Go without human knowledge", 2017.

    Example:
        >>> SampledVisits(temperature=0.5)
        SampledVisits(temperature=0.5)
    """

    temperature: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.temperature) and self.temperature > 0.0):
            raise ValueError(
                f"SampledVisits needs a temperature > 0; got {self.temperature}. For the option "
                f"with the most visits use MostVisited()."
            )

    def choose(self, search: Search) -> np.ndarray:
        """Return an option for each root, int64 ``[B]``."""
        visits = _root_options(search)[0].astype(np.float64)
        allowed = search.allowed()
        visits = np.where(visits.sum(-1, keepdims=True) > 0, visits, allowed)
        with np.errstate(divide="ignore"):
            logits = np.log(visits) / self.temperature
        top = np.where(np.isfinite(logits), logits, -np.inf).max(-1, keepdims=True)
        weights = np.exp(logits - np.where(np.isfinite(top), top, 0.0))
        choice = np.zeros(search.num_roots, np.int64)
        for b, row in enumerate(weights):
            if row.sum() > 0.0:
                choice[b] = search.generator(b, "choice").choice(len(row), p=row / row.sum())
        return choice


FinalChoice = BestPlan | MostVisited | HighestValue | SampledVisits


def _root_options(search: Search) -> tuple[np.ndarray, np.ndarray]:
    """Visits and values of the roots' options ``[B, A]``; -inf for a value that is not known."""
    edges = search.tree.edges[:, 0]
    visits = edges["visits"].astype(np.int64)
    return visits, np.where(visits > 0, edges["value"], -np.inf)
