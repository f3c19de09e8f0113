"""A manager that learns from its own searches, against planners that do not, in Waterworld.

    python benchmarks/learned_manager.py --seeds 0 1 2 \\
        --out docs/results/skills/learned_manager.json
    python benchmarks/learned_manager.py --quick        (60 mazes, 2 iterations)

For each seed: train the demo's worker, train prior and value by expert iteration in the training
mazes, and plan in the test mazes with the plain planner, with distance as the value, and with what
was learned, after each iteration. Plans are carried out in another env. All base steps simulated
for training are counted and shown beside. CPU seconds are of this process alone.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import UCT, MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.evaluation import plan_and_execute, spread
from torchrl_hmcts.trainers.experiments.demo import make_starts, train_worker
from torchrl_hmcts.trainers.experiments.waterworld.networks import MazeNetwork
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_option_env
from torchrl_hmcts.trainers.expert_iteration import ExpertIterationTrainer, make_guided_planner
from torchrl_hmcts.trainers.runs.config import DemoConfig

OPTION_STEPS, RADIUS, GAMMA = 25, 0.7, 0.99  # those of the demo
MAIN = "learned, expand one, novelty 0.2"  # the one that is followed over the iterations


class Closeness:
    """Values a place by its distance to the target, at 15 base steps a tile, through the walls."""

    in_keys = ["position", "target"]

    def __call__(self, td: TensorDictBase) -> Tensor:
        return GAMMA ** (15.0 * (td["position"] - td["target"]).norm(dim=-1))


def plain_planner(env: EnvBase, leaves: int = 4) -> MCTSPlanner:
    novelty = RadiusNovelty("position", RADIUS, shorter_paths=True)
    budget = SearchBudget(expansions=1_000)
    return MCTSPlanner(env, novelty=novelty, leaves_per_wave=leaves, budget=budget)


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
        "plain, 4 leaves a wave": plain_planner(env, 4),
        "plain, 1 leaf a wave": plain_planner(env, 1),
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


def measure(planner: MCTSPlanner, real: EnvBase, starts: TensorDictBase) -> dict[str, Any]:
    """Plan from all starts and carry the plans out; search alone once more, for the time."""
    planner.search(starts[:1])  # compiles the kernels
    results = plan_and_execute(planner, real, starts)
    few = starts[:: max(1, len(starts) // 40)]  # one maze after the other, as an agent meets them
    seconds = []
    for i in range(len(few)):
        begin = time.process_time()
        planner.search(few[i : i + 1])
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
    if args.worker_weights is None:
        _, loss = train_worker(DemoConfig(seed=seed))
    else:
        loss = load_worker(args.worker_weights.format(seed=seed))
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    worker_seconds = time.process_time() - begin
    test = maze_pool("test")
    kwargs = {"option_steps": OPTION_STEPS, "gamma": GAMMA}
    simulator, real = (make_option_env(worker, test, **kwargs) for _ in range(2))
    starts = make_starts(simulator.base_env, args.mazes, seed)
    training_env = make_option_env(worker, **kwargs)

    torch.manual_seed(seed)
    network = MazeNetwork(maze_pool("train"), gamma=GAMMA)
    first = plain_planner(training_env, 1)
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
        progress=tqdm_or_none(),
        seed=seed,
    )
    clock = {"begin": time.process_time(), "seconds": 0.0}
    snapshots: list[MazeNetwork] = []

    def keep() -> None:
        clock["seconds"] = time.process_time() - clock["begin"]
        snapshots.append(copy.deepcopy(network))
        collector = trainer.collector
        learned.append(
            {
                "iteration": len(learned),
                "training_cpu_seconds": round(clock["seconds"], 1),
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
    for name, planner in fixed_planners(simulator).items():
        rows[name] = measure(planner, real, starts)
        report(seed, name, rows[name])
    for i, snapshot in enumerate(snapshots):
        on_test = snapshot.on(test)
        for name, planner in learned_planners(simulator, on_test).items():
            if i < len(snapshots) - 1 and name != MAIN:
                continue
            key = f"{name}, iteration {i}"
            rows[key] = measure(planner, real, starts)
            report(seed, key, rows[key])
    return {
        "worker_cpu_seconds": round(worker_seconds, 1),
        "iterations": learned,
        "history": trainer.history,
        "planners": rows,
    }


def load_worker(path: str) -> Any:
    """Read a worker's loss that was trained before; only to try this script out quickly."""
    from torchrl_hmcts.trainers.diayn import DIAYNTrainer
    from torchrl_hmcts.trainers.experiments.waterworld.worker import make_training_env

    loss = DIAYNTrainer.make_loss(make_training_env(), 4, seed=0)
    loss.load_state_dict(torch.load(path, weights_only=True))
    return loss


