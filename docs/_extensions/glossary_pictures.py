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


def make_env(max_steps: int = 20) -> TransformedEnv:
    """Waterworld with one maze; option ``z`` holds thrust in direction ``z``."""
    maze = maze_from_text(MAZE)[0]
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    options = OptionTransform(worker, 4, max_steps, trajectory_keys=["position"])
    return TransformedEnv(WaterworldMazeEnv(maze[None], observation=False, seed=0), options)


def start(env: TransformedEnv) -> Any:
    """The state at rest in the upper left corner."""
    return env.base_env.make_state(0, torch.tensor([0.5, 0.5]), torch.tensor([4.5, 4.5]))


def follow(env: TransformedEnv, td: Any, option: int) -> tuple[Any, Any]:
    """Take an option; return the places of its base steps and the next state."""
    after = env.step(td.clone().set("option", torch.tensor(option)))["next"]
    steps = after["trajectory"]
    return steps["position"][steps["mask"]], after.exclude("trajectory", "reward")


def panel() -> tuple[Figure, Any]:
    figure = Figure(figsize=(3.2, 3.2), layout="constrained")
    return figure, figure.subplots()


def draw_option() -> Figure:
    """One option: a way of 20 base steps, a dot each."""
    env, (figure, axes) = make_env(), panel()
    td = start(env)
    env.base_env.draw_map(axes, td)
    way, _ = follow(env, td, 3)
    axes.plot(*way.T, "o-", color=option_color(3), markersize=3)
    axes.plot(*td["position"], "o", color="black")
    axes.annotate("right", way[-1], color=option_color(3), weight="bold", xytext=(3, 8),
                  textcoords="offset points")  # fmt: skip
    return figure


def draw_macro_steps() -> Figure:
    """Four macro-steps: each option one arrow."""
    env, (figure, axes) = make_env(), panel()
    td = start(env)
    env.base_env.draw_map(axes, td)
    for option in range(4):
        here = td["position"]
        _, after = follow(env, td, option)
        end = after["position"]
        style = {"arrowstyle": "->", "color": option_color(option), "linewidth": 2.5}
        axes.annotate("", end, here, arrowprops=style)
        axes.annotate(NAMES[option], end, color=option_color(option), weight="bold")
    axes.plot(*td["position"], "o", color="black")
    return figure


def draw_plan() -> Figure:
    """The search and its plan, with a letter on each segment."""
    env, (figure, axes) = make_env(), panel()
    planner = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.5), seed=0)
    plan = planner.plan(start(env))
    axes.set_aspect("equal")
    env.base_env.draw_map(axes, start(env))
    planner.last_search.tree.plot_positions(ax=axes, option_names=NAMES, legend=False)
    places = plan.states["position"]
    for i, option in enumerate(plan.options.tolist()):
        middle = (places[i] + places[i + 1]) / 2
        axes.annotate(NAMES[option][0].upper(), middle, color="black", weight="bold")
    return figure


def draw_radius() -> Figure:
    """The radius around places that the search has kept."""
    env, (figure, axes) = make_env(), panel()
    budget = SearchBudget(expansions=6, until_plan=False)
    planner = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.5), budget=budget, seed=0)
    view = planner.search(start(env)).tree.view()
    env.base_env.draw_map(axes, start(env))
    count = int(view.num_nodes[0])
    for node in range(count):
        place, refused = view.states["position"][0, node], bool(int(view.flags[0, node]) & 8)
        if refused:
            axes.plot(*place, "x", color="0.45", markersize=6)
            continue
        axes.add_patch(Circle(tuple(place.tolist()), 0.5, color=option_color(2), alpha=0.2))
        axes.plot(*place, "o", color=option_color(2), markersize=4)
    return figure


def main() -> None:
    for name, draw in {
        "option": draw_option,
        "macro_step": draw_macro_steps,
        "plan": draw_plan,
        "novelty_radius": draw_radius,
    }.items():
        draw().savefig(OUT / f"glossary_{name}.png", dpi=90)
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    env = TransformedEnv(WaterworldMazeEnv(seed=0), OptionTransform(worker, 4, max_steps=20))
    planner = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.6))
    planner.plan(env.reset(TensorDict()))
    figure, axes = panel()
    tree = planner.last_search.tree
    env.base_env.draw_map(axes, tree.states[0, 0])
    tree.plot_positions(ax=axes, legend=False)
    figure.savefig(OUT / "first_search.png", dpi=110)


if __name__ == "__main__":
    main()
