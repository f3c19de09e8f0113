"""Options that end by themselves against options of a fixed length, on the same mazes.

    python benchmarks/terminations.py --seeds 0 1 2 \\
        --out docs/results/skills/terminations.json
    python benchmarks/terminations.py --quick

Variants: options of 100 base steps (the source's) and of 25 (the demo's); options that end when
stuck, after at most 100 or 25; options that end when stuck or where a learned termination says so,
after at most 100. Each variant is tuned by itself on training mazes, over six settings, with the
first seed's worker: least simulated base steps a maze, where a maze that is not solved counts as
the whole limit. Then the test mazes are planned and the plans carried out, once per seed, with a
worker and a termination trained anew.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.modules import SkillPolicy, TerminationNetwork
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.evaluation import Results, plan_and_execute, spread
from torchrl_hmcts.trainers.experiments.demo import make_starts, train_worker
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_option_env
from torchrl_hmcts.trainers.runs.config import DemoConfig
from torchrl_hmcts.trainers.skills.termination import (
    TerminationConfig,
    collect_option_steps,
    learn_termination,
    make_terminating_env,
)

TUNING_LIMIT = 10_000  # simulated base steps of a search in training mazes
SETTINGS: dict[str, list[dict[str, Any]]] = {
    "fixed 100": [{"radius": r} for r in (0.25, 0.35, 0.5, 0.7, 1.0, 1.4)],
    "fixed 25": [{"radius": r} for r in (0.25, 0.35, 0.5, 0.7, 1.0, 1.4)],
    "stall, at most 100": [
        {"radius": r, "stall_steps": n} for r, n in product((0.35, 0.7, 1.0), (3, 6))
    ],
    "stall, at most 25": [
        {"radius": r, "stall_steps": n} for r, n in product((0.5, 0.7, 1.0), (2, 3))
    ],
    "learned, at most 100": [
        {"radius": r, "deliberation_cost": xi} for r, xi in product((0.5, 0.7), (0.02, 0.04, 0.06))
    ],
}


class Workers:
    """The worker of a seed, and terminations learned for it, each made when first asked for."""

    def __init__(self, seed: int, termination: dict[str, Any], weights: Path | None) -> None:
        self.seed = seed
        if weights is None:
            _, loss = train_worker(DemoConfig(seed=seed))
        else:
            from torchrl_hmcts.trainers.diayn import DIAYNTrainer
            from torchrl_hmcts.trainers.experiments.waterworld.worker import make_training_env

            loss = DIAYNTrainer.make_loss(make_training_env(), 4, seed=seed)
            loss.load_state_dict(torch.load(str(weights).format(seed=seed), weights_only=True))
        self.worker = SkillPolicy(loss.actor_network, deterministic=True)
        self._options = termination
        self._learned: dict[float, TerminationNetwork] = {}
        self._data: TensorDictBase | None = None
        self.seconds = 0.0
        self.base_steps = 0

    def network(self, cost: float) -> TerminationNetwork:
        """Learn a termination; all costs learn from the same base steps."""
        if cost not in self._learned:
            begin = time.perf_counter()
            config = TerminationConfig(seed=self.seed, deliberation_cost=cost, **self._options)
            if self._data is None:
                self._data = collect_option_steps(self.worker, 4, config)
            result = learn_termination(self.worker, 4, config, data=self._data)
            self._learned[cost] = result.network
            self.base_steps = result.base_steps
            self.seconds += time.perf_counter() - begin
        return self._learned[cost]

    def make_env(self, variant: str, setting: dict[str, Any], mazes: Tensor) -> TransformedEnv:
        steps = int(variant.split()[-1])
        if variant.startswith("fixed"):
            return make_option_env(self.worker, mazes, option_steps=steps)
        if variant.startswith("stall"):
            stall = setting["stall_steps"]
            return make_terminating_env(self.worker, mazes, stall_steps=stall, max_steps=steps)
        network = self.network(setting["deliberation_cost"])
        return make_terminating_env(self.worker, mazes, network=network, max_steps=steps)


def evaluate(
    workers: Workers, variant: str, setting: dict[str, Any], mazes: Tensor, budget: SearchBudget
) -> Results:
    """Plan in every maze and carry the plans out in another env."""
    env, real = (workers.make_env(variant, setting, mazes) for _ in range(2))
    planner = MCTSPlanner(
        env,
        novelty=RadiusNovelty("position", setting["radius"], shorter_paths=True),
        leaves_per_wave=4,
        budget=budget,
    )
    starts = make_starts(real.base_env, len(mazes), workers.seed)
    return plan_and_execute(planner, real, starts)


def tune(
    workers: Workers, variant: str, settings: list[dict[str, Any]], mazes: Tensor
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the best setting, and every setting with its score."""
    tried = []
    for setting in settings:
        budget = SearchBudget(base_steps=TUNING_LIMIT)
        results = evaluate(workers, variant, setting, mazes, budget)
        cost = np.where(results.solved, results.simulated_steps, TUNING_LIMIT)
        tried.append(
            {**setting, "solved": int(results.solved.sum()), "score": round(float(cost.mean()), 1)}
        )
        print(f"  tuned {variant}: {tried[-1]} of {len(mazes)}", flush=True)
    best = min(range(len(tried)), key=lambda i: tried[i]["score"])
    return settings[best], tried


