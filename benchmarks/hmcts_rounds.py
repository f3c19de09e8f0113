"""Algorithm 3 in Waterworld: base steps to solve a maze against training base steps.

    python benchmarks/hmcts_rounds.py --out docs/results/skills/hmcts_rounds.json
    python benchmarks/hmcts_rounds.py --quick

For each seed, skills are learned by the rounds of ``HMCTSTrainer``, from scratch and from a dataset
D of 40,000 base steps that an earlier training of skills recorded in other episodes. The curve is
that of test rounds in held-out mazes with the greedy worker; at the end the final worker plans in
all test mazes. Writes the figures as JSON, the curves as PNG beside it, and prints a table.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.evaluation import plan_and_execute
from torchrl_hmcts.trainers.experiments.demo import make_starts
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_option_env, make_training_env
from torchrl_hmcts.trainers.figures.curves import Panel, plot_training
from torchrl_hmcts.trainers.hmcts import HMCTSTrainer

NUM_SKILLS, OPTION_STEPS, RADIUS = 4, 25, 0.7
make_env = partial(WaterworldMazeEnv, observation=False)
plan_by = partial(
    MCTSPlanner, novelty=RadiusNovelty("position", RADIUS, shorter_paths=True), leaves_per_wave=4
)


def record_dataset(seed: int, base_steps: int) -> TensorDictBase:
    """Return what a training of skills, drawn at random, took in other episodes and seeds."""
    env = make_training_env(num_skills=NUM_SKILLS)
    loss = DIAYNTrainer.make_loss(env, NUM_SKILLS, seed=1000 + seed)
    trainer = DIAYNTrainer(
        env, loss, total_frames=base_steps, buffer_size=base_steps, seed=1000 + seed
    )
    trainer.train()
    # The rewards are those of the discriminator that was thrown away; they are written anew.
    return trainer.replay_buffer.storage[:]


def learn(args: argparse.Namespace, seed: int, dataset: TensorDictBase | None) -> dict[str, Any]:
    """Run Algorithm 3 once; return its curves and figures."""
    begin = time.perf_counter()
    loss = DIAYNTrainer.make_loss(make_training_env(copies=1), NUM_SKILLS, seed=seed)
    trainer = HMCTSTrainer(
        make_env,
        loss,
        rounds=1_000_000,  # ended by total_frames
        num_init_samples=args.init,
        retrain_interval=args.interval,
        option_steps=OPTION_STEPS,
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
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    simulator, real = (
        make_option_env(worker, maze_pool("test"), option_steps=OPTION_STEPS) for _ in range(2)
    )
    planner = plan_by(simulator, budget=SearchBudget(expansions=1000))
    starts = make_starts(real.base_env, args.mazes, seed)
    final = plan_and_execute(planner, real, starts).summary()
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


def table(runs: dict[str, list[dict[str, Any]]]) -> str:
    """Return the figures of all runs in Markdown."""
    lines = [
        "| worker | seed | training base steps | rounds | test mazes solved "
        "| simulated base steps, median | executed, median |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, seeds in runs.items():
        for run in seeds:
            final = run["final"]
            lines.append(
                f"| {name} | {run['seed']} | {run['training_base_steps']:,} | {run['rounds']} | "
                f"{final['solved']} of {final['starts']} | "
                f"{final['simulated_steps']['median']:,.0f} | "
                f"{final['episode_steps']['median']:,.0f} |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--out", type=Path, default=Path("hmcts_rounds.json"))
    parser.add_argument("--quick", action="store_true", help="one seed, few steps and mazes")
    parser.add_argument("--steps", type=int, default=39_000, help="training base steps")
    parser.add_argument("--dataset-steps", type=int, default=40_000, help="base steps of D")
    parser.add_argument("--init", type=int, default=64, help="N_init")
    parser.add_argument("--interval", type=int, default=4, help="N_retrain")
    parser.add_argument("--expansions", type=int, default=2, help="of a search in training")
    parser.add_argument("--buffer", type=int, default=5_000, help="transitions of S that are kept")
    parser.add_argument("--test-rounds", type=int, default=38)
    parser.add_argument("--test-interval", type=int, default=7, help="trainings between tests")
    parser.add_argument("--test-expansions", type=int, default=300)
    parser.add_argument("--mazes", type=int, default=342, help="test mazes for the final worker")
    args = parser.parse_args()
    if args.quick:
        args.seeds, args.steps, args.dataset_steps = args.seeds[:1], 4_000, 4_032
        args.test_rounds, args.test_expansions, args.mazes = 8, 60, 10
    torch.set_num_threads(1)
    runs: dict[str, list[dict[str, Any]]] = {"from scratch": [], "from D": []}
    for seed in args.seeds:
        for name, seeds in runs.items():
            dataset = record_dataset(seed, args.dataset_steps) if name == "from D" else None
            seeds.append(learn(args, seed, dataset))
            print(table({name: seeds[-1:]}).splitlines()[-1], flush=True)
    arguments = {k: str(v) if isinstance(v, Path) else v for k, v in vars(args).items()}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"arguments": arguments, "runs": runs}, indent=2) + "\n")
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
    print("\n" + table(runs))


if __name__ == "__main__":
    main()
