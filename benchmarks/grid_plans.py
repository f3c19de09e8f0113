"""Plans in MiniGrid at one set of options and one search for all of its envs.

    python benchmarks/grid_plans.py --out docs/results/settable/minigrid.json

Options: go one cell right, down, left or up, pick up, drop, toggle, done (:class:`GridMoves`), each
where it changes something (the mask of :class:`GridView`, which also leaves out the pictures).
Novelty: pairs of the pose with all else that changes, in stages (:class:`GridFeatures`). Nothing is
tuned to an env. A plan is searched for from the first state of the episode of each seed until the
first one is found, for at most 60 CPU-seconds or 130,000 nodes; it is solved if its options,
executed in another instance of the env as it is registered, pay more than 0. CPU-seconds are those
of the search, in one process.

Beside it, on fewer seeds: the same search with no novelty test; with one for the whole state; with
the env's actions as options; and in the env with its pictures, without a mask.
"""

from __future__ import annotations

import argparse
import logging
import time
import warnings
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from table import add_row

from torchrl_hmcts.envs import GridFeatures, GridMoves, GridView, OptionPool, RepeatActions
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.planners import MCTSPlanner, Search, SearchBudget, WidthNovelty

MAIN = ["FourRooms", "KeyCorridorS3R3", "DoorKey-16x16", "ObstructedMaze-1Dlhb"]
WIDER = [
    "Unlock", "UnlockPickup", "BlockedUnlockPickup", "MultiRoom-N6", "KeyCorridorS6R3",
    "LavaCrossingS11N5", "Dynamic-Obstacles-16x16", "BossLevel",
]  # fmt: skip
COMMAND = "python benchmarks/grid_plans.py --out docs/results/settable/minigrid.json"
SECONDS, NODES, CHUNK = 60.0, 130_000, 5_000  # base steps between two looks at the clock


def full_name(name: str) -> str:
    return f"BabyAI-{name}-v0" if name == "BossLevel" else f"MiniGrid-{name}-v0"


def view(name: str, moves: bool) -> gymnasium.Env:
    return GridView(make_gym(name), moves=moves)


class WholeState:
    """One number for all that may differ between two states but the number of steps."""

    def __call__(self, env: gymnasium.Env, observation: Any) -> np.ndarray:
        return np.array([hash(GridFeatures()(env, observation).tobytes())])


class Setup:
    """One way to search one env, and another instance of it to act in."""

    def __init__(self, name: str, how: str) -> None:
        num_actions = int(make_gym(name).action_space.n)
        moves = how != "actions"
        worker: Any = GridMoves(num_actions) if moves else RepeatActions(num_actions)
        self.features: Any = WholeState() if how == "whole state" else GridFeatures(not moves)
        stages = getattr(self.features, "stages", ())
        self.seen = name if how == "pictures" else partial(view, name, moves)
        keywords: dict[str, Any] = {"max_steps": 3 if moves else 1, "num_processes": 0, "seed": 0}
        self.pool = OptionPool(self.seen, worker, features=self.features, **keywords)
        self.real = OptionPool(name, worker, **keywords)
        self.other_dice = None
        if "Dynamic" in name:  # whose plans know the dice, which belong to the state
            dice = {"features": self.features, "determinised": False}
            self.other_dice = OptionPool(self.seen, worker, **dice, **keywords)
        self.planner = MCTSPlanner(
            self.pool,
            novelty=None if how == "no novelty" else WidthNovelty("features", stages=stages),
            leaves_per_wave=32,
            budget=SearchBudget(base_steps=CHUNK),
            seed=0,
        )
        self.run(10**6)  # compiles what is compiled

    def run(self, seed: int) -> dict[str, Any]:
        """Plan and act in the episode of a seed."""
        self.pool.set_seed(seed)
        self.real.set_seed(seed)
        start, before, begin = self.pool.reset(), self.pool.num_steps, time.process_time()
        search, size = self.planner.search(start), 0
        while search.best_node[0] < 0 and size < search.tree.num_nodes[0] < NODES:
            size = int(search.tree.num_nodes[0])
            if time.process_time() - begin > SECONDS:
                break
            self.planner.resume(search)
        row = {
            "seconds": time.process_time() - begin,
            "steps": self.pool.num_steps - before,
            "nodes": int(search.tree.num_nodes[0]),
            "found": bool(search.best_node[0] >= 0),
            "stage": "" if search.novelty is None else _stage(search),
        }
        if self.other_dice is not None:
            self.other_dice.set_seed(seed)
            row["other_dice"] = self.act(search, self.other_dice)["solved"]
            self.other_dice.set_seed(seed)
            episode = self.other_dice.rollout(100, policy=self.planner)
            row["other_dice_replanned"] = bool(episode["next", "reward"][-1] > 0.0)
        return row | self.act(search, self.real)

    def act(self, search: Search, real: OptionPool) -> dict[str, Any]:
        """Take the options of the plan, in an env that the planner has never seen."""
        td, paid, options = real.reset(), 0.0, []
        before = real.num_steps
        if search.best_node[0] >= 0:
            options = search.tree.options(0, int(search.best_node[0]))
        for option in options:
            td = real.step(td.set("option", torch.tensor(option)))["next"]
            paid = float(td["reward"])
            if td["done"]:
                break
            td = td.exclude("reward")
        taken = real.num_steps - before
        return {"solved": paid > 0.0, "options": len(options), "plan_steps": taken}


def _stage(search: Search) -> str:
    """Whether the novelty test was relaxed before a plan was found."""
    stage, n = int(search.novelty._stage[0]), int(search.novelty._limits[0])
    return ["single", "together", "places"][stage] if n == 1 else f"n={n}"


def measure(name: str, how: str, seeds: range) -> dict[str, Any]:
    setup = Setup(name, how)
    runs = [setup.run(seed) for seed in seeds]
    found = [run for run in runs if run["found"]]

    def median(key: str, of: list[dict[str, Any]]) -> Any:
        return round(float(np.median([run[key] for run in of])), 3) if of else None

    others = [key for key in runs[0] if key.startswith("other_dice")]
    return {
        "id": name,
        "search": how,
        "seeds": len(seeds),
        "solved": sum(run["solved"] for run in runs),
        **{key: sum(run[key] for run in runs) for key in others},
        "cpu_seconds_median": median("seconds", runs),
        "cpu_seconds_p95": round(float(np.quantile([run["seconds"] for run in runs], 0.95)), 3),
        "simulated_steps_median": median("steps", runs),
        "nodes_median": median("nodes", runs),
        "plan_options_median": median("options", found),
        "plan_steps_median": median("plan_steps", found),
        "found_while_comparing": dict(Counter(run["stage"] for run in found)),
        "unsolved_seeds": [s for s, run in zip(seeds, runs, strict=True) if not run["solved"]],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[*MAIN, *WIDER])
    parser.add_argument("--search", nargs="*", default=["pairs"])
    parser.add_argument("--seeds", type=int, help="default: 100 for the first four envs, else 20")
    parser.add_argument("--out", type=Path, help="rows of other envs and searches stay")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    torch.set_num_threads(1)
    for name in args.names:
        for how in args.search:
            number = args.seeds or (100 if name in MAIN else 20)
            row = measure(full_name(name), how, range(number))
            print(row, flush=True)
            if args.out:
                facts = {"command": COMMAND, "budget_cpu_seconds": SECONDS, "nodes": NODES}
                add_row(args.out, row, "id", "search", **facts)


if __name__ == "__main__":
    main()
