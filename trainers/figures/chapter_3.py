"""The figures of chapter 3: Waterworld, the manager's tiles, goals, and learning with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_starts
from torchrl_hmcts.trainers.experiments.waterworld.episodes import run_goal_episodes
from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import make_goal_env
from torchrl_hmcts.trainers.experiments.waterworld.scripted_expert import ScriptedExpert
from torchrl_hmcts.trainers.figures.dissertation import Sources, find_figure
from torchrl_hmcts.trainers.figures.goal_figures import plot_goals, plot_macro_env, plot_tile_search
from torchrl_hmcts.trainers.figures.learning_curves import plot_learning_curves
from torchrl_hmcts.trainers.runs.folder import RunFolder, load_config

AGENTS = {"waterworld_goals": "goal-based agent", "waterworld_a3c": "A3C without goals"}
_MAZES = 20  # of the test split, of which one with a rather long way is shown


def draw_environments(sources: Sources, path: Path, name: str) -> str:
    """Draw a test maze as Waterworld and as Gridworld.

    Args:
        sources: not needed.
        path: PNG to write.
        name: of the figure.

    Returns:
        The caption.
    """
    env = WaterworldMazeEnv(maze_pool("test"), observation=False)
    plot_macro_env(env, make_starts(env, _MAZES, seed=0)[3], path)
    return "A test maze, drawn afresh: as Waterworld (Figure 3.1) and as Gridworld (Figure 3.2)."


def draw_tile_search(sources: Sources, path: Path, name: str) -> str:
    """Draw the search over tiles in a test maze."""
    env = WaterworldMazeEnv(maze_pool("test"), observation=False)
    plot_tile_search(env, make_starts(env, _MAZES, seed=0)[3], path)
    return "The manager's search over tiles in a test maze, made afresh, and its plan."


def draw_goals(sources: Sources, path: Path, name: str) -> str:
    """Draw an episode with its goals, of the worker of a run or of the scripted one."""
    runs = sources.of("waterworld_goals")
    worker: Any = ScriptedExpert()
    whose = "a scripted worker"
    env = make_goal_env(maze_pool("test"), observation=bool(runs))
    if runs:
        from torchrl_hmcts.trainers.runs.worker_file import load_networks
        from torchrl_hmcts.trainers.experiments.goals import (
            make_agent_env,
            make_agent_loss,
        )

        config = load_config(runs[0])[1]
        env = make_agent_env(config, maze_pool("test"))
        loss = make_agent_loss(config)
        load_networks(loss, runs[0].path)
        worker, whose = loss.actor_network, f"the worker of {runs[0].name}"
    starts = make_starts(env.base_env, _MAZES, seed=0)
    episodes = run_goal_episodes(env, worker, starts, record=True)
    order = episodes.base_steps.argsort()
    shown = int(order[int(0.85 * (len(order) - 1))])
    plot_goals(env.base_env, starts[shown], episodes.tracks[shown], path)
    return f"An episode of {whose} in a test maze: the goals (red) that are still to be met."


def draw_learning(sources: Sources, path: Path, name: str) -> str:
    """Draw the test curves of the agents with and without goals."""
    curves: dict[str, list[dict[str, Any]]] = {}
    told = []
    for experiment, agent in AGENTS.items():
        runs = [_curve(run) for run in sources.of(experiment)]
        if any(runs):
            curves[agent] = [curve for curve in runs if curve]
            told.append(f"{agent}: {len(curves[agent])} seed(s) of the runs given")
    measured = sources.result("goals/goal_agent.json")
    if measured is not None:
        for agent, rows in json.loads(measured.read_text(encoding="utf-8"))["agents"].items():
            with_curves = [row["curve"] for row in rows if "curve" in row]
            if with_curves and agent not in curves:
                curves[agent] = with_curves
                told.append(f"{agent}: {len(with_curves)} seed(s) of docs/results")
    if not curves:
        raise find_figure(name).how_to_get_data("there is no run of either agent.")
    missing = [agent for agent in AGENTS.values() if agent not in curves]
    limit = [run.config.get("max_episode_steps") for run in sources.of(*AGENTS)]
    plot_learning_curves(
        curves,
        path,
        title="Test mazes while the agents learn: mean, least and largest over the seeds",
        max_steps=next((steps for steps in limit if steps), 1_000),
    )
    caption = "Test mazes while the agents learn; " + ", ".join(told) + "."
    if missing:
        lacking = find_figure(name).how_to_get_data(f"no data of {missing[0]}.")
        caption += f"\nNot shown: {lacking}"
    return caption


def _curve(run: RunFolder) -> dict[str, Any]:
    share, steps = (run.curves.get(f"eval_{n}") for n in ("solved_share", "episode_steps"))
    if share is None or steps is None or share.steps != steps.steps:
        return {}
    return {
        "training_steps": share.steps,
        "solved_share": share.values,
        "episode_steps": steps.values,
    }
