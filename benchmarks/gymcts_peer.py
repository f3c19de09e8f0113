"""`gymcts` and our planner on the same envs, with the same simulations or the same seconds a move.

    pip install --no-deps gymcts==1.5.1 && pip install rich  # it asks for an older matplotlib
    python benchmarks/gymcts_peer.py --out docs/results/settable/gymcts.json

Single actions, a search before every move, 10 seeds. What acts:

- ``gymcts, deep copies`` and ``gymcts, action history``: its agent over its two wrappers, its
  defaults, the tree kept between moves as in its examples. Its rollouts end where an episode
  terminates, so a truncation is told to it as a termination; its second wrapper resets the env
  without a seed, so its env resets to one seed.
- ``ours, rollouts``: the same search, UCT and a random rollout to the end from each new node,
  ``RolloutEvaluator``, eight leaves a wave; two where seconds count, so that no wave takes longer
  than they are.
- ``ours, options``: actions repeated for some steps, whose rollouts stay in the tree,
  ``TreeRollout(20)``; at most as many simulations, each of which is one option. It stops at a plan.

A simulation of the first three is a rollout to the end. Nothing is kept between our moves. Ours
plans in one env and acts in another; seeds give both libraries starts of the same distribution.
Seconds are those of the processor.
"""

from __future__ import annotations

import argparse
import functools
import importlib.metadata
import json
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch

from torchrl_hmcts.envs import OptionPool, RepeatActions
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.planners import MCTSPlanner, RolloutEvaluator, SearchBudget, TreeRollout


class Task(NamedTuple):
    """An env, what is spent on a move, and what counts as solved."""

    keywords: dict[str, Any]
    simulations: int  # a move
    seconds: float  # a move
    moves: int
    repeats: int  # steps of our options
    solved: Callable[[float], bool]  # by the return


def positive(gained: float) -> bool:
    return gained > 0


TASKS: dict[str, Task] = {
    "FrozenLake-v1": Task({"is_slippery": False}, 50, 0.1, 30, 1, positive),
    "CliffWalking-v1": Task({"max_episode_steps": 40}, 30, 0.05, 40, 1, lambda r: r > -40),
    "CartPole-v1": Task({"max_episode_steps": 100}, 10, 0.02, 100, 2, lambda r: r >= 100),
    "MiniGrid-Empty-5x5-v0": Task({}, 10, 0.1, 15, 2, positive),
    "MiniGrid-FourRooms-v0": Task({"max_steps": 50}, 10, 0.1, 50, 4, positive),
}


class Counted(gymnasium.Wrapper):
    """Begins every episode with one seed, ends it where it is truncated, counts all steps."""

    steps = 0  # of all copies

    def __init__(self, env: gymnasium.Env, seed: int) -> None:
        super().__init__(env)
        self.start = seed

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.env.reset(seed=self.start, options=options)

    def step(self, action: Any) -> Any:
        Counted.steps += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated or truncated, truncated, info


def theirs(name: str, wrapper: Any, seed: int, seconds: float | None) -> dict[str, float]:
    """One episode of gymcts."""
    from gymcts.gymcts_agent import GymctsAgent

    task = TASKS[name]
    random.seed(seed)
    env = Counted(make_gym(name, **task.keywords), seed)
    env.reset()
    agent = GymctsAgent(env=wrapper(env), clear_mcts_tree_after_step=False)
    Counted.steps, simulations, actions = 0, 0, []
    cpu = time.process_time()
    while not agent.search_root_node.terminal and len(actions) < task.moves:
        root, until = agent.search_root_node, time.process_time() + (seconds or 0.0)
        while True:  # the first call of a root makes its children, which takes two
            count = task.simulations if seconds is None else 1 if root.children else 2
            agent.vanilla_mcts_search(search_start_node=root, num_simulations=count)
            simulations += count
            if seconds is None or time.process_time() >= until:
                break
        actions.append(agent.perform_mcts_step(num_simulations=0)[0])
    spent = time.process_time() - cpu
    steps, gained = Counted.steps, 0.0
    env.reset()
    for action in actions:
        _, reward, ended, *_ = env.step(action)
        gained += float(reward)
        if ended:
            break
    return {"cpu": spent, "simulations": simulations, "steps": steps, "return": gained}


