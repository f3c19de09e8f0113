"""Chapter 3's comparison: the goal-based agent and plain A3C, over several seeds.

    python benchmarks/goal_agent.py --seeds 0 1 2 --out docs/results/goals/goal_agent.json

For each seed both agents are trained with the same network and budget by `hmcts train
experiment=waterworld_goals` and `waterworld_a3c`, and tested once in each of the 342 test mazes,
together with a scripted expert that steers from goal to goal. Runs that are already in `--runs` are
read, not repeated. Writes the figures, and Figure 3.6 as a PNG beside them.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import torch

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.trainers.experiments import find_experiment
from torchrl_hmcts.trainers.experiments.demo import make_starts
from torchrl_hmcts.trainers.experiments.waterworld.agents import play_mazes
from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import make_goal_env
from torchrl_hmcts.trainers.experiments.waterworld.scripted_expert import ScriptedExpert
from torchrl_hmcts.trainers.figures.curves import learning_panels, plot_training
from torchrl_hmcts.trainers.runs.config import parse_overrides

NAMES = {"waterworld_goals": "goal-based agent", "waterworld_a3c": "A3C without goals"}


def run(name: str, seed: int, runs: Path, overrides: list[str]) -> dict[str, Any]:
    """Metrics and test curve of one run; it is trained unless its folder is complete."""
    experiment, out = find_experiment(name), runs / f"{name}_{seed}"
    words = [f"seed={seed}", f"out={out}", *overrides]
    config = parse_overrides(experiment.config_class, words)
    wanted = dataclasses.asdict(config)
    metrics: dict[str, Any] = {}
    if (out / "metrics.json").exists():
        metrics = json.loads((out / "metrics.json").read_text())
    if metrics.get("config") != wanted:
        if (out / "checkpoints").exists():
            config = dataclasses.replace(config, resume=True)
        experiment(config)
        metrics = json.loads((out / "metrics.json").read_text())
    return {**metrics, "curve": read_curve(out / "curves.csv")}


def read_curve(path: Path) -> dict[str, list[float]]:
    """The test curve in a run's curves.csv."""
    curve: dict[str, list[float]] = {"training_steps": [], "solved_share": [], "episode_steps": []}
    with path.open() as file:
        for row in csv.DictReader(file):
            if row["name"] == "eval_solved_share":
                curve["training_steps"].append(int(row["frames"]))
                curve["solved_share"].append(round(float(row["value"]), 4))
            elif row["name"] == "eval_episode_steps":
                curve["episode_steps"].append(round(float(row["value"]), 1))
    return curve


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--agents", nargs="+", default=list(NAMES), choices=list(NAMES))
    parser.add_argument("--runs", type=Path, default=Path("runs/goal_agent"))
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="of both experiments")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, Any] = {
        "command": "python benchmarks/goal_agent.py --seeds "
        + " ".join(map(str, arguments.seeds))
        + "".join(f" {word}" for word in arguments.overrides),
        "agents": {},
    }
    expert_env = make_goal_env(maze_pool("test"))
    rows = []
    for seed in arguments.seeds:
        starts = make_starts(expert_env.base_env, 342, seed)
        test = play_mazes(ScriptedExpert(), expert_env, starts).summary()
        results["agents"].setdefault("scripted expert", []).append({"seed": seed, "test": test})
        rows.append(("scripted expert", seed, "", "", test))
    for name in arguments.agents:
        for seed in arguments.seeds:
            metrics = run(name, seed, arguments.runs, arguments.overrides)
            metrics["config"] = {
                k: v for k, v in metrics["config"].items() if k not in ("out", "resume")
            }
            results["agents"].setdefault(NAMES[name], []).append(metrics)
            for kind in ("test", "test_greedy"):
                agent = NAMES[name] + (", greedy" if kind == "test_greedy" else "")
                steps, seconds = metrics["train_base_steps"], metrics["train_seconds"]
                rows.append((agent, seed, steps, seconds, metrics[kind]))
    print("| agent | seed | training steps | s | solved | steps (solved) | steps (all) |")
    print("|---|---|---|---|---|---|---|")
    for agent, seed, steps, seconds, test in rows:
        print(
            f"| {agent} | {seed} | {steps} | {seconds} | {test['solved']} of {test['mazes']} | "
            f"{test['base_steps_mean']} | {test['base_steps_mean_all']} |"
        )
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(results, indent=1) + "\n")
        curves = {
            agent: [run["curve"] for run in runs]
            for agent, runs in results["agents"].items()
            if "curve" in runs[0]
        }
        plot_training(
            curves,
            learning_panels(1_000),
            arguments.out.with_suffix(".png"),
            title=f"Random mazes with and without goals, {len(arguments.seeds)} seeds",
        )


if __name__ == "__main__":
    main()
