"""Draws the pictures of the glossary: ``python docs/_extensions/glossary_pictures.py``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_from_text
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget, option_color
from torchrl_hmcts.transforms import OptionTransform

OUT = Path(__file__).resolve().parents[1] / "_static"
MAZE = "\n".join(("P....", ".###.", "...#.", ".#.#.", ".#..T"))
NAMES = ("up", "down", "left", "right")


def make_env(maze: torch.Tensor | None = None) -> TransformedEnv:
    """Waterworld, perhaps with one maze; option ``z`` holds thrust in direction ``z``."""
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    options = OptionTransform(worker, 4, 20, trajectory_keys=["position"])
    mazes = () if maze is None else (maze[None],)
    return TransformedEnv(WaterworldMazeEnv(*mazes, observation=False, seed=0), options)


def scene() -> tuple[TransformedEnv, Any, Figure, Any]:
    """The maze with the player at rest in the upper left corner: env, state, figure, axes."""
    env = make_env(maze_from_text(MAZE)[0])
    td = env.base_env.make_state(0, torch.tensor([0.5, 0.5]), torch.tensor([4.5, 4.5]))
    figure = Figure(figsize=(3.2, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.set_aspect("equal")
    env.base_env.draw_map(axes, td)
    return env, td, figure, axes


def take(env: TransformedEnv, td: Any, option: int) -> Any:
    """Take an option; return the places of its base steps."""
    steps = env.step(td.clone().set("option", torch.tensor(option)))["next", "trajectory"]
    return steps["position"][steps["mask"]]


def draw_option() -> Figure:
    """One option: a way of 20 base steps, a dot each."""
    env, td, figure, axes = scene()
    way = take(env, td, 3)
    axes.plot(*way.T, "o-", color=option_color(3), markersize=3)
    axes.plot(*td["position"], "o", color="black")
    axes.annotate("right", way[-1], color=option_color(3), weight="bold", xytext=(3, 8),
                  textcoords="offset points")  # fmt: skip
    return figure


def draw_macro_steps() -> Figure:
    """Four macro-steps: each option one arrow."""
    env, td, figure, axes = scene()
    for option in range(4):
        end = take(env, td, option)[-1]
        style = {"arrowstyle": "->", "color": option_color(option), "linewidth": 2.5}
        axes.annotate("", end, td["position"], arrowprops=style)
        axes.annotate(NAMES[option], end, color=option_color(option), weight="bold")
    axes.plot(*td["position"], "o", color="black")
    return figure


def draw_plan() -> Figure:
    """The search and its plan, with a letter on each segment."""
    env, td, figure, axes = scene()
    planner = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.5), seed=0)
    plan = planner.plan(td)
    planner.last_search.tree.plot_positions(ax=axes, option_names=NAMES, legend=False)
    places = plan.states["position"]
    for i, option in enumerate(plan.options.tolist()):
        middle = (places[i] + places[i + 1]) / 2
        axes.annotate(NAMES[option][0].upper(), middle, color="black", weight="bold")
    return figure


def draw_radius() -> Figure:
    """The radius around places that the search has kept."""
    env, td, figure, axes = scene()
    budget = SearchBudget(expansions=6, until_plan=False)
    planner = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.5), budget=budget, seed=0)
    view = planner.search(td).tree.view()
    for node in range(int(view.num_nodes[0])):
        place, refused = view.states["position"][0, node], bool(int(view.flags[0, node]) & 8)
        if refused:
            axes.plot(*place, "x", color="0.45", markersize=6)
            continue
        axes.add_patch(Circle(tuple(place.tolist()), 0.5, color=option_color(2), alpha=0.2))
        axes.plot(*place, "o", color=option_color(2), markersize=4)
    return figure


def main() -> None:
    pictures = {"option": draw_option, "macro_step": draw_macro_steps, "plan": draw_plan}
    for name, draw in {**pictures, "novelty_radius": draw_radius}.items():
        draw().savefig(OUT / f"glossary_{name}.png", dpi=90)
    env = make_env()
    planner = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.6))
    planner.plan(env.reset(TensorDict()))
    figure = Figure(figsize=(3.2, 3.2), layout="constrained")
    tree, axes = planner.last_search.tree, figure.subplots()
    env.base_env.draw_map(axes, tree.states[0, 0])
    tree.plot_positions(ax=axes, legend=False)
    figure.savefig(OUT / "first_search.png", dpi=110)


if __name__ == "__main__":
    main()