def ours(name: str, options: bool, seed: int, seconds: float | None) -> dict[str, float]:
    """One episode of our planner."""
    task = TASKS[name]
    torch.manual_seed(seed)
    actions = RepeatActions(int(make_gym(name, **task.keywords).action_space.n))
    settings: dict[str, Any] = {"max_steps": task.repeats if options else 1, "num_processes": 0}
    make = functools.partial(make_gym, name, **task.keywords)
    model, real = (OptionPool(make, actions, seed=seed, **settings) for _ in range(2))
    at_once = 16 if options else 2  # simulations between two looks at the clock
    count = task.simulations if seconds is None else at_once
    planner = MCTSPlanner(
        model,
        expand="one",
        leaves_per_wave=min(8, count),
        rollout=TreeRollout(20) if options else None,
        leaf_evaluator=None if options else RolloutEvaluator(max_options=task.moves),
        budget=SearchBudget(simulations=count, until_plan=options),
        seed=seed,
    )
    td, gained, moves, simulations, before = real.reset(), 0.0, 0, 0, model.num_steps
    cpu = time.process_time()
    while not td["done"] and moves < task.moves:
        search, until = planner.plant(td), time.process_time() + (seconds or 0.0)
        while True:
            planner.resume(search)
            made = int(search.num_simulations[0])
            simulations += made
            found = options and int(search.best_node[0]) >= 0
            if not made or found or time.process_time() >= until:
                break
        td = real.step(td.set("option", torch.from_numpy(planner.choose(search))[0]))["next"]
        gained += float(td["reward"]) if not options else _undiscounted(td)
        moves += int(td["duration"])
        td = td.exclude("reward")
    spent = time.process_time() - cpu
    steps = model.num_steps - before
    return {"cpu": spent, "simulations": simulations, "steps": steps, "return": gained}


def _undiscounted(td: Any) -> float:
    """The rewards of an option: all of them 1 or -1 a step, or one at its end."""
    reward, steps = float(td["reward"]), int(td["duration"])
    whole = sum(0.99**i for i in range(steps))
    return steps * reward / whole if abs(abs(reward) - whole) < 1e-4 else reward


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", default=list(TASKS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--budgets", nargs="+", default=["simulations", "seconds"])
    parser.add_argument("--players", nargs="*", help="default: all four")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    from gymcts.gymcts_action_history_wrapper import ActionHistoryMCTSGymEnvWrapper
    from gymcts.gymcts_deepcopy_wrapper import DeepCopyMCTSGymEnvWrapper
    from gymcts.logger import log

    log.setLevel(40)
    players: dict[str, Callable[[str, int, float | None], dict[str, float]]] = {
        "gymcts, deep copies": lambda *a: theirs(a[0], DeepCopyMCTSGymEnvWrapper, *a[1:]),
        "gymcts, action history": lambda *a: theirs(a[0], ActionHistoryMCTSGymEnvWrapper, *a[1:]),
        "ours, rollouts": lambda *a: ours(a[0], False, *a[1:]),
        "ours, options": lambda *a: ours(a[0], True, *a[1:]),
    }
    rows: list[dict[str, Any]] = []
    for name in args.ids:
        task = TASKS[name]
        for budget in args.budgets:
            seconds = task.seconds if budget == "seconds" else None
            for player in args.players or players:
                play = players[player]
                runs = [play(name, seed, seconds) for seed in range(args.seeds)]
                total = {key: sum(run[key] for run in runs) for key in runs[0]}
                rows.append(
                    {
                        "id": name,
                        "a_move": f"{task.simulations} simulations"
                        if seconds is None
                        else f"{seconds} CPU-s",
                        "player": player,
                        "solved": sum(task.solved(run["return"]) for run in runs),
                        "seeds": args.seeds,
                        "mean_return": round(float(np.mean([run["return"] for run in runs])), 2),
                        "simulations_per_cpu_second": round(total["simulations"] / total["cpu"]),
                        "base_steps_per_cpu_second": round(total["steps"] / total["cpu"]),
                        "cpu_seconds_an_episode": round(total["cpu"] / args.seeds, 2),
                    }
                )
                print(rows[-1], flush=True)
                if args.out:
                    _write(args.out, rows)


def _write(out: Path, rows: list[dict[str, Any]]) -> None:
    packages = ("gymcts", "gymnasium", "minigrid", "torchrl", "numpy")
    content = {
        "command": "python benchmarks/gymcts_peer.py --out docs/results/settable/gymcts.json",
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "load": round(os.getloadavg()[1], 1),
        "tasks": {
            name: {k: v for k, v in task._asdict().items() if k != "solved"}
            for name, task in TASKS.items()
        },
        "rows": rows,
    }
    out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
