"""How the planner scales, and what it costs beside its simulator.

    python benchmarks/planner_figures.py [--out FILE.json]

Prints the cost per simulation at 1,000 and at 100,000 nodes, the memory of a node, and the share
of the planner in a macro expansion on Waterworld and, where ale-py is installed, on Atari
(Breakout, RAM).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_hmcts.envs import AtariOptionPool, RepeatActions, maze_pool
from torchrl_hmcts.planners import (
    PUCT,
    MCTSPlanner,
    RadiusNovelty,
    Root,
    Search,
    SearchBudget,
    Transition,
    simulator,
    tree_search,
)
from torchrl_hmcts.planners.tree import EDGE, NODE
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_option_env, make_starts

clock = time.thread_time


class Thrust(TensorDictModuleBase):
    """Takes the action of the skill's number."""

    in_keys = ["skill"]
    out_keys = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", tensordict.get("skill"))


def grow(num_simulations: int) -> tuple[float, float]:
    """Seconds per simulation, and mean depth of a leaf, while a tree of that size is grown."""
    options = 10

    def transition(state: np.ndarray, option: np.ndarray) -> Transition:
        m = len(state)
        zero, one = np.zeros(m, np.float32), np.ones(m, np.float32)
        return Transition(zero, one, np.full((m, options), 0.1, np.float32), zero, state)

    root = Root(np.full((1, options), 0.1, np.float32), np.zeros(1, np.float32), np.zeros(1))
    begin = clock()
    search: Search = tree_search(root, transition, num_simulations, tree_policy=PUCT(c=1.0))
    seconds = (clock() - begin) / num_simulations
    return seconds, float(search.tree.nodes["depth"][0, 1:num_simulations].mean())


def scaling() -> dict[str, Any]:
    grow(1_000)
    small = [grow(1_000) for _ in range(30)]
    large = [grow(100_000) for _ in range(3)]
    t1, d1 = np.median(small, axis=0)
    t2, d2 = np.median(large, axis=0)
    return {
        "us_per_simulation_at_1000": round(float(1e6 * t1), 2),
        "us_per_simulation_at_100000": round(float(1e6 * t2), 2),
        "mean_depth": [round(float(d1), 2), round(float(d2), 2)],
        "ratio": round(float(t2 / t1), 2),
        "ratio_per_level": round(float(t2 / d2 / (t1 / d1)), 2),
        "bytes_per_node": NODE.itemsize,
        "bytes_per_option": EDGE.itemsize,
    }


def overhead(planner: MCTSPlanner, start: TensorDictBase, searches: int) -> dict[str, Any]:
    """The planner's own share of the time of a search, everything but the simulator's step."""
    spent, step = [0.0, 0.0], simulator.step_states

    def timed(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
        begin = clock()
        after = step(env, states)
        spent[0] += clock() - begin
        return after

    planner.search(start)
    waves = 0
    simulator.step_states = timed
    for _ in range(searches):
        begin = clock()
        search = planner.search(start)
        spent[1] += clock() - begin
        waves += int(search.num_expansions[0])
    simulator.step_states = step
    own = spent[1] - spent[0]
    return {
        "expansions": waves,
        "ms_per_expansion": round(1e3 * spent[1] / waves, 3),
        "planner_ms_per_expansion": round(1e3 * own / waves, 3),
        "planner_share": round(own / spent[1], 4),
    }


def waterworld() -> dict[str, Any]:
    env = make_option_env(Thrust(), maze_pool("test"), option_steps=40)
    planner = MCTSPlanner(
        env,
        novelty=RadiusNovelty("position", 0.7),
        budget=SearchBudget(expansions=60, until_plan=False),
    )
    return overhead(planner, make_starts(env.base_env, 1, seed=0), searches=5)


def atari() -> dict[str, Any] | str:
    """Four options that hold an action of Breakout for ten steps of four frames."""
    try:
        pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=10, num_processes=0, seed=0)
    except ImportError:
        return "not measured: pip install ale-py"
    env = TransformedEnv(pool)  # which does not step beside the planner
    planner = MCTSPlanner(
        env, tree_policy=PUCT(), budget=SearchBudget(expansions=60, until_plan=False)
    )
    start = env.reset()[None]
    size = start["emulator_state"].shape[-1]
    return {"state_bytes": size, **overhead(planner, start, searches=3)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    torch.set_num_threads(1)
    figures = {"tree": scaling(), "waterworld": waterworld(), "atari": atari()}
    print(json.dumps(figures, indent=2))
    if args.out is not None:
        args.out.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
