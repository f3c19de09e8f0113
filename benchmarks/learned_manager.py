"""A manager that learns from its own searches, against planners that do not, in Waterworld.

    python benchmarks/learned_manager.py --seeds 0 1 2 \\
        --out docs/results/skills/learned_manager.json
    python benchmarks/learned_manager.py --quick        (60 mazes, 2 iterations)

For each seed: train the demo's worker, train prior and value by expert iteration in the training
mazes, and plan in the test mazes with the plain planner, with distance as the value, and with what
was learned, after each iteration. Plans are executed in another env. All base steps simulated
for training are counted and shown beside. CPU seconds are of this process alone.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import time
from typing import Any

import numpy as np
import torch
from mazes import RADIUS, demo_loss, greedy, make_option_env, make_starts, planner
from table import markdown, read_arguments, write
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.planners import UCT, MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.evaluation import plan_and_execute, spread
from torchrl_hmcts.trainers.experiments.waterworld.maze_network import MazeNetwork
from torchrl_hmcts.trainers.expert_iteration import ExpertIterationTrainer, make_guided_planner

GAMMA = 0.99  # the demo's
MAIN = "learned, expand one, novelty 0.2"  # the one that is followed over the iterations


class Closeness:
    """Values a place by its distance to the target, at 15 base steps a tile, through the walls."""

    in_keys = ["position", "target"]

    def __call__(self, td: TensorDictBase) -> Tensor:
        return GAMMA ** (15.0 * (td["position"] - td["target"]).norm(dim=-1))


def fixed_planners(env: EnvBase) -> dict[str, MCTSPlanner]:
    def closeness(expand: Any, expansions: int) -> MCTSPlanner:
        return MCTSPlanner(
            env,
            tree_policy=UCT(c=0.1),
            leaf_evaluator=Closeness(),
            backup="max",
            novelty=RadiusNovelty("position", RADIUS),
            expand=expand,
            budget=SearchBudget(expansions=expansions),
        )

    return {
        "plain, 4 leaves a wave": planner(env),
        "plain, 1 leaf a wave": planner(env, leaves=1),
        "distance, expand all": closeness("all", 1_000),
        "distance, expand one": closeness("one", 4_000),
    }


def learned_planners(env: EnvBase, network: MazeNetwork) -> dict[str, MCTSPlanner]:
    def novelty(radius: float) -> RadiusNovelty:
        return RadiusNovelty("position", radius)

    budget = SearchBudget(expansions=1_000)
    return {
        MAIN: make_guided_planner(env, network, novelty=novelty(0.2)),
        "learned, expand one, no novelty test": make_guided_planner(env, network),
        "learned, expand one, novelty 0.7": make_guided_planner(env, network, novelty=novelty(0.7)),
        "learned, expand all, novelty 0.7": make_guided_planner(
            env, network, novelty=novelty(0.7), expand="all", budget=budget
        ),
    }


def measure(searcher: MCTSPlanner, real: EnvBase, starts: TensorDictBase) -> dict[str, Any]:
    """Plan from all starts and execute the plans; search alone once more, for the time."""
    searcher.search(starts[:1])  # compiles the kernels
    results = plan_and_execute(searcher, real, starts)
    few = starts[:: max(1, len(starts) // 40)]  # one maze after the other, as an agent meets them
    seconds = []
    for start in few.split(1):
        begin = time.process_time()
        searcher.search(start)
        seconds.append(time.process_time() - begin)
    return {
        **results.summary(),
        "cpu_seconds_alone": spread(seconds),
        "simulated_steps_all": int(results.simulated_steps.sum()),
        "episodes": results.episode_steps.tolist(),
        "simulated": results.simulated_steps.tolist(),
    }


def run(seed: int, args: argparse.Namespace) -> dict[str, Any]:
    begin = time.process_time()
    worker = greedy(demo_loss(seed))
    worker_seconds = time.process_time() - begin
    test = maze_pool("test")
    simulator, real = (make_option_env(worker, test) for _ in range(2))
    starts = make_starts(simulator.base_env, args.mazes, seed)
    training_env = make_option_env(worker)

    torch.manual_seed(seed)
    network = MazeNetwork(maze_pool("train"), gamma=GAMMA)
    first = planner(training_env, leaves=1)
    first.search(training_env.reset().unsqueeze(0))  # compiles the kernels
    learned: list[dict[str, Any]] = []
    trainer = ExpertIterationTrainer(
        training_env,
        network,
        first,
        planner=make_guided_planner(
            training_env,
            network,
            novelty=RadiusNovelty("position", 0.2),
            budget=SearchBudget(expansions=400),
        ),
        iterations=args.iterations,
        searches_per_iteration=args.searches,
        updates_per_iteration=args.updates,
        progress=tqdm if sys.stderr.isatty() else None,
        seed=seed,
    )
    begin = time.process_time()
    snapshots: list[MazeNetwork] = []

    def keep() -> None:
        snapshots.append(copy.deepcopy(network))
        collector = trainer.collector
        learned.append(
            {
                "iteration": len(learned),
                "training_cpu_seconds": round(time.process_time() - begin, 1),
                "training_searches": args.searches,
                "training_solved": collector.solved[-1],
                "training_base_steps": collector.base_steps[-1],
                "training_base_steps_so_far": sum(collector.base_steps),
                "training_base_steps_per_search": collector.base_steps[-1] / args.searches,
            }
        )

    trainer.register_op("post_steps", keep)
    trainer.train()
    print(json.dumps(learned, indent=1), flush=True)
    rows: dict[str, Any] = {}
    for name, searcher in fixed_planners(simulator).items():
        rows[name] = measure(searcher, real, starts)
        report(seed, name, rows[name])
    for i, snapshot in enumerate(snapshots):
        on_test = snapshot.on(test)
        for name, searcher in learned_planners(simulator, on_test).items():
            if i < len(snapshots) - 1 and name != MAIN:
                continue
            key = f"{name}, iteration {i}"
            rows[key] = measure(searcher, real, starts)
            report(seed, key, rows[key])
    return {
        "worker_cpu_seconds": round(worker_seconds, 1),
        "iterations": learned,
        "history": trainer.history,
        "planners": rows,
    }


def report(seed: int, name: str, row: dict[str, Any]) -> None:
    print(
        f"seed {seed}  {name:46s} solved {row['solved']}/{row['starts']}  simulations "
        f"{row['simulations']['median']:.0f}  simulated base steps "
        f"{row['simulated_steps']['median']:.0f} (mean {row['simulated_steps']['mean']:.0f}, p95 "
        f"{row['simulated_steps']['p95']:.0f})  episode {row['episode_steps']['median']:.0f}",
        flush=True,
    )


def pooled(runs: dict[str, Any], name: str) -> dict[str, Any]:
    """The rows of a planner, of all seeds, and their simulated base steps in one array."""
    rows = [run["planners"][name] for run in runs.values()]
    return {
        "name": name,
        "rows": rows,
        "simulated": np.concatenate([row["simulated"] for row in rows]),
        "mean": lambda key, figure: np.mean([row[key][figure] for row in rows]),
    }


def table(runs: dict[str, Any]) -> str:
    """All seeds together as markdown: medians over all mazes, each seed's solved."""
    first = next(iter(runs.values()))
    plain = np.median(pooled(runs, "plain, 4 leaves a wave")["simulated"])
    planners = {
        "planner": lambda p: p["name"],
        "solved, by seed": lambda p: (
            f"{', '.join(str(r['solved']) for r in p['rows'])} of {p['rows'][0]['starts']}"
        ),
        "simulations": lambda p: f"{p['mean']('simulations', 'median'):.0f}",
        "simulated base steps (mean; p95)": lambda p: (
            f"{np.median(p['simulated']):.0f} ({p['simulated'].mean():.0f}; "
            f"{np.percentile(p['simulated'], 95):.0f})"
        ),
        "expansions": lambda p: f"{p['mean']('expansions', 'median'):.0f}",
        "CPU ms a maze": lambda p: f"{1e3 * p['mean']('cpu_seconds_alone', 'median'):.0f}",
        "episode base steps (mean)": lambda p: (
            f"{p['mean']('episode_steps', 'median'):.0f} ({p['mean']('episode_steps', 'mean'):.0f})"
        ),
        "against plain": lambda p: f"{np.median(p['simulated']) / plain:.2f}",
    }
    iterations = {
        "iteration": lambda its: its[0]["iteration"],
        "training base steps, so far": lambda its: (
            f"{np.mean([it['training_base_steps_so_far'] for it in its]):,.0f}"
        ),
        "a search": lambda its: (
            f"{np.mean([it['training_base_steps_per_search'] for it in its]):,.0f}"
        ),
        "CPU s, so far": lambda its: f"{np.mean([it['training_cpu_seconds'] for it in its]):.0f}",
    }
    followed = zip(*(run["iterations"] for run in runs.values()), strict=True)
    rows = [pooled(runs, name) for name in first["planners"]]
    return markdown(rows, planners) + "\n\n" + markdown(followed, iterations)


def main() -> None:
    args = read_arguments(
        __doc__,
        {"mazes": 60, "iterations": 2},
        seeds=[0],
        mazes=342,
        iterations=4,
        searches=(400, "training mazes an iteration"),
        updates=(200, "updates an iteration"),
    )
    runs = {str(seed): run(seed, args) for seed in args.seeds}
    text = table(runs)
    print(text)
    write(args, {"arguments": vars(args), "table": text.splitlines(), "seeds": runs})


if __name__ == "__main__":
    main()
