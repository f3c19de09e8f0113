"""Options of the roots: noise in their priors, Gumbel's race, and the one that is recommended."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_hmcts.checks import instance, real_number
from torchrl_hmcts.planners.search import Search
from torchrl_hmcts.planners.tree import FORBIDDEN
from torchrl_hmcts.planners.tree_policies import Gumbel


@dataclass(frozen=True)
class DirichletNoise:
    r"""Mixes noise into the prior of the root's options.

    .. math:: P(s, a) \leftarrow (1 - \epsilon)\, P(s, a) + \epsilon\, \eta_a,
              \qquad \eta \sim \mathrm{Dir}(\alpha)

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
        real_number("DirichletNoise", "alpha", self.alpha, above=0.0)
        real_number("DirichletNoise", "fraction", self.fraction, least=0.0, most=1.0)

    def add(self, search: Search, roots: np.ndarray) -> None:
        """Mix noise into the priors of ``roots`` (int64), each with random numbers of its own."""
        edges = search.tree.edges
        for b in roots.tolist():
            allowed = edges["closed"][b, 0] != FORBIDDEN
            if not allowed.any() or self.fraction == 0.0:
                continue
            prior = np.where(allowed, edges["prior"][b, 0], 0.0)
            drawn = np.zeros(search.num_options)
            drawn[allowed] = search.generator(b, "noise").dirichlet(
                np.full(int(allowed.sum()), self.alpha)
            )
            prior = prior / max(prior.sum(), 1e-12)
            edges["prior"][b, 0] = (1.0 - self.fraction) * prior + self.fraction * drawn


@dataclass(frozen=True)
class BestPlan:
    """The first option of the plan with the highest return; without a plan, the most visited one.

    Reference:
        This project's.

    Example:
        >>> from torchrl_hmcts.planners import BestPlan, MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> BestPlan().choose(MCTSPlanner(env).search(env.reset()))
        array([1])
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
        >>> from torchrl_hmcts.planners import MCTSPlanner, MostVisited
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> MostVisited().choose(MCTSPlanner(env).search(env.reset()))
        array([1])
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
        random_ties: among options of equal value draw one, instead of taking the one of lowest
            index. Many values are equal where rewards are rare. Default ``False``.

    Reference:
        Chaslot et al., "Progressive strategies for Monte-Carlo tree search", 2008: the max child.

    Example:
        >>> HighestValue(random_ties=True)
        HighestValue(random_ties=True)
    """

    random_ties: bool = False

    def __post_init__(self) -> None:
        instance("HighestValue", "random_ties", self.random_ties, bool)

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
        real_number("SampledVisits", "temperature", self.temperature, above=0.0)

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


def halve(search: Search, num_simulations: int) -> None:
    """Draw the Gumbel noise of the roots, and plan how simulations are halved among options."""
    policy = search.settings.tree_policy
    assert isinstance(policy, Gumbel)
    num_options = search.num_options
    search.gumbel = np.zeros((search.num_roots, num_options + num_simulations), np.float32)
    schedules: dict[int, list[int]] = {}
    with np.errstate(divide="ignore"):
        logits = np.log(search.tree.edges["prior"][:, 0])
    search.gumbel[:, :num_options] = np.maximum(logits, -1e9)
    for b, num_allowed in enumerate(search.allowed().sum(-1).tolist()):
        if policy.scale > 0.0:
            noise = search.generator(b, "gumbel").gumbel(size=num_options)
            search.gumbel[b, :num_options] += policy.scale * noise
        considered = min(policy.max_considered, num_allowed)
        if considered not in schedules:
            schedules[considered] = policy.considered_visits(considered, num_simulations)
        search.gumbel[b, num_options:] = schedules[considered]


def gumbel_choice(search: Search) -> np.ndarray:
    """Return the option that a Gumbel search ends on for each root, int64 ``[B]``."""
    from torchrl_hmcts.planners.variant_kernels import completed_values

    tree, sigma = search.tree, np.empty(search.num_options)
    allowed = search.allowed()
    visits = np.where(allowed, tree.edges["visits"][:, 0], -1)
    scores = np.where(visits == visits.max(-1, keepdims=True), 0.0, -np.inf)
    for b in range(search.num_roots):
        completed_values(tree.nodes, tree.edges, search.record, b, 0, sigma)
        scores[b] += search.gumbel[b, : search.num_options] + sigma
    choice: np.ndarray = np.where(allowed, scores, -np.inf).argmax(-1)
    return choice
