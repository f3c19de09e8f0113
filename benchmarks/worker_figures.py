"""The worker after 10,000, 20,000 and 40,000 base steps: its skills, and what is solved with them.

    python benchmarks/worker_figures.py --out docs/results/skills/worker.json   (10 minutes)

For every seed and length of training: skills learned in the training mazes; then, in the 342 test
mazes, the discriminator's accuracy, the directions of the skills, the share of a maze's free tiles
that a search of 200 expansions reaches, and the mazes solved at the first trial, each plan carried
out in a separate instance of the env.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from skill_figures import search_coverage, skill_figures

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.evaluation import plan_and_execute, spread
from torchrl_hmcts.trainers.experiments.demo import make_starts, train_worker
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_option_env
from torchrl_hmcts.trainers.runs.config import FRAMES_PER_BATCH, DemoConfig

RADIUS = 0.7  # of the novelty test, tiles, in all benchmarks of skills


def measure(seed: int, base_steps: int, num_mazes: int) -> dict[str, Any]:
    """Train a worker and take all figures."""
    config = DemoConfig(seed=seed, train_base_steps=base_steps // FRAMES_PER_BATCH * 64)
    trainer, loss = train_worker(config)
    mazes = maze_pool("test")
    greedy = SkillPolicy(loss.actor_network, deterministic=True)
    env, real = (make_option_env(greedy, mazes) for _ in range(2))
    starts = make_starts(env.base_env, num_mazes, seed)
    novelty = RadiusNovelty("position", RADIUS, shorter_paths=True)
    budget = SearchBudget(expansions=config.expansions)
    planner = MCTSPlanner(
        env, novelty=novelty, budget=budget, leaves_per_wave=config.leaves_per_wave
    )
    solved = plan_and_execute(planner, real, starts)
    wide = MCTSPlanner(
        env,
        novelty=RadiusNovelty("position", RADIUS),
        budget=SearchBudget(expansions=200, until_plan=False),
    )
    coverage = torch.cat(
        [search_coverage(wide.search(group), env.base_env) for group in starts.split(38)]
    )
    sampling = SkillPolicy(loss.actor_network, generator=torch.Generator().manual_seed(seed))
    return {
        "seed": seed,
        "train_base_steps": config.train_base_steps,
        "last_training_accuracy": round(trainer.history["discriminator_accuracy"][-1], 4),
        "greedy": skill_figures(greedy, loss.discriminator, mazes, seed=seed),
        "sampled": skill_figures(sampling, loss.discriminator, mazes, seed=seed),
        "coverage_200_expansions": spread(coverage.numpy()),
        "mazes": solved.summary(),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The figures as a markdown table."""
    head = [
        "training base steps",
        "seed",
        "solved",
        "simulated base steps, median (95 %)",
        "episode, median",
        "accuracy after 25 / 50 / 100 steps, greedy",
        "the same, sampled",
        "smallest angle",
        "coverage, mean",
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for row in rows:
        mazes = row["mazes"]
        accuracy = [
            " / ".join(f"{figures['accuracy']:.3f}" for figures in row[kind].values())
            for kind in ("greedy", "sampled")
        ]
        cells = [
            f"{row['train_base_steps']:,}",
            row["seed"],
            f"{mazes['solved']} of {mazes['starts']}",
            f"{mazes['simulated_steps']['median']:,.0f} ({mazes['simulated_steps']['p95']:,.0f})",
            f"{mazes['episode_steps']['median']:.0f}",
            *accuracy,
            f"{next(iter(row['greedy'].values()))['angle']:.0f}",
            f"{row['coverage_200_expansions']['mean']:.3f}",
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--base-steps", type=int, nargs="+", default=[10_000, 20_000, 40_000])
    parser.add_argument("--mazes", type=int, default=342)
    parser.add_argument("--quick", action="store_true", help="one seed, 10,000 steps, 38 mazes")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    if args.quick:
        args.seeds, args.base_steps, args.mazes = [0], [10_000], 38
    torch.set_num_threads(1)
    rows = []
    for base_steps in args.base_steps:
        for seed in args.seeds:
            rows.append(measure(seed, base_steps, args.mazes))
            print(json.dumps(rows[-1]), flush=True)
    print(table(rows))
    if args.out is not None:
        args.out.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