def pooled(parts: list[Results], seeds: list[int], limit: int) -> dict[str, Any]:
    """Figures of all seeds together, and solved mazes of each."""
    together = Results.concatenate(parts)
    figures = together.summary()
    lost = np.where(together.solved, together.simulated_steps, limit)
    figures["simulated_steps_of_solved"] = spread(together.simulated_steps[together.solved])
    figures["steps_per_option"] = round(
        float(together.simulated_steps.sum() / max(1, together.simulations.sum())), 2
    )
    figures["score"] = round(float(lost.mean()), 1)
    figures["solved_by_seed"] = {s: int(p.solved.sum()) for s, p in zip(seeds, parts, strict=True)}
    return figures


def on_common_mazes(results: dict[str, list[Results]]) -> dict[str, dict[str, float]]:
    """Mean costs on the mazes that every variant solves, so that none gains by giving up."""
    joined = {variant: Results.concatenate(parts) for variant, parts in results.items()}
    common = np.logical_and.reduce([r.solved for r in joined.values()])
    return {
        variant: {
            "mazes": int(common.sum()),
            "simulated_steps": round(float(r.simulated_steps[common].mean()), 1),
            "episode_steps": round(float(r.episode_steps[common].mean()), 1),
        }
        for variant, r in joined.items()
    }


def table(figures: dict[str, Any]) -> Iterator[str]:
    """The lines of a markdown table."""
    yield (
        "| options | setting | solved | simulated base steps: mean, median, 95 % | executed: mean, "
        "median | options a plan | base steps an option | on common mazes: simulated, executed |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for variant, row in figures["variants"].items():
        sim, done = row["simulated_steps"], row["episode_steps"]
        common = figures["common"][variant]
        setting = ", ".join(f"{k} {v}" for k, v in row["setting"].items())
        yield (
            f"| {variant} | {setting} | {row['solved']} of {row['starts']} | {sim['mean']:,.0f}, "
            f"{sim['median']:,.0f}, {sim['p95']:,.0f} | {done['mean']:.0f}, {done['median']:.0f} | "
            f"{row['plan_options']['median']:.0f} | {row['steps_per_option']:.1f} | "
            f"{common['simulated_steps']:,.0f}, {common['episode_steps']:.0f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--mazes", type=int, default=342, help="test mazes")
    parser.add_argument("--tuning-mazes", type=int, default=60, help="training mazes to tune in")
    parser.add_argument("--expansions", type=int, default=1_000, help="of a search in a test maze")
    parser.add_argument("--quick", action="store_true", help="24 mazes, 2 settings, short training")
    parser.add_argument(
        "--weights", type=Path, help="workers' state dicts, with {seed} in the name"
    )
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    torch.set_num_threads(1)
    settings, termination = SETTINGS, {}
    if args.quick:
        args.mazes, args.tuning_mazes = min(args.mazes, 24), 6
        settings = {variant: rows[2:4] for variant, rows in SETTINGS.items()}
        termination = {"base_steps": 6_400, "value_updates": 200, "termination_updates": 50}
    make: Callable[[int], Workers] = lambda seed: Workers(seed, termination, args.weights)  # noqa: E731

    begin = time.perf_counter()
    workers = {args.seeds[0]: make(args.seeds[0])}
    tuning = maze_pool("train")[-args.tuning_mazes :]
    chosen, tried = {}, {}
    for variant, rows in settings.items():
        chosen[variant], tried[variant] = tune(workers[args.seeds[0]], variant, rows, tuning)

    test = maze_pool("test")[: args.mazes]
    results: dict[str, list[Results]] = {variant: [] for variant in settings}
    for seed in args.seeds:
        if seed not in workers:
            workers[seed] = make(seed)
        for variant, setting in chosen.items():
            budget = SearchBudget(expansions=args.expansions)
            results[variant].append(evaluate(workers[seed], variant, setting, test, budget))
            print(f"seed {seed}, {variant}: {results[variant][-1].solved.sum()} solved", flush=True)
    limit = max(int(r.simulated_steps.max()) for parts in results.values() for r in parts)
    figures = {
        "arguments": {k: str(v) if isinstance(v, Path) else v for k, v in vars(args).items()},
        "variants": {
            variant: {"setting": chosen[variant], **pooled(parts, args.seeds, limit)}
            for variant, parts in results.items()
        },
        "common": on_common_mazes(results),
        "tuning": {"mazes": args.tuning_mazes, "limit": TUNING_LIMIT, "tried": tried},
        "termination_training": {
            "base_steps": {seed: w.base_steps for seed, w in workers.items()},
            "seconds": {seed: round(w.seconds, 1) for seed, w in workers.items()},
        },
        "seconds": round(time.perf_counter() - begin, 1),
    }
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(figures, indent=2) + "\n")
    print("\n".join(table(figures)))


if __name__ == "__main__":
    main()
