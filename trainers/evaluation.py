"""What a planner over a worker's options achieves: plans, carried out open-loop in a real env.

Letters: M starts, A options.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_hmcts.planners import MCTSPlanner, extract_plans


@dataclass
class Results:
    """One entry per start, ``[M]``.

    ``found`` a plan and ``solved`` by carrying it out (bool); ``simulated_steps`` base steps that
    the search simulated, ``expansions`` of nodes and ``simulations`` of options it took,
    ``plan_options`` in the plan, ``episode_steps`` base steps that were carried out (int64).

    Example:
        >>> import numpy as np
        >>> ones = np.ones(3, dtype=np.int64)
        >>> results = Results(ones > 0, np.array([True, True, False]), *[ones] * 5)
        >>> results.summary()["solved"], results.summary()["starts"]
        (2, 3)
    """

    found: np.ndarray
    solved: np.ndarray
    simulated_steps: np.ndarray
    expansions: np.ndarray
    simulations: np.ndarray
    plan_options: np.ndarray
    episode_steps: np.ndarray

    def summary(self) -> dict[str, Any]:
        """Return counts, and mean, median and 95th percentile of each cost.

        ``episode_steps`` and ``plan_options`` are those of the solved starts; the costs of search
        are those of all.
        """
        out: dict[str, Any] = {
            "starts": len(self.solved),
            "found": int(self.found.sum()),
            "solved": int(self.solved.sum()),
        }
        for name in ("simulated_steps", "expansions", "simulations"):
            out[name] = spread(getattr(self, name))
        for name in ("plan_options", "episode_steps"):
            out[name] = spread(getattr(self, name)[self.solved])
        return out

    @staticmethod
    def concatenate(parts: list[Results]) -> Results:
        """Join results of several groups of starts."""
        names = Results.__dataclass_fields__
        return Results(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


def spread(values: Any) -> dict[str, float]:
    """Return mean, median and 95th percentile; NaN of nothing.

    Example:
        >>> spread([1, 2, 3])["median"]
        2.0
    """
    values = np.asarray(values, dtype=float)
    if not values.size:
        return dict.fromkeys(("mean", "median", "p95"), float("nan"))
    return {
        "mean": round(float(values.mean()), 4),
        "median": round(float(np.median(values)), 4),
        "p95": round(float(np.percentile(values, 95)), 4),
    }


def plan_and_carry_out(
    planner: MCTSPlanner, real: EnvBase, starts: TensorDictBase, *, group: int = 38
) -> Results:
    """Plan from every start, carry the plans out in another env, and report.

    Trees do not depend on what is searched beside them, so the results are those of one search
    after the other; a group of starts is only faster.

    Args:
        planner: over the worker's options.
        real: the macro environment in which plans are carried out, stateless; not the planner's.
        starts: states ``[M]``.
        group: starts planned side by side; 38 divides the 342 test mazes.

    Returns:
        The results, in the order of the starts.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=5)
        >>> starts = env.reset().expand(2).clone()
        >>> plan_and_carry_out(MCTSPlanner(env), ChainEnv(length=5), starts).solved.tolist()
        [True, True]
    """
    return Results.concatenate(
        [
            _plan_and_carry_out(planner, real, starts[begin : begin + group])
            for begin in range(0, len(starts), group)
        ]
    )


def _plan_and_carry_out(planner: MCTSPlanner, real: EnvBase, starts: TensorDictBase) -> Results:
    search = planner.search(starts)
    plans = extract_plans(search)
    option_key = planner.option_key
    state = starts.clone()
    steps = torch.zeros(len(starts), dtype=torch.int64)
    solved = torch.zeros(len(starts), dtype=torch.bool)
    running = plans.lengths > 0
    for i in range(int(plans.lengths.max())):
        running &= plans.lengths > i
        if not running.any():
            break
        before = state[running]
        after = real.step(before.set(option_key, plans.options[running, i]))["next"]
        duration = after.get("duration", None)
        taken = torch.ones(len(after), dtype=torch.int64) if duration is None else duration[:, 0]
        steps[running] += taken
        solved[running] = after["terminated"][:, 0]
        state[running] = after.select(*state.keys(True, True))
        running[running.clone()] = ~after["done"][:, 0]
    return Results(
        found=plans.found.numpy(),
        solved=solved.numpy(),
        simulated_steps=search.num_base_steps.copy(),
        expansions=search.num_expansions.copy(),
        simulations=search.num_simulations.copy(),
        plan_options=plans.lengths.numpy(),
        episode_steps=steps.numpy(),
    )
