"""Plans in the test mazes of Waterworld: what the first one costs, and how good it is.

    python benchmarks/waterworld_plans.py                     (342 mazes, about 5 minutes)
    python benchmarks/waterworld_plans.py --long-mazes 24     (and long searches to compare)

Trains the demo's worker, plans in every test maze alone (B = 1), improves each plan by some more
expansions, and, for the first ``--long-mazes``, compares it with the best plan of a search that
continues for as many expansions as ``--long-seconds`` at B = 1 would pay for. Those searches run
side by side, since a tree does not depend on what is searched beside it.
"""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
from mazes import demo_loss, greedy, make_option_env, make_starts, planner
from table import read_arguments, write
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.planners import UCT, MCTSPlanner, RadiusNovelty, SearchBudget, extract_plans

RADIUS, GAMMA = 1.0, 0.99  # those of the demo


class Closeness:
    """Values a place by its distance to the target, at 15 base steps a tile, through the walls."""

    in_keys = ["position", "target"]

    def __call__(self, td: TensorDictBase) -> Tensor:
        return GAMMA ** (15.0 * (td["position"] - td["target"]).norm(dim=-1))


def plan_all(searcher: MCTSPlanner, starts: TensorDictBase) -> tuple[dict[str, Any], list[int]]:
    """Plan in one maze after the other; return figures, and the base steps of each plan."""
    searcher.search(starts[:1])  # compiles the kernels
    seconds, steps, lengths = [], [], []
    for start in starts.split(1):
        begin = time.perf_counter()
        search = searcher.search(start)
        plan = extract_plans(search)
        seconds.append(time.perf_counter() - begin)
        steps.append(int(search.num_base_steps[0]))
        lengths.append(int(plan.durations[0]) if bool(plan.found[0]) else -1)
    figures = {
        "mazes": len(starts),
        "solved": int(np.sum(np.array(lengths) > 0)),
        "simulated_base_steps": median_and_tail(steps),
        "planning_seconds": median_and_tail(seconds),
        "first_plan_base_steps": median_and_tail(lengths),
    }
    return figures, lengths


def median_and_tail(values: Any) -> dict[str, float]:
    values = np.asarray(values, dtype=float)
    names = {"median": 50, "p95": 95, "max": 100}
    return {name: round(float(np.percentile(values, q)), 4) for name, q in names.items()}


def main() -> None:
    args = read_arguments(
        __doc__,
        {"mazes": 20},
        seeds=[0],
        mazes=342,
        leaves=(4, "leaves per wave"),
        improve=(50, "expansions after the first plan"),
        long_mazes=0,
        long_seconds=60.0,
    )
    env = make_option_env(greedy(demo_loss(args.seeds[0])), maze_pool("test"))
    starts = make_starts(env.base_env, args.mazes, args.seeds[0])

    def searcher(radius: float = RADIUS, **budget: Any) -> MCTSPlanner:
        return planner(env, radius, leaves=args.leaves, budget=SearchBudget(**budget))

    guided = MCTSPlanner(
        env,
        tree_policy=UCT(c=0.1),
        leaf_evaluator=Closeness(),
        backup="max",
        novelty=RadiusNovelty("position", RADIUS),
        budget=SearchBudget(expansions=3_000),
    )
    figures: dict[str, Any] = {"arguments": {k: str(v) for k, v in vars(args).items()}}
    figures["plain"], lengths = plan_all(searcher(expansions=3_000), starts)
    figures["guided_by_distance"], _ = plan_all(guided, starts)
    improver = searcher(expansions=6_000, improve_expansions=args.improve)
    begin = time.perf_counter()
    improved = [int(improver.plan(start).durations[0]) for start in starts[:100].split(1)]
    figures["improved_plan_base_steps"] = median_and_tail(improved)
    figures["improving_seconds_per_maze"] = round((time.perf_counter() - begin) / len(improved), 3)
    if args.long_mazes:
        begin = time.perf_counter()
        probe = searcher(0.3, seconds=4.0, until_plan=False)
        spent = int(probe.search(starts[:1]).num_expansions[0]) / (time.perf_counter() - begin)
        expansions = int(spent * args.long_seconds)
        begin = time.perf_counter()
        # A third of the radius: a finer net of places than the first plan needs.
        long = searcher(0.35, expansions=expansions, until_plan=False)
        best = extract_plans(long.search(starts[: args.long_mazes])).durations.numpy()
        figures["long_search"] = {
            "expansions": expansions,
            "seconds_side_by_side": round(time.perf_counter() - begin, 1),
            "plan_base_steps": median_and_tail(best),
            "first_plan_over_best": median_and_tail(np.array(lengths[: len(best)]) / best),
            "improved_plan_over_best": median_and_tail(np.array(improved[: len(best)]) / best),
        }
    print(json.dumps(figures, indent=2), flush=True)
    write(args, figures)


if __name__ == "__main__":
    main()
