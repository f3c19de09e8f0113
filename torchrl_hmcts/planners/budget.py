"""How much a search may spend."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_hmcts.checks import whole_number

_DEFAULT_EXPANSIONS = 1000


@dataclass(frozen=True)
class SearchBudget:
    """Limits of a search, each per root; the first that is reached ends the root's search.

    Simulations are exact with ``expand="one"``; with ``"all"`` the last leaf still simulates all of
    its options. The others are looked at after every wave, with a ``TreeRollout`` after its
    rollouts, so a search may exceed them by what one wave simulates, or all that are in flight.
    A tree of 2,130,706,431 visits is not searched further.

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

    def __post_init__(self) -> None:
        limits = ("expansions", "simulations", "base_steps", "seconds", "nodes")
        for name in limits:
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(
                    f"SearchBudget needs {name} > 0: a search of nothing has no plan; got {value}. "
                    f"Use None for no limit."
                )
            if value is not None and name != "seconds":
                object.__setattr__(self, name, whole_number("SearchBudget", name, value))
        if all(getattr(self, name) is None for name in limits):
            object.__setattr__(self, "expansions", _DEFAULT_EXPANSIONS)
        more = whole_number("SearchBudget", "improve_expansions", self.improve_expansions)
        object.__setattr__(self, "improve_expansions", more)
