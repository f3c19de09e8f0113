r"""Planning in a learned option model: test mazes solved without ever setting the real env.

    python benchmarks/option_model.py --seeds 0 1 2 \
        --out docs/results/skills/option_model.json
    python benchmarks/option_model.py --quick

For each seed: trains the demo's worker, records options drawn at random in ordinary episodes of the
training mazes, learns an option model from them, and acts in the test mazes (one episode each of
1,000 base steps at most, by ``reset`` and ``step`` only), planning in the model again after every
option. Beside it the same agent with the true simulator, with less data, with one member instead of
the ensemble, with ensembles heeded, with a memory of what options did earlier in the episode, and
the error of the model by horizon.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import torch
from real_episodes import EpisodesInEachMaze, act
from torchrl.envs import EnvBase, TransformedEnv
from waterworld_options import (
    OptionModelConfig,
    error_by_horizon,
    make_model_env,
    record_transitions,
    train_option_model,
)

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.modules import OptionMemory, OptionModel, SkillPolicy
from torchrl_hmcts.planners import HierarchicalPolicy, MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.experiments.kits import make_kit
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_option_env
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.experiments.skills import learn
from torchrl_hmcts.transforms import OptionTransform

OPTION_STEPS, GAMMA, TIME_LIMIT = 25, 0.99, 1_000


def make_policy(env: EnvBase, args: argparse.Namespace) -> HierarchicalPolicy:
    """Plan again after every option."""
    planner = MCTSPlanner(
        env,
        gamma=GAMMA,
        novelty=RadiusNovelty("position", 0.7, shorter_paths=True),
        leaves_per_wave=4,
        budget=SearchBudget(expansions=args.expansions, improve_expansions=args.improve),
    )
    return HierarchicalPolicy(planner, replan_every=1)


def make_real(worker: SkillPolicy, args: argparse.Namespace, seed: int) -> TransformedEnv:
    episodes = EpisodesInEachMaze(maze_pool("test"), args.mazes, max_steps=TIME_LIMIT, seed=seed)
    return TransformedEnv(episodes, OptionTransform(worker, 4, OPTION_STEPS, GAMMA))


def make_memory(model: OptionModel, args: argparse.Namespace) -> OptionMemory:
    """What the options led to in this episode; mazes are the contexts, one episode each."""
    return OptionMemory(
        model,
        ["position", "velocity", "target"],
        args.memory_radius,
        num_contexts=len(maze_pool("test")),
        context_key="maze_index",
    )


def run_seed(seed: int, args: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows of one seed."""
    loss = learn(make_kit(DemoConfig(seed=seed))).loss
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    rows: list[dict[str, Any]] = []

    def report(name: str, env: EnvBase, **figures: Any) -> None:
        real = make_real(worker, args, seed)
        policy = make_policy(env, args)
        memory = getattr(env, "memory", None)
        episodes = act(policy, real, max_options=args.max_options, memory=memory)
        rows.append({"seed": seed, "name": name, **figures, **episodes.summary()})
        print(json.dumps(rows[-1]), flush=True)

    def errors(model: OptionModel) -> list[float]:
        torch.manual_seed(seed)
        real = make_real(worker, args, seed)
        return error_by_horizon(make_model_env(model, real), real, 8)

    report("true simulator", make_option_env(worker, maze_pool("test")), base_steps=0)
    for base_steps in args.base_steps:
        config = OptionModelConfig(seed=seed, base_steps=base_steps, updates=args.updates)
        data, recorded = record_transitions(worker, config)
        begin = time.perf_counter()
        model = train_option_model(data, config)
        figures = {
            "base_steps": recorded,
            "train_seconds": round(time.perf_counter() - begin, 1),
            "error_by_horizon": errors(model),
        }
        real = make_real(worker, args, seed)
        report("ensemble of 5", make_model_env(model, real), **figures)
        env = make_model_env(model, real, memory=make_memory(model, args))
        report("ensemble of 5 and memory", env, base_steps=recorded)
        if base_steps != args.base_steps[-1] or args.quick:
            continue
        alone = model.member(0)
        report(
            "one member",
            make_model_env(alone, real),
            base_steps=recorded,
            error_by_horizon=errors(alone),
        )
        env = make_model_env(alone, real, memory=make_memory(alone, args))
        report("one member and memory", env, base_steps=recorded)
        for limit in (0.1, 0.3):
            env = make_model_env(model, real, max_disagreement=limit)
            report(f"ends above a disagreement of {limit}", env, base_steps=recorded)
        plain = dataclasses.replace(config, hindsight=0)
        report(
            "without hindsight targets",
            make_model_env(train_option_model(data, plain), real),
            base_steps=recorded,
        )
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a markdown table, seeds side by side."""
    lines = [
        "| planned in | base steps recorded | solved, by seed | share | base steps of an episode, "
        "median | error after 1, 2, 4, 8 options, tiles |",
        "|---|---|---|---|---|---|",
    ]
    groups: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["name"], round(row["base_steps"], -4)), []).append(row)
    for (name, _), group in groups.items():
        solved = " ".join(f"{row['solved']}/{row['mazes']}" for row in group)
        share = sum(row["solved"] for row in group) / sum(row["mazes"] for row in group)
        steps = " ".join(f"{row['episode_steps']['median']:.0f}" for row in group)
        recorded = " ".join(f"{row['base_steps']:,}" for row in group)
        errors = [row["error_by_horizon"] for row in group if "error_by_horizon" in row]
        means = [
            f"{sum(e[i] for e in errors) / len(errors):.2f}"
            for i in (0, 1, 3, 7)
            if errors and i < min(map(len, errors))
        ]
        lines.append(
            f"| {name} | {recorded} | {solved} | {100 * share:.1f} % | {steps} "
            f"| {', '.join(means)} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--mazes", type=int, default=342)
    parser.add_argument(
        "--base-steps", type=int, nargs="+", default=[20_000, 50_000, 100_000, 200_000]
    )
    parser.add_argument("--updates", type=int, default=4_000)
    parser.add_argument("--expansions", type=int, default=300, help="of a search")
    parser.add_argument("--improve", type=int, default=30, help="expansions after the first plan")
    parser.add_argument("--memory-radius", type=float, default=0.5, help="tiles, tiles per second")
    parser.add_argument("--max-options", type=int, default=60, help="of an episode")
    parser.add_argument("--quick", action="store_true", help="1 seed, 30 mazes, few updates")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.quick:
        args.seeds, args.mazes, args.base_steps, args.updates = args.seeds[:1], 30, [50_000], 500

    rows = [row for seed in args.seeds for row in run_seed(seed, args)]
    arguments = {k: str(v) if isinstance(v, Path) else v for k, v in vars(args).items()}
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps({"arguments": arguments, "rows": rows}, indent=2) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
