"""How much a search may spend."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchBudget:
    """Limits of a search, each per root; the first that is reached ends the root's search.

    Args:
        expansions: nodes whose options are simulated (with ``expand="one"``: options simulated).
            Default 1,000.
        base_steps: simulated base steps. Default: no limit.
        seconds: wall time of the whole call. Default: no limit.
        until_plan: stop at the first plan that earns a reward. Default ``True``.
        improve_expansions: expansions after the first plan, to find better ones. Default 0.

    Raises:
        ValueError: if a limit is zero or negative.

    Example:
        >>> SearchBudget(expansions=100, until_plan=False).expansions
        100
    """

    expansions: int = 1000
    base_steps: int | None = None
    seconds: float | None = None
    until_plan: bool = True
    improve_expansions: int = 0

    def __post_init__(self) -> None:
        for name in ("expansions", "base_steps", "seconds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(
                    f"SearchBudget needs {name} > 0: a search of nothing has no plan; got {value}. "
                    + ("Use None for no limit." if name != "expansions" else "Try 1000.")
                )
        if self.improve_expansions < 0:
            raise ValueError(
                f"SearchBudget needs improve_expansions >= 0; got {self.improve_expansions}."
            )