def tqdm_or_none() -> Any:
    from tqdm import tqdm

    return tqdm if sys.stderr.isatty() else None


def report(seed: int, name: str, row: dict[str, Any]) -> None:
    print(
        f"seed {seed}  {name:46s} solved {row['solved']}/{row['starts']}  simulations "
        f"{row['simulations']['median']:.0f}  simulated base steps "
        f"{row['simulated_steps']['median']:.0f} (mean {row['simulated_steps']['mean']:.0f}, p95 "
        f"{row['simulated_steps']['p95']:.0f})  episode {row['episode_steps']['median']:.0f}",
        flush=True,
    )


def table(runs: dict[str, Any]) -> str:
    """All seeds together as a Markdown table: medians over all mazes, worst seed's solved."""
    head = (
        "| planner | solved, by seed | simulations | simulated base steps (mean; p95) | "
        "expansions | CPU ms a maze | episode base steps (mean) | against plain |"
    )
    lines = [head, "|---|---|---|---|---|---|---|---|"]
    seeds = list(runs)
    reference = "plain, 4 leaves a wave"
    for name in runs[seeds[0]]["planners"]:
        rows = [runs[s]["planners"][name] for s in seeds]
        base = [runs[s]["planners"][reference] for s in seeds]

        def mean(key: str, figure: str, rows: list[Any] = rows) -> float:
            return float(np.mean([row[key][figure] for row in rows]))

        simulated = np.concatenate([row["simulated"] for row in rows])
        plain = np.concatenate([row["simulated"] for row in base])
        lines.append(
            f"| {name} | {', '.join(str(row['solved']) for row in rows)} of {rows[0]['starts']} | "
            f"{mean('simulations', 'median'):.0f} | {np.median(simulated):.0f} "
            f"({simulated.mean():.0f}; {np.percentile(simulated, 95):.0f}) | "
            f"{mean('expansions', 'median'):.0f} | "
            f"{1e3 * mean('cpu_seconds_alone', 'median'):.0f} | "
            f"{mean('episode_steps', 'median'):.0f} ({mean('episode_steps', 'mean'):.0f}) | "
            f"{np.median(simulated) / np.median(plain):.2f} |"
        )
    lines += ["", "| iteration | training base steps, so far | a search | CPU s, so far |"]
    lines.append("|---|---|---|---|")
    for i in range(len(runs[seeds[0]]["iterations"])):
        its = [runs[s]["iterations"][i] for s in seeds]

        def mean_of(key: str, its: list[Any] = its) -> float:
            return float(np.mean([it[key] for it in its]))

        lines.append(
            f"| {i} | {mean_of('training_base_steps_so_far'):,.0f} | "
            f"{mean_of('training_base_steps_per_search'):,.0f} | "
            f"{mean_of('training_cpu_seconds'):.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--mazes", type=int, default=342)
    parser.add_argument("--iterations", type=int, default=4)
    parser.add_argument("--searches", type=int, default=400, help="training mazes an iteration")
    parser.add_argument("--updates", type=int, default=200, help="updates an iteration")
    parser.add_argument("--quick", action="store_true", help="60 mazes, 2 iterations")
    parser.add_argument("--worker-weights", help="state dict of a worker's loss, with {seed}")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    if args.quick:
        args.mazes, args.iterations = 60, 2
    torch.set_num_threads(1)
    runs = {str(seed): run(seed, args) for seed in args.seeds}
    text = table(runs)
    print(text)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        arguments = {k: str(v) if isinstance(v, Path) else v for k, v in vars(args).items()}
        figures = {"arguments": arguments, "table": text.splitlines(), "seeds": runs}
        args.out.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
