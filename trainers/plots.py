"""Plots of training, skills and search, in the manner of the dissertation's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.planners import Search
from torchrl_hmcts.planners.tree import PRUNED

_OPTION_COLORS = (
    (230, 97, 0),
    (93, 58, 155),
    (0, 121, 140),
    (212, 17, 89),
    (140, 110, 0),
    (90, 90, 90),
    (26, 133, 255),
    (64, 176, 60),
)
_DPI = 110


def option_rgb(option: int) -> tuple[int, int, int]:
    """Return the colour of an option, 0 to 255; colours repeat after eight.

    Example:
        >>> option_rgb(0)
        (230, 97, 0)
    """
    return _OPTION_COLORS[option % len(_OPTION_COLORS)]


def _color(option: int) -> tuple[float, float, float]:
    red, green, blue = option_rgb(option)
    return red / 255, green / 255, blue / 255


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
    figure.savefig(path, dpi=_DPI)


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
            axes.plot(*line.T, color=_color(skill), linewidth=1.3, alpha=0.7)
        axes.plot(*start.tolist(), "o", color="black", markersize=6)
        axes.set_title(title, fontsize=10, loc="left")
    handles = [Line2D([], [], color=_color(z), label=f"skill {z}") for z in range(num_skills)]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(8, num_skills))
    figure.savefig(path, dpi=_DPI)


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
    count = int(tree.num_nodes[root])
    nodes = tree.nodes[root, :count]
    position = tree.states["position"][root, :count].numpy()
    best = int(search.best_node[root])
    plan = tree.path(root, best) if best >= 0 else [0]
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.15))

    _draw_walls(left, env.mazes[int(tree.states["maze_index"][root, 0])])
    _draw_edges(left, nodes, position, plan)
    left.plot(*position[0], "o", color="#2563eb", markersize=11)
    left.plot(*tree.states["target"][root, 0].tolist(), "o", color="#16a34a", markersize=11)
    left.set_title("where the options led", fontsize=10, loc="left")

    layout = _layered_layout(nodes)
    _draw_edges(right, nodes, layout, plan)
    right.plot(*layout[0], "o", color="#2563eb", markersize=8)
    if best >= 0:
        right.plot(*layout[best], "o", color="#16a34a", markersize=8)
    right.invert_yaxis()
    right.yaxis.set_major_locator(MaxNLocator(integer=True))
    right.set_xticks([])
    right.set_ylabel("options from the root")
    right.spines[["top", "right", "bottom"]].set_visible(False)
    right.set_title(
        f"the tree: {count:,} nodes, {int(search.num_expansions[root])} expanded",
        fontsize=10,
        loc="left",
    )
    handles = [Line2D([], [], color=_color(o), label=f"skill {o}") for o in range(tree.num_options)]
    handles.append(Line2D([], [], color="#c4c4c4", label="refused: not new"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(9, len(handles)))
    figure.savefig(path, dpi=_DPI)


def _draw_edges(axes: Axes, nodes: np.ndarray, points: np.ndarray, plan: list[int]) -> None:
    pruned = (nodes["flags"] & PRUNED) != 0
    on_plan = np.zeros(len(nodes), bool)
    on_plan[plan] = True
    children = np.arange(1, len(nodes))
    for chosen, width, alpha, order in (
        (pruned[1:], 0.7, 0.7, 2),
        (~pruned[1:] & ~on_plan[1:], 1.1, 0.85, 3),
        (on_plan[1:], 3.6, 1.0, 4),
    ):
        ids = children[chosen]
        if not len(ids):
            continue
        segments = np.stack((points[nodes["parent"][ids]], points[ids]), 1)
        colors = [(0.77, 0.77, 0.77) if pruned[i] else _color(int(nodes["option"][i])) for i in ids]
        axes.add_collection(
            LineCollection(
                list(segments), colors=colors, linewidths=width, alpha=alpha, zorder=order
            )
        )
    axes.autoscale_view()


def _layered_layout(nodes: np.ndarray) -> np.ndarray:
    """Place each node at its depth, over the middle of its leaves, which stand side by side."""
    count = len(nodes)
    children: list[list[int]] = [[] for _ in range(count)]
    for node in range(1, count):
        children[nodes["parent"][node]].append(node)
    across = np.zeros(count)
    leaves = 0
    stack: list[tuple[int, bool]] = [(0, False)]
    while stack:
        node, seen = stack.pop()
        if not children[node]:
            across[node] = leaves
            leaves += 1
        elif seen:
            across[node] = np.mean(across[children[node]])
        else:
            stack.append((node, True))
            stack.extend((child, False) for child in reversed(children[node]))
    return np.stack((across, nodes["depth"].astype(float)), 1)
