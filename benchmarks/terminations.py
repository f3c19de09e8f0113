"""Options that end by themselves against options of a fixed length, on the same mazes.

    python benchmarks/terminations.py --seeds 0 1 2 \\
        --out docs/results/skills/terminations.json
    python benchmarks/terminations.py --quick

Variants: options of 100 base steps (the dissertation's) and of 25 (the demo's); options that end
when stuck, after at most 100 or 25; options that end when stuck or where a learned termination says
so, after at most 100. Each variant is tuned by itself on training mazes, over six settings, with
the first seed's worker: least simulated base steps a maze, where a maze that is not solved counts
as the whole limit. Then the test mazes are planned and the plans executed, once per seed, each with
its own worker and termination.
"""

from __future__ import annotations

import time
from itertools import product
from typing import Any

import numpy as np
import torch
from learned_termination import (
    MazeView,
    TerminationConfig,
    collect_option_steps,
    learn_termination,
)
from mazes import demo_loss, greedy, make_option_env, make_starts, planner
from table import markdown, read_arguments, write
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.modules import (
    LearnedTermination,
    StallTermination,
    TerminationNetwork,
)
from torchrl_hmcts.planners import SearchBudget
from torchrl_hmcts.trainers.evaluation import Results, plan_and_execute, spread
from torchrl_hmcts.transforms import OptionTransform, StallTransform

STALL_TOLERANCE = 0.005  # tiles per base step, a twentieth of the top speed
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


def make_terminating_env(
    worker: Any,
    mazes: Tensor,
    max_steps: int = 100,
    *,
    network: TerminationNetwork | None = None,
    stall_steps: int = 3,
) -> TransformedEnv:
    """Waterworld with options that end when stuck, and where a network says so."""
    base = WaterworldMazeEnv(mazes, observation=False)
    conditions: list[Any] = [StallTermination(stall_steps)]
    if network is not None:
        seen = TensorDictSequential(MazeView(base.mazes), network)
        conditions.append(LearnedTermination(seen, every=5))

    def ends(td: TensorDictBase) -> Tensor:
        return torch.stack([c(td).reshape(td.batch_size) for c in conditions]).any(0)

    options = OptionTransform(worker, 4, max_steps, termination=ends)
    return TransformedEnv(base, Compose(StallTransform("position", STALL_TOLERANCE), options))


class Workers:
    """The worker of a seed, and terminations learned for it, each made when first asked for."""

    def __init__(self, seed: int, termination: dict[str, Any]) -> None:
        self.seed = seed
        self.worker = greedy(demo_loss(seed))
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
            self._learned[cost], _ = learn_termination(self.worker, 4, config, data=self._data)
            self.base_steps = self._data.numel()
            self.seconds += time.perf_counter() - begin
        return self._learned[cost]

    def make_env(self, variant: str, setting: dict[str, Any], mazes: Tensor) -> TransformedEnv:
        steps = int(variant.split()[-1])
        if variant.startswith("fixed"):
            return make_option_env(self.worker, mazes, option_steps=steps)
        if variant.startswith("stall"):
            stall = setting["stall_steps"]
            return make_terminating_env(self.worker, mazes, steps, stall_steps=stall)
        network = self.network(setting["deliberation_cost"])
        return make_terminating_env(self.worker, mazes, steps, network=network)


def evaluate(
    workers: Workers, variant: str, setting: dict[str, Any], mazes: Tensor, budget: SearchBudget
) -> Results:
    """Plan in every maze and execute the plans in another env."""
    env, real = (workers.make_env(variant, setting, mazes) for _ in range(2))
    starts = make_starts(real.base_env, len(mazes), workers.seed)
    return plan_and_execute(planner(env, setting["radius"], budget=budget), real, starts)


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


COLUMNS = {
    "options": lambda row: row["options"],
    "setting": lambda row: ", ".join(f"{k} {v}" for k, v in row["setting"].items()),
    "solved": lambda row: f"{row['solved']} of {row['starts']}",
    "simulated base steps: mean, median, 95 %": lambda row: (
        "{mean:,.0f}, {median:,.0f}, {p95:,.0f}".format(**row["simulated_steps"])
    ),
    "executed: mean, median": lambda row: "{mean:.0f}, {median:.0f}".format(**row["episode_steps"]),
    "options a plan": lambda row: f"{row['plan_options']['median']:.0f}",
    "base steps an option": lambda row: f"{row['steps_per_option']:.1f}",
    "on common mazes: simulated, executed": lambda row: (
        "{simulated_steps:,.0f}, {episode_steps:.0f}".format(**row["common"])
    ),
}


def main() -> None:
    args = read_arguments(
        __doc__,
        {"mazes": 24, "tuning_mazes": 6},
        seeds=[0],
        mazes=(342, "test mazes"),
        tuning_mazes=(60, "training mazes to tune in"),
        expansions=(1_000, "of a search in a test maze"),
    )
    settings, termination = SETTINGS, {}
    if args.quick:
        settings = {variant: rows[2:4] for variant, rows in SETTINGS.items()}
        termination = {"base_steps": 6_400, "value_updates": 200, "termination_updates": 50}
    begin = time.perf_counter()
    workers = {seed: Workers(seed, termination) for seed in args.seeds}
    tuning = maze_pool("train")[-args.tuning_mazes :]
    chosen, tried = {}, {}
    for variant, rows in settings.items():
        chosen[variant], tried[variant] = tune(workers[args.seeds[0]], variant, rows, tuning)

    test = maze_pool("test")[: args.mazes]
    budget = SearchBudget(expansions=args.expansions)
    results: dict[str, list[Results]] = {variant: [] for variant in settings}
    for seed in args.seeds:
        for variant, setting in chosen.items():
            results[variant].append(evaluate(workers[seed], variant, setting, test, budget))
            print(f"seed {seed}, {variant}: {results[variant][-1].solved.sum()} solved", flush=True)
    limit = max(int(r.simulated_steps.max()) for parts in results.values() for r in parts)
    variants = {
        variant: {"setting": chosen[variant], **pooled(parts, args.seeds, limit)}
        for variant, parts in results.items()
    }
    common = on_common_mazes(results)
    figures = {
        "arguments": vars(args),
        "variants": variants,
        "common": common,
        "tuning": {"mazes": args.tuning_mazes, "limit": TUNING_LIMIT, "tried": tried},
        "termination_training": {
            "base_steps": {seed: w.base_steps for seed, w in workers.items()},
            "seconds": {seed: round(w.seconds, 1) for seed, w in workers.items()},
        },
        "seconds": round(time.perf_counter() - begin, 1),
    }
    write(args, figures)
    rows = [{"options": v, "common": common[v], **variants[v]} for v in variants]
    print(markdown(rows, COLUMNS))


if __name__ == "__main__":
    main()
