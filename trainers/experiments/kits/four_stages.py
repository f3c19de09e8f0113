"""The dissertation's manager: selection, expansion, simulation, backup, and nothing else."""

from __future__ import annotations

from typing import Any

_PLANNERS = "torchrl_hmcts.planners"


def four_stages(expansions: int) -> dict[str, Any]:
    """Return the entries of a planner without a novelty test, by keyword.

    Selection by UCT, expansion of one option, a simulation of ten random options from the new node,
    backup of the mean.

    Reference:
        Dissertation, section 2.4.2.
    """
    return {
        "_component_": f"{_PLANNERS}.MCTSPlanner",
        "tree_policy": {"_component_": f"{_PLANNERS}.UCT"},
        "leaf_evaluator": {"_component_": f"{_PLANNERS}.RolloutEvaluator"},
        "expand": "one",
        "budget": {"_component_": f"{_PLANNERS}.SearchBudget", "expansions": expansions},
    }
