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

import torch
from mazes import RADIUS, demo_loss, greedy, make_option_env, make_starts, planner
from table import read_arguments, write
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
        print(seed, name, rows[name]["solved"], rows[name]["simulated_steps"], flush=True)
    for i, snapshot in enumerate(snapshots):
        on_test = snapshot.on(test)
        for name, searcher in learned_planners(simulator, on_test).items():
            if i < len(snapshots) - 1 and name != MAIN:
                continue
            key = f"{name}, iteration {i}"
            rows[key] = measure(searcher, real, starts)
            print(seed, key, rows[key]["solved"], rows[key]["simulated_steps"], flush=True)
    return {
        "worker_cpu_seconds": round(worker_seconds, 1),
        "iterations": learned,
        "history": trainer.history,
        "planners": rows,
    }


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
    write(args, {"arguments": vars(args), "seeds": runs})


if __name__ == "__main__":
    main()
