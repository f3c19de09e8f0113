"""The figures of chapter 4, drawn of lab mazes: mazes, skills, solving while learning, an episode.

Positions are drawn in cells, x to the east and y to the north.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import StrMethodFormatter
from tensordict import TensorDictBase

from torchrl_hmcts.envs import LabMazeEnv, draw_first_person
from torchrl_hmcts.planners import Plan, Search
from torchrl_hmcts.planners.drawing import option_color
from torchrl_hmcts.trainers.figures.animation import write_gif
from torchrl_hmcts.trainers.figures.pictures import save_figure
from torchrl_hmcts.trainers.figures.plots import legend_below, option_rgb
from torchrl_hmcts.trainers.figures.solving_curves import draw_band, save_curves, show_shares

_COLOR, _SCRIPT_COLOR = "#1d4ed8", "#d97706"
_SCRIPT_LABEL = "script on the shortest path"


def plot_mazes(env: LabMazeEnv, path: str | Path, *, mazes: Sequence[int] = (0, 1, 2, 3)) -> None:
    """Draw mazes as text, goal "G" and walls "*", and below as they look from above.

    Args:
        env: whose mazes are drawn.
        path: PNG to write.
        mazes: indices.

    Reference:
        Dissertation, figure 4.4.
    """
    figure = Figure(figsize=(2.6 * len(mazes), 5.4), layout="constrained")
    grid = figure.subplots(2, len(mazes), squeeze=False)
    size = 108.0 / env.layout.rows
    for column, maze in enumerate(mazes):
        rows = (" ".join(row) for row in env.layout.text[maze])  # about as wide as high
        text = "\n".join(rows).replace("P", " ").replace("A", " ")
        above, below = grid[:, column]
        above.text(
            0.5, 0.5, text, family="monospace", fontsize=size, ha="center", va="center",
            transform=above.transAxes, linespacing=1.05,
        )  # fmt: skip
        above.set_axis_off()
        _draw_maze(below, env, maze)
    save_figure(figure, path)


def plot_skill_fan(
    worker: Any,
    env: LabMazeEnv,
    path: str | Path,
    *,
    num_skills: int,
    frames: int = 100,
    episodes: int = 10,
    maze: int = 0,
    seed: int = 0,
) -> None:
    """Draw the trajectories of each skill, one colour each, in an open room and in a maze.

    Every mini-episode begins at rest in the same place and with a heading of its own: a skill is a
    direction on the map, whichever way the player faces.

    Args:
        worker: writes ``"action"``.
        env: whose mazes, clock and action repeat are used.
        path: PNG to write.
        num_skills: number of skills.
        frames: of a mini-episode.
        episodes: mini-episodes per skill.
        maze: index of the maze on the right.
        seed: of the headings.

    Reference:
        Dissertation, figure 4.5: 10 mini-episodes of 100 frames for each policy.
    """
    rows, columns = env.layout.rows, env.layout.columns
    inside = "*" + " " * (columns - 2) + "*"
    room = ["*" * columns, *[inside] * (rows - 2), "*" * columns]
    middle = (rows // 2, columns // 2)
    room[middle[0]] = inside[: middle[1]] + "P" + inside[middle[1] + 1 :]
    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    generator = np.random.default_rng(seed)
    titles = ("in an open room", "in a test maze")
    for axes, text, title in zip(
        figure.subplots(1, 2), (room, env.layout.text[maze]), titles, strict=True
    ):
        here = LabMazeEnv([text], num_steps=env.num_steps, read_outs=env.read_outs)
        place = here.layout.spawn[0, : here.layout.num_spawns[0]]
        center = 50.0 * np.array([columns, rows])
        start = place[np.square(place - center).sum(-1).argmin()]
        skills = torch.arange(num_skills).repeat_interleave(episodes)
        heading = torch.from_numpy(generator.random(len(skills)) * 360.0)
        td = here.make_state(torch.zeros_like(skills), torch.from_numpy(start), heading)
        points = [td["position"]]
        with torch.no_grad():
            for _ in range(frames // env.num_steps):
                td = here.step(worker(td.set("skill", skills)))["next"].exclude("reward")
                points.append(td["position"])
        _draw_maze(axes, here, 0)
        lines = torch.stack(points, 1).numpy() / here.CELL
        for skill, line in zip(skills.tolist(), lines, strict=True):
            axes.plot(*line.T, color=option_color(skill), linewidth=1.4, alpha=0.75)
        axes.plot(*(start / here.CELL), "o", color="black", markersize=6)
        axes.set_title(title, fontsize=10, loc="left")
    handles = [Line2D([], [], color=option_color(z), label=f"skill {z}") for z in range(num_skills)]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(8, num_skills))
    save_figure(figure, path)


def plot_frames_curves(
    curves: Sequence[Mapping[str, Any]], path: str | Path, *, title: str, script: float
) -> None:
    """Draw the mean frames of an episode and the share of mazes solved against training.

    Args:
        curves: of ``frames_curve``, one per seed; the
            band is from the least to the largest.
        path: PNG to write.
        title: heading of the picture.
        script: mean frames of a script on the shortest path, in the same mazes.

    Reference:
        Dissertation, figure 4.10.
    """
    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
    for axes, name in ((left, "frames"), (right, "solved")):
        draw_band(axes, curves, name, color=_COLOR, marker="o", markersize=4)
    left.axhline(script, color=_SCRIPT_COLOR, linestyle="--", linewidth=1.4, label=_SCRIPT_LABEL)
    left.legend(frameon=False, fontsize=9, loc="upper right")
    left.set_ylim(bottom=0)
    left.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    left.set_title("frames of an episode, mean", fontsize=10, loc="left")
    right.set_title("mazes solved at the first trial", fontsize=10, loc="left")
    show_shares(right)
    save_curves(figure, path, title=title, x_label="frames of training")


def plot_search(search: Search, env: LabMazeEnv, path: str | Path, *, root: int = 0) -> None:
    """Draw where the options of a search led in its maze, and the tree; the plan stands out.

    Args:
        search: a finished search.
        env: whose mazes the states index.
        path: PNG to write.
        root: which of the search's roots.
    """
    tree = search.tree
    assert tree.states is not None
    names = [f"skill {option}" for option in range(tree.num_options)]
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.15))
    _draw_maze(left, env, int(tree.states["maze_index"][root, 0]))
    tree.plot_positions(
        root,
        lambda states: states["position"] / env.CELL,
        ax=left,
        option_names=names,
        legend=False,
    )
    left.set_title("where the options led", fontsize=10, loc="left")
    tree.plot(root, ax=right, max_nodes=600, option_names=names)
    legend_below(figure, right.get_legend(), ncols=6)  # one for both
    save_figure(figure, path)


def write_episode_gif(
    env: LabMazeEnv,
    states: Sequence[TensorDictBase],
    options: Sequence[int],
    plan: Plan,
    path: str | Path,
    *,
    steps_per_picture: int = 2,
) -> None:
    """Write an episode as a GIF: from above with the plan, and what the player sees.

    Args:
        env: whose maze it is.
        states: after each base step, and the first, ``[T + 1]``.
        options: carried out in each base step, ``[T]``.
        plan: without batch dimensions.
        path: file to write.
        steps_per_picture: base steps from one picture to the next.
    """
    length = int(plan.lengths)
    points = env.to_picture(plan.states["position"][: length + 1]).numpy()
    colors = [option_rgb(int(option)) for option in plan.options[:length]]
    planned = [(points, 255 - 0.35 * (255 - np.array(colors)))] if length else []
    trail = env.to_picture(torch.stack([state["position"] for state in states])).numpy()
    taken = np.array([option_rgb(option) for option in options])
    tile = max(8, 288 // env.layout.rows)
    pictures = []
    last = len(states) - 1
    for step in [*range(0, last, steps_per_picture), last]:
        walked = [(trail[: step + 1], taken[:step])] if step else []
        above = env.render(states[step], paths=[*planned, *walked], tile_pixels=tile)
        height = above.shape[0]
        seen = draw_first_person(env, states[step], width=height * 4 // 3, height=height)
        pictures.append(np.concatenate((above, seen), 1))
    write_gif(pictures, path, milliseconds=1000.0 * env.num_steps * steps_per_picture / 60.0)


def _draw_maze(axes: Axes, env: LabMazeEnv, maze: int) -> None:
    """Walls and goal, y to the north."""
    layout = env.layout
    axes.imshow(
        np.where(layout.walls[maze], 0.12, 1.0),
        cmap="gray",
        vmin=0,
        vmax=1,
        extent=(0, layout.columns, 0, layout.rows),
        interpolation="nearest",
    )
    if layout.goal[maze, 0] >= 0:
        axes.plot(*(layout.goal[maze] / env.CELL), "o", color="#16a34a", markersize=9)
    axes.set_xticks([])
    axes.set_yticks([])
