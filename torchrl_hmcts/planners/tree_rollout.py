"""Rollouts whose nodes stay in the tree."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_hmcts.checks import whole_number


@dataclass(frozen=True)
class TreeRollout:
    r"""From every new leaf go on with options drawn from the prior, and keep all that is met.

    .. math:: o_{i+1} \sim P(\cdot \mid s_i), \qquad i < n

    The simulation step of the textbook, except that every state on the way becomes a node: nothing
    that was simulated is thrown away, and a reward far ahead is found by a path that can be
    carried out. Uniform without an ``option_prior``. A rollout ends where the episode does, where
    the novelty test refuses the state, and where the budget of simulations is spent; the other
    limits are looked at between rollouts. Its steps count in the budget, as all of a tree's do.

    Args:
        max_options: n, options of a rollout at most. Default 10.

    Raises:
        ValueError: if ``max_options`` is below 1.

    Reference:
        Bandres, Bonet and Geffner, "Planning with pixels in (almost) real time", 2018, arXiv
        1801.03354: rollouts in the tree, there with a novelty test.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner, SearchBudget, TreeRollout
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> planner = MCTSPlanner(
        ...     ChainEnv(length=30), expand="one", rollout=TreeRollout(max_options=5),
        ...     budget=SearchBudget(simulations=12, until_plan=False), seed=0)
        >>> search = planner.search(ChainEnv(length=30).reset())
        >>> search.num_simulations.tolist(), int(search.tree.nodes["depth"].max()) >= 6
        ([12], True)
    """

    max_options: int = 10

    def __post_init__(self) -> None:
        whole_number("TreeRollout", "max_options", self.max_options, least=1)
