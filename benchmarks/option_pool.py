"""Base steps per CPU-second of options under a planner, against the same worker in a bare loop.

    python benchmarks/option_pool.py --out docs/results/settable/option_pool.json

In turns, for as many rounds as asked: a plain loop over the same env, with the same worker and an
option drawn every 10 steps, and a search of :class:`MCTSPlanner` over an :class:`OptionPool`, which
is planner, tree, snapshots and bookkeeping. CPU time is that of all processes. The figure is the
ratio within a round, so that a busy machine slows both.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.envs import GymWrapper

from torchrl_hmcts.envs import OptionPool, SkillWorker
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.modules import SkillActor
from torchrl_hmcts.planners import MCTSPlanner, SearchBudget
from torchrl_hmcts.processes import cpu_ticks

ENVS: dict[str, dict[str, Any]] = {
    "CartPole-v1": {},
    "MiniGrid-FourRooms-v0": {},
    "PointMaze_Large-v3": {},
    "HalfCheetah-v5": {},
    "ALE/Breakout-v5": {"repeat_action_probability": 0.0, "obs_type": "ram"},
}
OPTION_STEPS, NUM_OPTIONS, TICKS = 10, 4, 100


class Balance:
    """Keeps CartPole's pole up and leans it a little, so that options have all their steps."""

    num_options = NUM_OPTIONS

    def act(self, observation: np.ndarray, option: int, generator: np.random.Generator) -> int:
        _, speed, angle, spin = observation.tolist()
        return int(angle + 0.5 * spin + 0.05 * speed > 0.01 * (option - 1.5))


def make_worker(name: str) -> Any:
    """Return an untrained actor of skills; for CartPole, where it soon falls, a rule."""
    if name == "CartPole-v1":
        return Balance()
    env = GymWrapper(make_gym(name, **ENVS[name]), categorical_action_encoding=True)
    key = "image" if "image" in env.observation_spec.keys() else "observation"
    torch.manual_seed(0)
    size = env.observation_spec[key].shape.numel()
    return SkillWorker(SkillActor(size, env.action_spec, NUM_OPTIONS, in_keys=[key]))


def bare(name: str, worker: Any, seconds: float) -> float:
    """Base steps per CPU-second of a plain loop."""
    env, draws = make_gym(name, **ENVS[name]), np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    act, steps, begin = worker.act, 0, time.process_time()
    while time.process_time() - begin < seconds:
        option = int(draws.integers(worker.num_options))
        for _ in range(OPTION_STEPS):
            action = act(observation, option, draws)
            observation, _, terminated, truncated, _ = env.step(action)
            steps += 1
            if terminated or truncated:
                observation, _ = env.reset()
                break
    return steps / (time.process_time() - begin)


class Planned:
    """Searches of a planner from the beginning of an episode."""

    def __init__(self, name: str, worker: Any, processes: int, steps: int) -> None:
        self.pool = OptionPool(
            name, worker, max_steps=OPTION_STEPS, num_processes=processes, seed=0, **ENVS[name]
        )
        budget = SearchBudget(base_steps=steps, until_plan=False)
        waves = 2 if processes else 1
        self.planner = MCTSPlanner(
            self.pool, expand="one", leaves_per_wave=64, waves_in_flight=waves, budget=budget
        )
        self.planner.search(self.pool.reset())  # starts the processes

    def run(self) -> float:
        """Base steps per CPU-second of one search."""
        td, before, begin = self.pool.reset(), self.pool.num_steps, self._cpu()
        self.planner.search(td)
        return (self.pool.num_steps - before) / (self._cpu() - begin)

    def _cpu(self) -> float:
        return time.process_time() + sum(map(cpu_ticks, self.pool.pids)) / TICKS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", default=list(ENVS))
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=3.0, help="of the bare loop in a round")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name in args.ids:
        worker = make_worker(name)
        speed = bare(name, worker, 0.5)
        for processes in (0, 1):
            planned = Planned(name, worker, processes, int(speed * args.seconds))
            rounds = [(planned.run(), bare(name, worker, args.seconds)) for _ in range(args.rounds)]
            planned.pool.close()
            ours, theirs = (statistics.median(column) for column in zip(*rounds, strict=True))
            ratio = statistics.median(a / b for a, b in rounds)
            row = {"id": name, "processes": processes, "planned": round(ours)}
            rows.append({**row, "bare": round(theirs), "ratio": round(ratio, 3)})
            print(rows[-1], flush=True)
    if args.out:
        command = "python benchmarks/option_pool.py --out docs/results/settable/option_pool.json"
        content = {"command": command, "option_steps": OPTION_STEPS, "rows": rows}
        args.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
