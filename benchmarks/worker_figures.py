"""The worker after 10,000, 20,000 and 40,000 base steps: its skills, and what is solved with them.

    python benchmarks/worker_figures.py --out docs/results/skills/worker.json   (10 minutes)

For every seed and length of training: skills learned in the training mazes; then, in the 342 test
mazes, the discriminator's accuracy, the directions of the skills, the share of a maze's free tiles
that a search of 200 expansions reaches, and the mazes solved at the first trial, each plan executed
in a separate instance of the env.
"""

from __future__ import annotations

import json
from typing import Any

import torch
from mazes import RADIUS, greedy, make_option_env, make_starts, solve
from skill_figures import search_coverage, skill_figures
from table import markdown, read_arguments, write

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.evaluation import spread
from torchrl_hmcts.trainers.experiments.kits import make_kit
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.experiments.skills import learn


def measure(seed: int, base_steps: int, num_mazes: int) -> dict[str, Any]:
    """Train a worker and take all figures."""
    config = DemoConfig(seed=seed, train_base_steps=base_steps // 64 * 64)  # whole batches
    trained = learn(make_kit(config))
    loss = trained.loss
    mazes, worker = maze_pool("test"), greedy(loss)
    env = make_option_env(worker, mazes)
    starts = make_starts(env.base_env, num_mazes, seed)
    wide = MCTSPlanner(
        env,
        novelty=RadiusNovelty("position", RADIUS),
        budget=SearchBudget(expansions=200, until_plan=False),
    )
    coverage = [search_coverage(wide.search(group), env.base_env) for group in starts.split(38)]
    sampling = SkillPolicy(loss.actor_network, generator=torch.Generator().manual_seed(seed))
    return {
        "seed": seed,
        "train_base_steps": config.train_base_steps,
        "last_training_accuracy": round(trained.history["discriminator_accuracy"][-1], 4),
        "greedy": skill_figures(worker, loss.discriminator, mazes, seed=seed),
        "sampled": skill_figures(sampling, loss.discriminator, mazes, seed=seed),
        "coverage_200_expansions": spread(torch.cat(coverage).numpy()),
        "mazes": solve(worker, num_mazes, seed).summary(),
    }


def accuracies(figures: dict[str, Any]) -> str:
    return " / ".join(f"{after['accuracy']:.3f}" for after in figures.values())


COLUMNS = {
    "training base steps": lambda row: f"{row['train_base_steps']:,}",
    "seed": lambda row: row["seed"],
    "solved": lambda row: "{solved} of {starts}".format(**row["mazes"]),
    "simulated base steps, median (95 %)": lambda row: "{median:,.0f} ({p95:,.0f})".format(
        **row["mazes"]["simulated_steps"]
    ),
    "episode, median": lambda row: f"{row['mazes']['episode_steps']['median']:.0f}",
    "accuracy after 25 / 50 / 100 steps, greedy": lambda row: accuracies(row["greedy"]),
    "the same, sampled": lambda row: accuracies(row["sampled"]),
    "smallest angle": lambda row: f"{next(iter(row['greedy'].values()))['angle']:.0f}",
    "coverage, mean": lambda row: f"{row['coverage_200_expansions']['mean']:.3f}",
}


def main() -> None:
    quick = {"seeds": [0], "base_steps": [10_000], "mazes": 38}
    steps = [10_000, 20_000, 40_000]
    args = read_arguments(__doc__, quick, seeds=[0, 1, 2], base_steps=steps, mazes=342)
    rows = []
    for base_steps in args.base_steps:
        for seed in args.seeds:
            rows.append(measure(seed, base_steps, args.mazes))
            print(json.dumps(rows[-1]), flush=True)
    print(markdown(rows, COLUMNS))
    write(args, {"rows": rows})


if __name__ == "__main__":
    main()
