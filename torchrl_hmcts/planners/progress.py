"""Reports of a search while it runs."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_hmcts.planners.search import Search


@dataclass(frozen=True)
class SearchProgress:
    """Report to a progress display after every wave.

    Attributes:
        num_roots (int): roots of the search.
        num_active (int): roots whose search continues.
        num_found (int): roots with a plan.
        expansions (int): nodes expanded so far, of all roots.
        base_steps (int): base steps simulated so far, of all roots.
        seconds (float): since the search began.
        search (Search): the search so far, of B roots; ``extract_plans(search)`` returns its best
            plans.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env, told = ChainEnv(length=4), []
        >>> _ = MCTSPlanner(env, progress=told.append).plan(env.reset())
        >>> told[-1].num_found, told[-1].num_roots
        (1, 1)
    """

    num_roots: int
    num_active: int
    num_found: int
    expansions: int
    base_steps: int
    seconds: float
    search: Search

    @classmethod
    def of(cls, search: Search, num_active: int, seconds: float) -> SearchProgress:
        """Return the progress of a search after ``seconds``."""
        return cls(
            num_roots=search.num_roots,
            num_active=num_active,
            num_found=int((search.best_node >= 0).sum()),
            expansions=int(search.num_expansions.sum()),
            base_steps=int(search.num_base_steps.sum()),
            seconds=seconds,
            search=search,
        )
