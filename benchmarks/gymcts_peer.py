"""`gymcts` and our planner on the same envs, with the same CPU-seconds a step.

    pip install --no-deps gymcts==1.5.1 && pip install rich  # it asks for an older matplotlib
    python benchmarks/gymcts_peer.py --out docs/results/settable/gymcts.json

All but the last search before every move, for as long as the others, and keep the tree between
moves. Players:

- ``gymcts, deep copies`` and ``gymcts, action history``: its agent over its two wrappers, its
  defaults, single actions, the tree kept as in its examples. Its rollouts end where an episode
  terminates, so it gets a truncation as a termination; its second wrapper resets the env
  without a seed, so its env resets to one seed.
- ``ours, rollouts``: the same search, single actions, UCT and a random rollout to the end from each
  new node, ``RolloutEvaluator``, two leaves a wave, so that no wave takes longer than a move has.
- ``ours, options``: actions repeated for some steps, whose rollouts stay in the tree,
  ``TreeRollout(20)``; a search has the seconds of all these steps. No novelty test.
- ``ours, the kit``: ``HMCTS(id, options="actions").solve()`` at its defaults: a novelty test, and
  one plan where there is a goal. An episode that took more seconds than the others are given in
  ``moves`` steps counts as not solved. In CartPole, ``search_steps=300`` keep it within them.

A simulation of the first three is a rollout to the end, one of the others an option. Ours plans in
one env and acts in another; seeds give both libraries starts of the same distribution. Seconds are
those of the processor.
"""

from __future__ import annotations

import argparse
import functools
import importlib.metadata
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from table import add_row

from torchrl_hmcts.envs import OptionPool, RepeatActions
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.planners import MCTSPlanner, RolloutEvaluator, SearchBudget, TreeRollout
from torchrl_hmcts.trainers import HMCTS

COMMAND = "python benchmarks/gymcts_peer.py --out docs/results/settable/gymcts.json"


class Task(NamedTuple):
    """An env, what is spent on a step, and what counts as solved."""

    make: dict[str, Any]
    seconds: float  # a step
    moves: int
    repeats: int  # steps of our options
    solved: Callable[[float], bool]  # by the return
    keys: dict[str, Any] = {}  # of the kit


def positive(gained: float) -> bool:
    return gained > 0


