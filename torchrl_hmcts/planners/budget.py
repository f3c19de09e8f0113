"""Limits of a search: its budget, its repeated outcomes, and its rollouts beyond a leaf."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

from torchrl_hmcts.checks import NO_LIMIT, instance, real_number, whole_number

_DEFAULT_EXPANSIONS = 1000


@dataclass(frozen=True)
class SearchBudget:
    """Limits of a search, each per root; the search of a root ends at the first limit it reaches.

    The limit of simulations is exact with ``expand="one"``; with ``"all"`` the last leaf still
    simulates all of its options. The other limits are checked after every wave and its rollouts, so
    a search may exceed them by the waves in flight. A tree of 2,130,706,431 visits is not searched
    further.

    Args:
        expansions: nodes whose options are simulated (with ``expand="one"``: options simulated).
            Default: 1,000 if nothing else is limited.
        simulations: values backed up: an option simulated, or a known leaf visited once more.
            Default: no limit.
        base_steps: simulated base steps. Default: no limit.
        seconds: wall time of the whole call. Default: no limit.
        nodes: nodes in the tree. Default: no limit.
        until_plan: stop at the first plan that earns a reward. Default ``True``.
        improve_expansions: expansions after the first plan, to find better ones. Default 0.

    Raises:
        ValueError: if a limit is zero or negative.
        TypeError: if a count is no integer.

    Reference:
        This project's.

    Example:
        >>> SearchBudget(simulations=100, until_plan=False).simulations
        100
    """

    expansions: int | None = None
    simulations: int | None = None
    base_steps: int | None = None
    seconds: float | None = None
    nodes: int | None = None
    until_plan: bool = True
    improve_expansions: int = 0

    def __repr__(self) -> str:
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        words = [f"{f.name}={given[f.name]}" for f in fields(self) if given[f.name] != f.default]
        return f"SearchBudget({', '.join(words)})"

    def __post_init__(self) -> None:
        limits = ("expansions", "simulations", "base_steps", "seconds", "nodes")
        for name in limits:
            value = getattr(self, name)
            if value is None:
                continue
            real_number("SearchBudget", name, value, finite=False)
            if value <= 0:
                raise ValueError(
                    f"SearchBudget needs {name} > 0; got {value}. Use None for no limit."
                )
            if name != "seconds":
                object.__setattr__(self, name, whole_number("SearchBudget", name, value))
        if all(getattr(self, name) is None for name in limits):
            object.__setattr__(self, "expansions", _DEFAULT_EXPANSIONS)
        instance("SearchBudget", "until_plan", self.until_plan, bool)
        more = whole_number("SearchBudget", "improve_expansions", self.improve_expansions)
        object.__setattr__(self, "improve_expansions", more)

    @cached_property
    def limits(self) -> tuple[int, ...]:
        """What ``root_kernels.still_active`` compares roots with."""
        counts = (self.expansions, self.base_steps, self.nodes)
        limits = (NO_LIMIT if count is None else count for count in counts)
        return *limits, self.until_plan, self.improve_expansions


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
        real_number("ProgressiveWidening", "k", self.k, above=0.0)
        real_number("ProgressiveWidening", "alpha", self.alpha, least=0.0, most=1.0)


@dataclass(frozen=True)
class TreeRollout:
    r"""Continues from every new leaf with options drawn from the prior, and keeps all that is met.

    .. math:: o_{i+1} \sim P(\cdot \mid s_i), \qquad i < n

    It is the simulation step of the textbook, except that every state on the way becomes a node: no
    simulated step is lost, and a reward far ahead is found by a path that can be executed. Without
    an ``option_prior`` options are drawn uniformly. A rollout ends with the episode, where the
    novelty test refuses the state, and where the simulations are spent, in which its steps count.

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
