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
from typing import Any

import torch
from mazes import demo_loss, greedy, make_option_env, planner
from real_episodes import EpisodesInEachMaze, act
from table import markdown, read_arguments, write
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
from torchrl_hmcts.planners import HierarchicalPolicy, SearchBudget
from torchrl_hmcts.transforms import OptionTransform

OPTION_STEPS, GAMMA, TIME_LIMIT = 25, 0.99, 1_000


def make_policy(env: EnvBase, args: argparse.Namespace) -> HierarchicalPolicy:
    """Plan again after every option."""
    budget = SearchBudget(expansions=args.expansions, improve_expansions=args.improve)
    return HierarchicalPolicy(planner(env, budget=budget, gamma=GAMMA), replan_every=1)


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
    worker = greedy(demo_loss(seed))
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


def error_means(group: list[dict[str, Any]]) -> str:
    errors = [row["error_by_horizon"] for row in group if "error_by_horizon" in row]
    reached = min(map(len, errors), default=0)
    return ", ".join(
        f"{sum(e[i] for e in errors) / len(errors):.2f}" for i in (0, 1, 3, 7) if i < reached
    )


COLUMNS = {
    "planned in": lambda group: group[0]["name"],
    "base steps recorded": lambda group: " ".join(f"{r['base_steps']:,}" for r in group),
    "solved, by seed": lambda group: " ".join(f"{r['solved']}/{r['mazes']}" for r in group),
    "share": lambda group: (
        f"{100 * sum(r['solved'] for r in group) / sum(r['mazes'] for r in group):.1f} %"
    ),
    "base steps of an episode, median": lambda group: " ".join(
        f"{r['episode_steps']['median']:.0f}" for r in group
    ),
    "error after 1, 2, 4, 8 options, tiles": error_means,
}


def main() -> None:
    quick = {"seeds": [0], "mazes": 30, "base_steps": [50_000], "updates": 500}
    args = read_arguments(
        __doc__,
        quick,
        seeds=[0, 1, 2],
        mazes=342,
        base_steps=[20_000, 50_000, 100_000, 200_000],
        updates=4_000,
        expansions=(300, "of a search"),
        improve=(30, "expansions after the first plan"),
        memory_radius=(0.5, "tiles, tiles per second"),
        max_options=(60, "of an episode"),
    )
    rows = [row for seed in args.seeds for row in run_seed(seed, args)]
    write(args, {"arguments": vars(args), "rows": rows})
    groups: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["name"], round(row["base_steps"], -4)), []).append(row)
    print(markdown(groups.values(), COLUMNS))


if __name__ == "__main__":
    main()