TASKS: dict[str, Task] = {
    "FrozenLake-v1": Task({"is_slippery": False}, 0.1, 30, 1, positive),
    "CliffWalking-v1": Task({"max_episode_steps": 40}, 0.05, 40, 1, lambda r: r > -40),
    "CartPole-v1": Task(
        {"max_episode_steps": 100}, 0.02, 100, 2, lambda r: r >= 100, {"search_steps": 300}
    ),
    "MiniGrid-Empty-5x5-v0": Task({}, 0.1, 15, 1, positive),
    "MiniGrid-FourRooms-v0": Task({"max_steps": 50}, 0.1, 50, 1, positive),
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


def theirs(name: str, wrapper: Any, seed: int) -> dict[str, float]:
    """One episode of gymcts."""
    from gymcts.gymcts_agent import GymctsAgent

    task = TASKS[name]
    random.seed(seed)
    env = Counted(make_gym(name, **task.make), seed)
    env.reset()
    agent = GymctsAgent(env=wrapper(env), clear_mcts_tree_after_step=False)
    Counted.steps, simulations, actions = 0, 0, []
    cpu = time.process_time()
    while not agent.search_root_node.terminal and len(actions) < task.moves:
        root, until = agent.search_root_node, time.process_time() + task.seconds
        while time.process_time() < until:
            count = 1 if root.children else 2  # the first call of a root makes its children
            agent.vanilla_mcts_search(search_start_node=root, num_simulations=count)
            simulations += count
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


def ours(name: str, options: bool, seed: int) -> dict[str, float]:
    """One episode of our planner."""
    task = TASKS[name]
    torch.manual_seed(seed)
    actions = RepeatActions(int(make_gym(name, **task.make).action_space.n))
    repeats = task.repeats if options else 1
    make = functools.partial(make_gym, name, **task.make)
    pools = {
        gamma: OptionPool(make, actions, seed=seed, max_steps=repeats, num_processes=0, gamma=gamma)
        for gamma in (0.99, 1.0)
    }
    model, real = pools.values()
    planner = MCTSPlanner(
        model,
        expand="one",
        leaves_per_wave=8 if options else 2,
        rollout=TreeRollout(20) if options else None,
        leaf_evaluator=None if options else RolloutEvaluator(max_options=task.moves),
        budget=SearchBudget(simulations=16 if options else 2, until_plan=False),
        seed=seed,
    )
    td, gained, moves, simulations, before = real.reset(), 0.0, 0, 0, model.num_steps
    cpu = time.process_time()
    search = planner.plant(td)
    while True:
        until = time.process_time() + task.seconds * repeats
        while time.process_time() < until:
            planner.resume(search)
            made = int(search.num_simulations[0])
            simulations += made
            if not made:
                break
        option = torch.from_numpy(planner.choose(search))[0]
        td = real.step(td.set("option", option))["next"]
        gained += float(td["reward"])
        moves += int(td["duration"])
        td = td.exclude("reward")
        if td["done"] or moves >= task.moves:
            break
        planner.advance(search, option, td)
    spent = time.process_time() - cpu
    steps = model.num_steps - before
    return {"cpu": spent, "simulations": simulations, "steps": steps, "return": gained}


@functools.cache
def agent_of(name: str) -> HMCTS:
    agent = HMCTS(name, options="actions", make=TASKS[name].make, **TASKS[name].keys)
    agent.solve(seed=100)  # compiles what is compiled
    return agent


def kit(name: str, seed: int) -> dict[str, float]:
    """One episode of the kit."""
    task, agent = TASKS[name], agent_of(name)
    options = 0

    def count(before: Any, after: Any) -> None:
        nonlocal options
        options += after["duration"].numel()

    agent.env.on_step = count
    cpu = time.process_time()
    found = agent.solve(seed=seed)
    spent = time.process_time() - cpu
    in_time = spent <= task.seconds * task.moves
    gained = found.reward if in_time else -np.inf
    return {
        "cpu": spent,
        "simulations": options,
        "steps": found.simulated_steps,
        "return": gained,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", default=list(TASKS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--players", nargs="*", help="default: all five")
    parser.add_argument("--out", type=Path, help="rows of other envs and players stay")
    args = parser.parse_args()
    torch.set_num_threads(1)
    from gymcts.gymcts_action_history_wrapper import ActionHistoryMCTSGymEnvWrapper
    from gymcts.gymcts_deepcopy_wrapper import DeepCopyMCTSGymEnvWrapper
    from gymcts.logger import log

    log.setLevel(40)
    players: dict[str, Callable[[str, int], dict[str, float]]] = {
        "gymcts, deep copies": lambda name, k: theirs(name, DeepCopyMCTSGymEnvWrapper, k),
        "gymcts, action history": lambda name, k: theirs(name, ActionHistoryMCTSGymEnvWrapper, k),
        "ours, rollouts": lambda name, k: ours(name, False, k),
        "ours, options": lambda name, k: ours(name, True, k),
        "ours, the kit": kit,
    }
    packages = ("gymcts", "gymnasium", "minigrid", "torchrl", "numpy")
    versions = {name: importlib.metadata.version(name) for name in packages}
    for name in args.ids:
        task = TASKS[name]
        for player in args.players or players:
            runs = [players[player](name, seed) for seed in range(args.seeds)]
            total = {key: sum(run[key] for run in runs) for key in runs[0]}
            row = {
                "what": f"{name}, {player}",
                "id": name,
                "player": player,
                "seconds_a_step": task.seconds,
                "solved": sum(task.solved(run["return"]) for run in runs),
                "seeds": args.seeds,
                "simulations_per_cpu_second": round(total["simulations"] / total["cpu"]),
                "base_steps_per_cpu_second": round(total["steps"] / total["cpu"]),
                "cpu_seconds_an_episode": round(total["cpu"] / args.seeds, 2),
                "load": round(os.getloadavg()[1], 1),
            }
            print(row, flush=True)
            if args.out:
                add_row(args.out, row, "what", command=COMMAND, versions=versions)


if __name__ == "__main__":
    main()
