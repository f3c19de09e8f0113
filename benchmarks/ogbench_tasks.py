"""OGBench's tasks from recorded episodes alone: nothing of the simulator's state.

    OUT=docs/results/ogbench
    python benchmarks/ogbench_tasks.py --only pointmaze --seeds 0 1 2 --out $OUT/mazes.json
    python benchmarks/ogbench_tasks.py --arms jumps-as-ways cloning greedy --only pointmaze-teleport
    hmcts data id=puzzle-4x4-play-v0 episodes=100          # a tenth of OGBench's
    python benchmarks/ogbench_tasks.py --only puzzle-4x4 --seeds 0 1 2 --out $OUT/puzzles.json

The agent of ``hmcts train kit=ogbench``, at its defaults. Data are recorded once, in data/ogbench,
with the seed 0, where they are not there yet; the agent's seed draws its weights, landmarks,
batches, starts and goals. A row is a dataset, an arm and a seed; it is skipped where the file has
it. Seconds are the processor's, of one process. Arms beside the agent: jumps taken for ways; plain
cloning; no search, but the option with the best value.
"""

from __future__ import annotations

import json
import time
from typing import Any

from table import add_row, markdown, read_arguments

from torchrl_hmcts.trainers.experiments.ogbench.agent import fit_model, learn, make_agent
from torchrl_hmcts.trainers.experiments.ogbench.config import RECIPES, OGBenchConfig
from torchrl_hmcts.trainers.experiments.ogbench.run import play_tasks, recorded, summary

ARMS: dict[str, dict[str, Any]] = {
    "agent": {},
    "jumps-as-ways": {"jump_factor": 1e9},
    "cloning": {"progress_coeff": 0.0},
    "greedy": {"simulations": 1},
}


def run(name: str, arm: str, seed: int, episodes: int) -> dict[str, Any]:
    """Learn and act; return a row."""
    config = OGBenchConfig(id=name, seed=seed, episodes=episodes, **ARMS[arm])
    data, begin = recorded(config), time.process_time()
    model = fit_model(data, config)
    learned = learn(data, model, config)
    seconds = time.process_time() - begin
    agent = make_agent(model, learned.loss.actor_network, config)
    figures = summary(play_tasks(agent, config))
    figures["percent"] = round(100 * figures["solved"], 1)
    told = {
        "recorded_steps": len(data),
        "landmarks": model.num_landmarks,
        "train_cpu_seconds": round(seconds, 1),
    }
    return {"dataset": name, "arm": arm, "seed": seed, **told, **figures}


def main() -> None:
    arguments = read_arguments(
        __doc__,
        {"episodes": 1, "seeds": [0]},
        seeds=[0, 1, 2],
        only=("pointmaze", "datasets with this in their name"),
        arms=["agent"],
        episodes=50,
    )
    path = arguments.out
    rows = json.loads(path.read_text())["rows"] if path and path.exists() else []
    known = {(row["dataset"], row["arm"], row["seed"]) for row in rows}
    for seed in arguments.seeds:
        for name in (name for name in RECIPES if arguments.only in name):
            for arm in arguments.arms:
                if (name, arm, seed) in known:
                    continue
                row = run(name, arm, seed, arguments.episodes)
                rows.append(row)
                print(name, arm, seed, row["solved"], row["solved_by_task"], flush=True)
                if path:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    add_row(path, row, "dataset", "arm", "seed")
    columns = {
        "dataset": lambda row: row["dataset"],
        "arm": lambda row: row["arm"],
        "seed": lambda row: row["seed"],
        "solved, %": lambda row: f"{100 * row['solved']:.1f} of {row['episodes']}",
        "steps, median": lambda row: f"{row['steps']['median']:.0f}",
        "CPU-s a plan, median": lambda row: row["plan_cpu_seconds"]["median"],
    }
    print(markdown(rows, columns))


if __name__ == "__main__":
    main()
