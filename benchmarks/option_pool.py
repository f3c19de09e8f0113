"""Base steps per CPU-second of options under a planner, against the same worker in a bare loop.

    python benchmarks/option_pool.py --out docs/results/settable/option_pool.json

In turns, for as many rounds as asked: a plain loop over the same env, with the same worker and an
option drawn every 10, 20 or 50 steps, and a search of :class:`MCTSPlanner` over an
:class:`OptionPool`, which is planner, tree, snapshots and bookkeeping. CPU time is that of all
processes. The figure is the ratio within a round, so that a busy machine slows both.

The planner explores broadly, ``PUCT(c=5, normalize="siblings")``, takes 240 options a wave at most,
and with processes has two waves under way; a narrow search has smaller waves, each of which costs
half a millisecond.

Two processes against one, in base steps per second: by the clock, the fastest of all rounds, which
another program may still have slowed; and as it would be on two free cores, from the CPU time of
each process: one process works beside the planner, two share the two cores with it.
"""

from __future__ import annotations

import argparse
import json
import os
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
from torchrl_hmcts.planners import PUCT, MCTSPlanner, SearchBudget
from torchrl_hmcts.processes import cpu_ticks

ENVS: dict[str, dict[str, Any]] = {
    "CartPole-v1": {},
    "MiniGrid-FourRooms-v0": {},
    "PointMaze_Large-v3": {},
    "HalfCheetah-v5": {},
    "ALE/Breakout-v5": {"repeat_action_probability": 0.0, "obs_type": "ram"},
}
NUM_OPTIONS, TICKS = 4, 100


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


def bare(name: str, worker: Any, option_steps: int, seconds: float) -> float:
    """Base steps per CPU-second of a plain loop."""
    env, draws = make_gym(name, **ENVS[name]), np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    act, steps, begin = worker.act, 0, time.process_time()
    while time.process_time() - begin < seconds:
        option = int(draws.integers(worker.num_options))
        for _ in range(option_steps):
            action = act(observation, option, draws)
            observation, _, terminated, truncated, _ = env.step(action)
            steps += 1
            if terminated or truncated:
                observation, _ = env.reset()
                break
    return steps / (time.process_time() - begin)


class Planned:
    """Searches of a planner from the beginning of an episode."""

    def __init__(
        self, name: str, worker: Any, option_steps: int, processes: int, steps: int
    ) -> None:
        self.pool = OptionPool(
            name, worker, max_steps=option_steps, num_processes=processes, seed=0, **ENVS[name]
        )
        budget = SearchBudget(base_steps=steps, until_plan=False)
        waves = 2 if processes else 1
        self.planner = MCTSPlanner(
            self.pool,
            tree_policy=PUCT(c=5.0, normalize="siblings"),
            expand="one",
            leaves_per_wave=240 // waves,
            waves_in_flight=waves,
            budget=budget,
        )
        self.planner.search(self.pool.reset())  # starts the processes

    def run(self) -> dict[str, float]:
        """Base steps of one search, options, and seconds: of the clock, planner and processes."""
        td, before, begin = self.pool.reset(), self.pool.num_steps, self._seconds()
        search = self.planner.search(td)
        wall, own, theirs = (now - then for now, then in zip(self._seconds(), begin, strict=True))
        options = int(search.num_simulations.sum())
        steps = self.pool.num_steps - before
        return {"steps": steps, "options": options, "wall": wall, "own": own, "theirs": theirs}

    def _seconds(self) -> tuple[float, float, float]:
        theirs = sum(map(cpu_ticks, self.pool.pids)) / TICKS
        return time.perf_counter(), time.process_time(), theirs


def ratios(name: str, option_steps: int, args: Any) -> list[dict[str, Any]]:
    """Compare the planner with the bare loop, in the same process and over one."""
    worker, rows = make_worker(name), []
    bare(name, worker, option_steps, 0.2)  # compiles the worker
    speed = bare(name, worker, option_steps, 0.5)
    for processes in (0, 1):
        planned = Planned(name, worker, option_steps, processes, int(speed * args.seconds))
        pairs = []
        for _ in range(args.rounds):
            run = planned.run()
            ours = run["steps"] / (run["own"] + run["theirs"])
            pairs.append((ours, bare(name, worker, option_steps, args.seconds)))
        planned.pool.close()
        shares = sorted(a / b for a, b in pairs)
        ours, theirs = (round(statistics.median(column)) for column in zip(*pairs, strict=True))
        rows.append(
            {
                "id": name,
                "option_steps": option_steps,
                "processes": processes,
                "planned": ours,
                "bare": theirs,
                "ratio": round(statistics.median(shares), 3),
                "lowest": round(shares[0], 3),
                "highest": round(shares[-1], 3),
            }
        )
        print(rows[-1], flush=True)
    return rows


def speed_up(name: str, args: Any) -> dict[str, Any]:
    """Compare two processes with one, with options of 10 steps."""
    worker = make_worker(name)
    steps = int(bare(name, worker, 10, 1.0) * args.seconds)
    planned = [Planned(name, worker, 10, processes, steps) for processes in (1, 2)]
    clock: list[list[float]] = [[], []]
    cores: list[list[float]] = [[], []]
    for _ in range(2 * args.rounds):
        for k in range(2):
            run = planned[k].run()
            clock[k].append(run["steps"] / run["wall"])
            two = (run["own"] + run["theirs"]) / 2
            cores[k].append(run["steps"] / (two if k else max(run["own"], run["theirs"])))
    for each in planned:
        each.pool.close()
    row = {
        "id": name,
        "option_steps": 10,
        "by_the_clock": round(max(clock[1]) / max(clock[0]), 2),
        "on_free_cores": round(statistics.median(cores[1]) / statistics.median(cores[0]), 2),
    }
    print(row, flush=True)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", default=list(ENVS))
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="of the bare loop in a round")
    parser.add_argument("--option-steps", type=int, nargs="+", default=[10, 20, 50])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = [row for name in args.ids for k in args.option_steps for row in ratios(name, k, args)]
    two = [speed_up(name, args) for name in args.ids]
    if args.out:
        command = (
            f"python benchmarks/option_pool.py --rounds {args.rounds} --seconds {args.seconds} "
            "--out docs/results/settable/option_pool.json"
        )
        content = {
            "command": command,
            "load": os.getloadavg()[1],
            "rows": rows,
            "two_processes_against_one": two,
        }
        args.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
