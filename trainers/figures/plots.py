"""Plots of training, skills and search, in the manner of the dissertation's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.planners import Search
from torchrl_hmcts.planners.drawing import OPTION_COLORS, option_color
from torchrl_hmcts.trainers.figures.pictures import save_figure

_MAX_NODES = 600  # of a tree in a picture


def option_rgb(option: int) -> tuple[int, int, int]:
    """Return the colour of an option, 0 to 255; colours repeat after eight.

    Example:
        >>> option_rgb(0)
        (230, 97, 0)
    """
    return OPTION_COLORS[option % len(OPTION_COLORS)]


def plot_losses(history: Mapping[str, Sequence[float]], base_steps: int, path: Path) -> None:
    """Draw the four training curves of the worker and the discriminator's accuracy.

    Args:
        history: per update, as ``DIAYNTrainer.history``.
        base_steps: base steps of the whole training, the x axis' end.
        path: PNG to write.

    Reference:
        Dissertation, figures 4.6 to 4.9.
    """
    panels = [
        ("loss_actor", "Actor loss"),
        ("qvalue_loss_0", "Critic 1 loss"),
        ("qvalue_loss_1", "Critic 2 loss"),
        ("loss_discriminator", "Discriminator loss"),
    ]
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    for axes, (key, title) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        values = np.asarray(history[key])
        steps = np.linspace(0, base_steps, len(values), endpoint=False)
        width = max(1, len(values) // 40)
        smooth = np.convolve(values, np.ones(width) / width, mode="valid")
        axes.plot(steps, values, color="#b9c4d6", linewidth=0.8)
        axes.plot(steps[width - 1 :], smooth, color="#1d4ed8", linewidth=1.6)
        axes.set_title(title, fontsize=10, loc="left")
        axes.grid(alpha=0.25)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        axes.spines[["top", "right"]].set_visible(False)
        if key == "loss_discriminator":
            twin = axes.twinx()
            accuracy = np.convolve(
                np.asarray(history["discriminator_accuracy"]), np.ones(width) / width, "valid"
            )
            twin.plot(steps[width - 1 :], accuracy, color="#d97706", linewidth=1.3)
            twin.set_ylim(0, 1)
            twin.set_ylabel("accuracy", color="#d97706", fontsize=9)
            twin.spines["top"].set_visible(False)
    figure.supxlabel("base steps", fontsize=10)
    save_figure(figure, path)


def _draw_walls(axes: Axes, walls: Any) -> None:
    walls = np.asarray(walls)
    height, width = walls.shape
    axes.imshow(
        np.where(walls, 0.12, 1.0),
        cmap="gray",
        vmin=0,
        vmax=1,
        extent=(0, width, height, 0),
        interpolation="nearest",
    )
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_linewidth(2.5)


def plot_skill_fan(
    policy: Any,
    num_skills: int,
    maze: torch.Tensor,
    path: Path,
    *,
    episodes: int = 10,
    steps: int = 100,
) -> None:
    """Draw the trajectories of each skill, one colour each, in an open room and in a maze.

    Args:
        policy: reads ``"velocity"`` and ``"skill"``, writes ``"action"``.
        num_skills: number of skills.
        maze: bool ``[H, W]``.
        path: PNG to write.
        episodes: mini-episodes per skill.
        steps: base steps of a mini-episode.

    Reference:
        Dissertation, figure 4.5: 10 mini-episodes of 100 frames for each policy.
    """
    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    room = torch.zeros_like(maze)
    free = (~maze).nonzero()
    center = torch.tensor([maze.shape[0] / 2 - 0.5, maze.shape[1] / 2 - 0.5])
    middle = free[(free - center).square().sum(-1).argmin()].flip(-1) + 0.5
    starts = (center.flip(-1) + 0.5, middle)
    titles = ("in an open room", "in a test maze")
    for axes, walls, start, title in zip(
        figure.subplots(1, 2), (room, maze), starts, titles, strict=True
    ):
        _draw_walls(axes, walls)
        env = WaterworldMazeEnv(walls[None], observation=False, max_steps=10**9)
        skills = torch.arange(num_skills).repeat_interleave(episodes)
        # A target in the corner the trajectories reach last; they are not ended by it here.
        corner = (~walls).nonzero()[-1].flip(-1) + 0.5
        td = env.make_state(torch.zeros_like(skills), start, corner)
        points = [td["position"]]
        for _ in range(steps):
            td = policy(td.set("skill", skills))
            td = env.step(td)["next"].exclude("reward")
            points.append(td["position"])
        lines = torch.stack(points, 1).numpy()
        for skill, line in zip(skills.tolist(), lines, strict=True):
            axes.plot(*line.T, color=option_color(skill), linewidth=1.3, alpha=0.7)
        axes.plot(*start.tolist(), "o", color="black", markersize=6)
        axes.set_title(title, fontsize=10, loc="left")
    handles = [Line2D([], [], color=option_color(z), label=f"skill {z}") for z in range(num_skills)]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(8, num_skills))
    save_figure(figure, path)


def legend_below(figure: Figure, legend: Legend, *, ncols: int) -> None:
    """Move a panel's legend below the figure, as the legend of all panels.

    Args:
        figure: receives it.
        legend: of one panel; it is removed there.
        ncols: columns.
    """
    handles: Any = legend.legend_handles  # typed as if one could be None
    names = [text.get_text() for text in legend.get_texts()]
    legend.remove()
    figure.legend(
        handles,
        names,
        loc="outside lower center",
        ncols=ncols,
        fontsize=9,
        frameon=False,
    )


def plot_search(search: Search, env: WaterworldMazeEnv, path: Path, *, root: int = 0) -> None:
    """Draw where the options of a search led in the maze, and the tree; the plan stands out.

    Args:
        search: a finished search whose states have ``"position"``, ``"target"``, ``"maze_index"``.
        env: whose mazes the states index.
        path: PNG to write.
        root: which of the search's roots.

    Reference:
        Dissertation, figure 3.4.
    """
    tree = search.tree
    assert tree.states is not None
    names = [f"skill {option}" for option in range(tree.num_options)]
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.15))
    _draw_walls(left, env.mazes[int(tree.states["maze_index"][root, 0])])
    tree.plot_positions(root, ax=left, option_names=names, legend=False)
    left.plot(*tree.states["target"][root, 0].tolist(), "o", color="#16a34a", markersize=11)
    left.set_title("where the options led", fontsize=10, loc="left")
    tree.plot(root, ax=right, max_nodes=_MAX_NODES, option_names=names)
    legend_below(figure, right.get_legend(), ncols=6)  # one for both
    save_figure(figure, path)
