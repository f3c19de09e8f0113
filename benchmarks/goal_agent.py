"""Chapter 3's comparison: the goal-based agent and plain A3C, over several seeds.

    python benchmarks/goal_agent.py --seeds 0 1 2 --out docs/results/goals/goal_agent.json

For each seed both agents are trained with the same network and budget by `hmcts train
experiment=waterworld_goals` and `waterworld_a3c`, and tested once in each of the 342 test mazes,
together with a scripted expert that steers from goal to goal. Runs that are already in `--runs` are
read, not repeated. Writes the figures, and Figure 3.6 as a PNG beside them.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from table import markdown, read_arguments, write

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_starts
from torchrl_hmcts.trainers.experiments.registry import find_experiment
from torchrl_hmcts.trainers.experiments.waterworld.episodes import play_mazes
from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import make_goal_env
from torchrl_hmcts.trainers.experiments.waterworld.scripted_expert import ScriptedExpert
from torchrl_hmcts.trainers.figures.curves import learning_panels, plot_training
from torchrl_hmcts.trainers.runs.config import parse_overrides
from torchrl_hmcts.trainers.saving.run_folder import read_curves

NAMES = {"waterworld_goals": "goal-based agent", "waterworld_a3c": "A3C without goals"}


def run(name: str, seed: int, runs: Path, overrides: list[str]) -> dict[str, Any]:
    """Metrics and test curve of one run; it is trained unless its folder is complete."""
    experiment, out = find_experiment(name), runs / f"{name}_{seed}"
    words = [f"seed={seed}", f"out={out}", *overrides]
    config = parse_overrides(experiment.config_class, words)
    file = out / "metrics.json"
    metrics: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    if metrics.get("config") != dataclasses.asdict(config):
        experiment(dataclasses.replace(config, resume=(out / "checkpoints").exists()))
        metrics = json.loads(file.read_text())
    metrics["config"] = {k: v for k, v in metrics["config"].items() if k not in ("out", "resume")}
    curves = read_curves(out)
    steps = [int(step) for step in curves["eval_solved_share"].steps]
    curve: dict[str, list[Any]] = {"training_steps": steps}
    for key, digits in (("solved_share", 4), ("episode_steps", 1)):
        curve[key] = [round(value, digits) for value in curves[f"eval_{key}"].values]
    return {**metrics, "curve": curve}


def main() -> None:
    arguments = read_arguments(
        __doc__,
        {"overrides": ["toy=true"], "seeds": [0]},
        seeds=[0, 1, 2],
        agents=list(NAMES),
        runs=str(Path("runs/goal_agent")),
        overrides=([""], "key=value of both experiments"),
    )
    overrides = [word for word in arguments.overrides if word]
    command = ["python benchmarks/goal_agent.py --seeds", *map(str, arguments.seeds), *overrides]
    agents: dict[str, list[dict[str, Any]]] = {"scripted expert": []}
    env = make_goal_env(maze_pool("test"))
    for seed in arguments.seeds:
        test = play_mazes(ScriptedExpert(), env, make_starts(env.base_env, 342, seed)).summary()
        agents["scripted expert"].append({"seed": seed, "test": test})
    for name in arguments.agents:
        runs = [run(name, seed, Path(arguments.runs), overrides) for seed in arguments.seeds]
        agents[NAMES[name]] = runs
    rows = [
        (agent + ", greedy" * (kind == "test_greedy"), row, row[kind])
        for agent, runs in agents.items()
        for row in runs
        for kind in ("test", "test_greedy")
        if kind in row
    ]
    columns = {
        "agent": lambda row: row[0],
        "seed": lambda row: row[1]["seed"],
        "training steps": lambda row: row[1].get("train_base_steps", ""),
        "s": lambda row: row[1].get("train_seconds", ""),
        "solved": lambda row: f"{row[2]['solved']} of {row[2]['mazes']}",
        "steps (solved)": lambda row: row[2]["base_steps_mean"],
        "steps (all)": lambda row: row[2]["base_steps_mean_all"],
    }
    print(markdown(rows, columns))
    write(arguments, {"command": " ".join(command), "agents": agents})
    if arguments.out is not None:
        curves = {
            NAMES[name]: [r["curve"] for r in agents[NAMES[name]]] for name in arguments.agents
        }
        title = f"Random mazes with and without goals, {len(arguments.seeds)} seeds"
        plot_training(
            curves, learning_panels(1_000), arguments.out.with_suffix(".png"), title=title
        )


if __name__ == "__main__":
    main()
