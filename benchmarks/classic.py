"""Classic control, toy text and LunarLander: ``HMCTS(id).solve()`` at its defaults.

    python benchmarks/classic.py --out docs/results/settable/classic.json
    python benchmarks/classic.py LunarLander-v3 --distill --out docs/results/settable/classic.json

Nothing is set by env: the look at each env and one rule for each kind of task choose the search.
An episode is acted in another instance of the env, whose dice the planner does not know. Beside it
stands a policy that draws each action uniformly. With ``--distill`` the search is guided by what
``agent.distill()`` learned, at its defaults. Seconds are of the processor, in one process.
"""

from __future__ import annotations

import argparse
import logging
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from table import add_row

from torchrl_hmcts.trainers import HMCTS

COMMAND = "python benchmarks/classic.py --out docs/results/settable/classic.json"
EPISODES = {
    "CartPole-v1": 10,
    "MountainCar-v0": 10,
    "Acrobot-v1": 10,
    "LunarLander-v3": 10,
    "Taxi-v4": 10,
    "CliffWalking-v1": 10,
    "FrozenLake-v1": 100,
    "Pendulum-v1": 10,
}


def random_returns(name: str, episodes: int) -> list[float]:
    env, returns = gymnasium.make(name), []
    env.action_space.seed(0)
    for seed in range(episodes):
        env.reset(seed=seed)
        paid, over = 0.0, False
        while not over:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            paid, over = paid + float(reward), terminated or truncated
        returns.append(paid)
    return returns


def measure(name: str, episodes: int, distill: bool) -> dict[str, Any]:
    agent = HMCTS(name)
    kit: Any = agent.kit
    begin = time.process_time()
    if distill:
        agent.distill(progress=False)
    learned = {"training_cpu_seconds": round(time.process_time() - begin, 1)} if distill else {}
    agent.kit.make_planner(agent.env).plan(agent.env.reset())  # compiles what is compiled
    solutions, seconds = [], []
    for seed in range(episodes):
        begin = time.process_time()
        solutions.append(agent.solve(seed=seed))
        seconds.append(time.process_time() - begin)
    returns = [solution.reward for solution in solutions]
    reached = None if kit.threshold is None else bool(np.mean(returns) >= kit.threshold)
    return {
        "id": f"{name} distilled" if distill else name,
        **learned,
        "look": str(kit.look),
        "episodes": episodes,
        "mean": round(float(np.mean(returns)), 3),
        "standard_error": round(float(np.std(returns, ddof=1) / episodes**0.5), 3),
        "min": round(min(returns), 3),
        "max": round(max(returns), 3),
        "threshold": kit.threshold,
        "reached": reached,
        "random_mean": round(float(np.mean(random_returns(name, 100))), 3),
        "base_steps": round(float(np.mean([s.base_steps for s in solutions])), 1),
        "simulated_steps": round(float(np.mean([s.simulated_steps for s in solutions]))),
        "cpu_seconds": round(float(np.mean(seconds)), 2),
        "returns": [round(value, 3) for value in returns],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(EPISODES))
    parser.add_argument("--episodes", type=int, help="default: as many as EPISODES says")
    parser.add_argument("--distill", action="store_true", help="learn from searches first")
    parser.add_argument("--out", type=Path, help="rows of other envs stay")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    torch.set_num_threads(1)
    for name in args.names:
        row = measure(name, args.episodes or EPISODES[name], args.distill)
        print(row, flush=True)
        if args.out:
            add_row(args.out, row, "id", command=COMMAND)


if __name__ == "__main__":
    main()
