"""Algorithm 3 in Waterworld: base steps to solve a maze against training base steps.

    python benchmarks/hmcts_rounds.py --out docs/results/skills/hmcts_rounds.json
    python benchmarks/hmcts_rounds.py --quick

For each seed, skills are learned by the rounds of ``HMCTSTrainer``, from scratch and from a dataset
D of 40,000 base steps that an earlier training of skills recorded in other episodes. The curve is
that of test rounds in held-out mazes with the greedy worker; at the end the final worker plans in
all test mazes. Writes the figures as JSON, and the curves as PNG beside it.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import Any

from mazes import RADIUS, greedy, solve
from table import read_arguments, write
from tensordict import TensorDictBase

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env
from torchrl_hmcts.trainers.figures.curves import Panel, plot_training
from torchrl_hmcts.trainers.hmcts import HMCTSTrainer

make_env = partial(WaterworldMazeEnv, observation=False)
plan_by = partial(
    MCTSPlanner, novelty=RadiusNovelty("position", RADIUS, shorter_paths=True), leaves_per_wave=4
)


def record_dataset(seed: int, base_steps: int) -> TensorDictBase:
    """Return what a training of skills, drawn at random, took in other episodes and seeds."""
    env = make_training_env()
    loss = DIAYNTrainer.make_loss(env, 4, seed=1000 + seed)
    trainer = DIAYNTrainer(
        env, loss, total_frames=base_steps, buffer_size=base_steps, seed=1000 + seed
    )
    trainer.train()
    # The rewards are those of the discriminator that was thrown away; others are written.
    return trainer.replay_buffer.storage[:]


def learn(args: argparse.Namespace, seed: int, dataset: TensorDictBase | None) -> dict[str, Any]:
    """Run Algorithm 3 once; return its curves and figures."""
    begin = time.perf_counter()
    loss = DIAYNTrainer.make_loss(make_training_env(copies=1), 4, seed=seed)
    trainer = HMCTSTrainer(
        make_env,
        loss,
        rounds=1_000_000,  # ended by total_frames
        num_init_samples=args.init,
        retrain_interval=args.interval,
        make_planner=partial(plan_by, budget=SearchBudget(expansions=args.expansions)),
        dataset=dataset,
        make_test_env=partial(make_env, maze_pool("test")),
        make_test_planner=partial(plan_by, budget=SearchBudget(expansions=args.test_expansions)),
        test_rounds=args.test_rounds,
        test_interval=args.test_interval,
        buffer_size=args.buffer,
        total_frames=args.steps,
        seed=seed,
    )
    trainer.train()
    seconds = time.perf_counter() - begin
    final = solve(greedy(loss), args.mazes, seed).summary()
    return {
        "seed": seed,
        "dataset_base_steps": 0 if dataset is None else len(dataset),
        "training_base_steps": trainer.collected_frames,
        "rounds": len(trainer.records),
        "rounds_solved": int(trainer.records.columns["solved"].sum()),
        "trainings": len(trainer.retrained_at),
        "updates": trainer._optim_count,
        "training_seconds": round(seconds, 1),
        "seconds": round(time.perf_counter() - begin, 1),
        "test_curve": {k: v.tolist() for k, v in trainer.test_records.curve().items()},
        "round_curve": {k: v.tolist() for k, v in trainer.records.curve().items()},
        "final": final,
    }


def main() -> None:
    quick = {"seeds": [0], "steps": 4_000, "dataset_steps": 4_032}
    quick.update(test_rounds=8, test_expansions=60, mazes=10)
    args = read_arguments(
        __doc__,
        quick,
        seeds=[0, 1, 2],
        steps=(39_000, "training base steps"),
        dataset_steps=(40_000, "base steps of D"),
        init=(64, "N_init"),
        interval=(4, "N_retrain"),
        expansions=(2, "of a search in training"),
        buffer=(5_000, "transitions of S that are kept"),
        test_rounds=38,
        test_interval=(7, "trainings between tests"),
        test_expansions=300,
        mazes=(342, "test mazes for the final worker"),
    )
    args.out = Path("hmcts_rounds.json") if args.out is None else args.out
    runs: dict[str, list[dict[str, Any]]] = {"from scratch": [], "from D": []}
    for seed in args.seeds:
        for name, seeds in runs.items():
            dataset = record_dataset(seed, args.dataset_steps) if name == "from D" else None
            seeds.append(learn(args, seed, dataset))
            print(name, seed, seeds[-1]["final"]["solved"], flush=True)
    write(args, {"arguments": vars(args), "runs": runs})
    steps = Panel(
        "base_steps",
        "base steps to solve a maze, mean",
        log=True,
        dotted=("executed_steps", "executed only"),
    )
    plot_training(
        {name: [run["test_curve"] for run in seeds] for name, seeds in runs.items()},
        [steps, Panel("solved", "mazes solved", share=True)],
        args.out.with_suffix(".png"),
        title=f"Algorithm 3 in Waterworld: {args.test_rounds} held-out mazes, "
        + (f"{len(args.seeds)} seeds (mean, range)" if len(args.seeds) > 1 else "one seed"),
    )


if __name__ == "__main__":
    main()
