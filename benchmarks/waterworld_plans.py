"""Plans in the test mazes of Waterworld: what the first one costs, and how good it is.

    python benchmarks/waterworld_plans.py                     (342 mazes, about 5 minutes)
    python benchmarks/waterworld_plans.py --long-mazes 24     (and long searches to compare)

Trains the demo's worker, plans in every test maze alone (B = 1), improves each plan by some more
expansions, and, for the first ``--long-mazes``, compares it with the best plan of a search that
goes on for as many expansions as ``--long-seconds`` at B = 1 would pay for. Those searches run side
by side, since a tree does not depend on what is searched beside it.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import (
    UCT,
    MCTSPlanner,
    RadiusNovelty,
    SearchBudget,
    extract_plans,
)
from torchrl_hmcts.trainers.experiments.demo import make_starts, train_worker
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_option_env
from torchrl_hmcts.trainers.runs.config import DemoConfig

OPTION_STEPS, RADIUS, GAMMA = 25, DemoConfig().novelty_radius, 0.99  # those of the demo


def make_planner(env: Any, leaves: int, radius: float = RADIUS, **budget: Any) -> MCTSPlanner:
    novelty = RadiusNovelty("position", radius, shorter_paths=True)
    return MCTSPlanner(env, novelty=novelty, leaves_per_wave=leaves, budget=SearchBudget(**budget))


class Closeness:
    """Values a place by its distance to the target, at 15 base steps a tile, through the walls."""

    in_keys = ["position", "target"]

    def __call__(self, td: TensorDictBase) -> Tensor:
        return GAMMA ** (15.0 * (td["position"] - td["target"]).norm(dim=-1))


def plan_all(planner: MCTSPlanner, starts: TensorDictBase) -> tuple[dict[str, Any], list[int]]:
    """Plan in one maze after the other; return figures, and the base steps of each plan."""
    planner.search(starts[:1])  # compiles the kernels
    seconds, steps, lengths = [], [], []
    for i in range(len(starts)):
        begin = time.perf_counter()
        search = planner.search(starts[i : i + 1])
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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the worker and of the starts")
    parser.add_argument("--mazes", type=int, default=342)
    parser.add_argument("--leaves", type=int, default=4, help="leaves per wave")
    parser.add_argument("--improve", type=int, default=50, help="expansions after the first plan")
    parser.add_argument("--long-mazes", type=int, default=0)
    parser.add_argument("--long-seconds", type=float, default=60.0)
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    torch.set_num_threads(1)

    _, loss = train_worker(DemoConfig(seed=args.seed))
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    env = make_option_env(worker, maze_pool("test"), option_steps=OPTION_STEPS, gamma=GAMMA)
    starts = make_starts(env.base_env, args.mazes, args.seed)
    first = make_planner(env, args.leaves, expansions=3_000)
    guided = MCTSPlanner(
        env,
        tree_policy=UCT(c=0.1),
        leaf_evaluator=Closeness(),
        backup="max",
        novelty=RadiusNovelty("position", RADIUS),
        budget=SearchBudget(expansions=3_000),
    )
    figures: dict[str, Any] = {
        "arguments": {k: str(v) if isinstance(v, Path) else v for k, v in vars(args).items()}
    }
    figures["plain"], lengths = plan_all(first, starts)
    figures["guided_by_distance"], _ = plan_all(guided, starts)
    print(json.dumps(figures, indent=2), flush=True)

    improver = make_planner(env, args.leaves, expansions=6_000, improve_expansions=args.improve)
    begin = time.perf_counter()
    improved = [
        int(improver.plan(starts[i : i + 1]).durations[0]) for i in range(min(args.mazes, 100))
    ]
    figures["improved_plan_base_steps"] = median_and_tail(improved)
    figures["improving_seconds_per_maze"] = round((time.perf_counter() - begin) / len(improved), 3)
    print(json.dumps(figures, indent=2), flush=True)

    if args.long_mazes:
        begin = time.perf_counter()
        probe = make_planner(env, args.leaves, 0.3, seconds=4.0, until_plan=False)
        spent = int(probe.search(starts[:1]).num_expansions[0]) / (time.perf_counter() - begin)
        expansions = int(spent * args.long_seconds)
        begin = time.perf_counter()
        # Half the radius: a finer net of places than the first plan needs.
        long = make_planner(env, args.leaves, 0.35, expansions=expansions, until_plan=False)
        best = extract_plans(long.search(starts[: args.long_mazes])).durations.numpy()
        figures["long_search"] = {
            "expansions": expansions,
            "seconds_side_by_side": round(time.perf_counter() - begin, 1),
            "plan_base_steps": median_and_tail(best),
            "first_plan_over_best": median_and_tail(np.array(lengths[: len(best)]) / best),
            "improved_plan_over_best": median_and_tail(np.array(improved[: len(best)]) / best),
        }
        print(json.dumps(figures, indent=2), flush=True)
    if args.out is not None:
        args.out.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
