"""Pictures of a search tree, by matplotlib: in layers, or where its states lie in the plane.

Letters: ``N`` nodes drawn, ``A`` options.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.planners.export import (
    best_plan,
    check_root,
    option_labels,
    plan_size,
    plural,
    shown_nodes,
)
from torchrl_hmcts.planners.tree import PRUNED, REWARDED, TERMINAL, TreeArrays

Axes = Any  # matplotlib.axes.Axes; matplotlib is loaded by the first picture only
Color = tuple[float, float, float]

OPTION_COLORS = (  # 0 to 255; apart for the colour-blind, too (tests/test_palette.py)
    (255, 132, 0),
    (127, 16, 253),
    (28, 174, 255),
    (111, 3, 28),
    (65, 104, 122),
    (196, 148, 124),
    (191, 13, 0),
    (116, 0, 151),
)
_PRUNED, _REFUSED = (0.77, 0.77, 0.77), (0.6, 0.6, 0.6)
_PLAN = "#ffd23f"
_INK = "#1f2430"
_START, _END = "#2563eb", "#16a34a"
_MAX_LEGEND = 16  # options in a legend


def option_color(option: int) -> Color:
    """Return the colour of an option in all pictures: red, green and blue, 0 to 1.

    Args:
        option: its number; colours repeat after eight.

    Example:
        >>> option_color(3) == option_color(11)
        True
    """
    red, green, blue = OPTION_COLORS[option % len(OPTION_COLORS)]
    return red / 255, green / 255, blue / 255


@dataclass
class _Shown:
    """The nodes to draw, renumbered from 0; the root is the first."""

    ids: np.ndarray  # [N] their numbers in the tree
    nodes: np.ndarray  # [N] their records
    parents: np.ndarray  # [N] row of the node above, -1 for the root
    plan: np.ndarray  # [L] rows of the best plan, from the root on; empty without one
    left_out: int

    def __post_init__(self) -> None:
        flags = self.nodes["flags"]
        self.pruned, self.rewarded = (flags & PRUNED) != 0, (flags & REWARDED) != 0
        self.terminal = ~self.pruned & ((flags & TERMINAL) != 0)
        self.known = self.pruned & (self.nodes["twin"] >= 0)  # searched elsewhere in the tree
        self.on_plan = np.zeros(len(flags), np.bool_)  # an edge of the plan leads there
        self.on_plan[self.plan[1:]] = True
        self.colors = [  # of the edge that leads to each node
            _PRUNED if pruned else option_color(int(option))
            for pruned, option in zip(self.pruned, self.nodes["option"], strict=True)
        ]

    def lines(self, ax: Axes, paths: np.ndarray, rows: np.ndarray, **style: Any) -> None:
        """Draw the edges that lead to ``rows``, along ``paths [N, points, 2]``."""
        from matplotlib.collections import LineCollection

        colors = style.pop("colors", [self.colors[row] for row in rows])
        if len(rows):
            ax.add_collection(LineCollection(list(paths[rows]), colors=colors, **style))


def _shown(tree: TreeArrays, root: int, max_nodes: int | None) -> _Shown:
    count = check_root(tree, root)
    ids = shown_nodes(tree, root, max_nodes)
    rows = np.full(count, -1)
    rows[ids] = np.arange(len(ids))
    nodes, plan = tree.nodes[root, ids], rows[np.array(best_plan(tree, root), np.int64)]
    parents = np.where(nodes["parent"] >= 0, rows[nodes["parent"]], -1)
    return _Shown(ids, nodes, parents, plan[plan >= 0], count - len(ids))


def plot_tree(
    tree: TreeArrays,
    root: int = 0,
    *,
    ax: Axes | None = None,
    max_nodes: int | None = 300,
    option_names: Sequence[str] | None = None,
    legend: bool = True,
) -> Axes:
    """Draw the tree of one root in layers, one for each number of options from the root.

    The colour of a node shows its value V, its size its visits, on a logarithmic scale. Edges have
    the colour of their option. The best plan lies on a yellow band. White squares are terminal.
    A green rim marks a reward. Grey crosses were refused by the novelty test, grey diamonds are
    searched elsewhere in the tree.

    Args:
        tree: of a finished or interrupted search.
        root: which of the ``B`` roots. Default 0.
        ax: axes to draw in. Default: those of a new figure of pyplot, sized to the tree.
        max_nodes: how many nodes at most: those with most visits, and the best plan. None for
            all. Default 300.
        option_names: one for each of the ``A`` options. Default: their numbers.
        legend: whether to say what colours and shapes mean, and to show the scale of values.
            Default True.

    Returns:
        The matplotlib axes; ``plot_tree(...).figure.savefig("tree.png")`` writes a picture.

    Raises:
        ImportError: if matplotlib is missing.
        IndexError: if there is no such root.
        ValueError: if ``max_nodes`` is below 1, or there are fewer names than options.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> tree = MCTSPlanner(env).search(env.reset()).tree
        >>> ax = tree.plot(option_names=["left", "right"])
        >>> ax.figure.savefig("tree.png")
    """
    pyplot = _pyplot()
    labels = option_labels(tree.num_options, option_names, width=24)
    shown = _shown(tree, root, max_nodes)
    nodes = shown.nodes
    across = layered_layout(shown.parents, np.lexsort((shown.ids, nodes["option"])))
    points = np.stack((across, nodes["depth"].astype(float)), 1)
    width, depth = float(np.ptp(across)), int(nodes["depth"].max())
    if ax is None:
        size = (np.clip(0.17 * width + 2.5, 6.4, 15.0), np.clip(0.55 * depth + 2.2, 3.6, 9.5))
        ax = pyplot.subplots(figsize=size, layout="constrained")[1]
    ax.set_xlim(across.min() - 0.03 * width - 0.6, across.max() + 0.03 * width + 0.6)
    ax.set_ylim(depth + 0.5, -0.5)
    ax.set_xticks([])
    ax.spines[["top", "right", "bottom"]].set_visible(False)
    ax.yaxis.get_major_locator().set_params(integer=True)
    ax.set_ylabel("options from the root")
    ax.set_title("\n".join(_title(tree, root, shown)), fontsize=10, loc="left")

    box, dpi = ax.get_window_extent(), ax.figure.dpi
    spacing = 72.0 * box.width / dpi * (0.85 if legend else 0.95) / (width + 2.0)  # in points
    row = 72.0 * box.height / dpi / (depth + 1.0)
    largest = float(np.clip(min(1.1 * spacing, 0.45 * row), 7.0, 15.0))
    smallest = float(np.clip(0.62 * spacing, 1.4, 7.0))
    visits = np.maximum(nodes["visits"], 1)
    fewest, most = int(visits.min()), int(visits.max())

    def share(number: Any) -> Any:
        return np.log(number / fewest) / np.log(max(most, fewest + 1) / fewest)

    def diameter(number: Any) -> Any:
        return smallest + (largest - smallest) * share(number)

    diameters = diameter(visits)
    diameters[shown.plan] = np.maximum(diameters[shown.plan], 6.0)
    _draw_curves(ax, shown, points, share(visits), float(np.clip(spacing / 12.0, 0.3, 0.8)))
    colors = _draw_nodes(ax, shown, points, diameters)
    if legend and colors.norm.vmin < colors.norm.vmax:
        bar = ax.figure.colorbar(colors, ax=ax, fraction=0.03, pad=0.01, aspect=30)
        bar.set_label("value V of the node")
        bar.outline.set_visible(False)
    if legend:
        handles = _option_handles(shown, labels, option_names is not None)
        handles += _node_handles(shown)
        for number in dict.fromkeys([fewest, round((fewest * most) ** 0.5), most]):
            style = {"markersize": diameter(number), "markeredgewidth": 0.5}
            handles.append(_dot(plural(number, "visit"), **style))
        _add_legend(ax, handles)
    return ax


def plot_positions(
    tree: TreeArrays,
    root: int = 0,
    key: NestedKey | Callable[[TensorDictBase], Tensor] = "position",
    *,
    ax: Axes | None = None,
    max_nodes: int | None = None,
    option_names: Sequence[str] | None = None,
    legend: bool = True,
) -> Axes:
    """Draw where the options of a search led: every node at its place in the plane.

    A straight line in the colour of the option joins each node to the one above. Refused nodes are
    grey. The best plan is thick, with a letter or number for each option. The blue dot is the root.

    Args:
        tree: of a finished or interrupted search, whose states are kept.
        key: entry of the state with (x, y), any shape of two numbers; or a callable that makes
            ``[N, 2]`` of the states ``[N]``. Default ``"position"``.
        ax: axes to draw in; if they show something already, e.g. a maze, their limits stay.
            Default: those of a new figure of pyplot, over the map if the env has ``draw_map``.
        root, max_nodes, option_names, legend: as of ``SearchTree.plot``, but by default all nodes.

    Returns:
        The matplotlib axes.

    Raises:
        ImportError: if matplotlib is missing.
        IndexError: if there is no such root.
        ValueError: if the tree keeps no states, or the entry is missing or not two numbers.

    Example:
        >>> import torch
        >>> from torchrl_hmcts.envs import GridworldMazeEnv
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> env = GridworldMazeEnv(torch.zeros(1, 5, 5, dtype=torch.bool))
        >>> tree = MCTSPlanner(env).search(env.reset()).tree
        >>> def place(states):  # tiles are numbered row by row
        ...     tile = states["player_tile"]
        ...     return torch.stack((tile % 5, tile // 5), -1)
        >>> ax = tree.plot_positions(key=place)
    """
    pyplot = _pyplot()
    labels = option_labels(tree.num_options, option_names, width=24)
    shown = _shown(tree, root, max_nodes)
    points = _positions(tree, root, key, shown.ids)
    if ax is None:
        ax = pyplot.subplots(layout="constrained")[1]
        if tree.draw_map is not None and tree.states is not None and key == "position":
            tree.draw_map(ax, tree.states[root, 0])
    fresh = not ax.has_data()
    if fresh:
        ax.set_aspect("equal")
    limits = ax.get_xlim(), ax.get_ylim()
    paths = np.stack((points[shown.parents], points), 1)
    for chosen, line_width, alpha, order in (
        (shown.pruned & ~shown.on_plan, 0.7, 0.7, 2),
        (~shown.pruned & ~shown.on_plan, 1.1, 0.85, 3),
        (shown.on_plan, 3.6, 1.0, 4),
    ):
        rows = np.flatnonzero(chosen & (shown.parents >= 0))
        shown.lines(ax, paths, rows, linewidths=line_width, alpha=alpha, zorder=order)
    for row in shown.plan[1:]:  # a letter on each segment of the plan
        name = labels[int(shown.nodes["option"][row])]
        style = {"weight": "bold", "ha": "center", "va": "center", "zorder": 6, "clip_on": True}
        box = {"boxstyle": "circle,pad=0.15", "fc": "white", "ec": shown.colors[row]}
        ax.text(*paths[row].mean(0), _letter(name), fontsize=7, bbox=box, **style)
    ax.plot(*points[0], "o", color=_START, markersize=11, zorder=5)
    if len(shown.plan):
        ax.plot(*points[shown.plan[-1]], "o", mec=_END, mew=2.5, mfc="white", ms=7.5, zorder=5)
    if fresh:
        ax.autoscale_view()
    else:
        ax.set(xlim=limits[0], ylim=limits[1])
    if legend:
        handles = _option_handles(shown, labels, option_names is not None)
        if shown.pruned.any():
            handles.append(_line("refused", color=_PRUNED))
        _add_legend(ax, handles, below=0.08 if fresh else 0.02)
    return ax


def _letter(name: str) -> str:
    """The number of an option, or the first letter of its name."""
    number = name.rpartition(" ")[2]
    return number if number.isdigit() else name[:1].upper()


def _draw_curves(
    ax: Axes, shown: _Shown, points: np.ndarray, share: np.ndarray, thin: float
) -> None:
    """Draw edges that leave and arrive upright, thicker with more visits."""
    t = np.linspace(0.0, 1.0, 13)[None, :, None]
    along = np.concatenate((t * t * (3.0 - 2.0 * t), t), -1)
    start = points[shown.parents]
    curves = start[:, None] + (points - start)[:, None] * along  # [N, 13, 2]
    widths = np.where(shown.pruned, thin, thin + 1.8 * share)
    widths = np.where(shown.on_plan, np.maximum(widths, 2.2), widths)
    band = {"colors": _PLAN, "linewidths": 8.0, "capstyle": "round", "zorder": 1}
    shown.lines(ax, curves, np.flatnonzero(shown.on_plan), **band)
    rows = 1 + np.argsort(~shown.pruned[1:] + 2 * shown.on_plan[1:], kind="stable")
    shown.lines(ax, curves, rows, linewidths=widths[rows], alpha=0.9, zorder=2)


def _draw_nodes(ax: Axes, shown: _Shown, points: np.ndarray, diameters: np.ndarray) -> Any:
    """Draw the nodes, each once; return what a colour bar is made of."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize, PowerNorm

    values, inner = shown.nodes["value"].astype(float), ~shown.pruned & ~shown.terminal
    scale = values[inner] if inner.any() else values
    low, high = float(scale.min()), float(scale.max())
    crowded = np.median(scale) - low < 0.1 * (high - low)  # a linear scale would leave all white
    norm = PowerNorm(0.4, low, high) if crowded else Normalize(low, high)
    colors = ScalarMappable(norm, "Blues")
    thin = np.clip(diameters / 12.0, 0.3, 0.9)
    rims = np.where(shown.rewarded, np.maximum(1.6, thin), thin)
    for chosen, marker, area in ((inner, "o", 1.0), (shown.terminal, "s", 0.8)):
        ax.scatter(
            *points[chosen].T,
            s=diameters[chosen] ** 2 * area,
            c="white" if marker == "s" else colors.to_rgba(values[chosen]),
            marker=marker,
            edgecolors=[_END if rewarded else _INK for rewarded in shown.rewarded[chosen]],
            linewidths=rims[chosen],
            zorder=4,
        )
    hollow = {"facecolors": "white", "edgecolors": [_REFUSED]}
    crosses = shown.pruned & ~shown.known
    for chosen, marker, color in ((crosses, "x", {"c": [_REFUSED]}), (shown.known, "D", hollow)):
        if chosen.any():
            ax.scatter(
                *points[chosen].T,
                s=(0.75 * diameters[chosen]) ** 2,
                marker=marker,
                linewidths=np.clip(diameters[chosen] / 6.0, 0.5, 1.0),
                zorder=3,
                **color,
            )
    return colors


def _title(tree: TreeArrays, root: int, shown: _Shown) -> list[str]:
    nodes, plan = tree.nodes[root, : tree.num_nodes[root]], best_plan(tree, root)
    lines = [
        f"{plural(len(nodes), 'node')}, depth {int(nodes['depth'].max()):,}, "
        f"{plural(int(nodes['visits'][0]), 'visit')}, root value {nodes['value'][0]:.4g}"
    ]
    if plan:
        gained = nodes["path_return"][plan[-1]]
        lines.append(f"best plan: {plan_size(tree, root)}, return {gained:.4g}")
    if shown.left_out:
        lines.append(
            f"shown: the {len(shown.ids):,} most visited; {plural(shown.left_out, 'node')} left out"
        )
    return lines


def _line(label: str, **style: Any) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **style)


def _dot(label: str, **style: Any) -> Any:
    style = {"marker": "o", "color": "#d6e4f2", "markeredgecolor": _INK, **style}
    return _line(label, linestyle="", **style)


def _option_handles(shown: _Shown, labels: list[str], named: bool) -> list[Any]:
    options = np.unique(shown.nodes["option"][1:][~shown.pruned[1:]]).tolist()
    handles = []
    for option in options[:_MAX_LEGEND]:
        label = labels[option].split(" ", 1)[1] if named else f"option {option}"
        handles.append(_line(label, color=option_color(option), linewidth=2))
    if len(options) > _MAX_LEGEND:
        handles.append(_line(f"... {len(options) - _MAX_LEGEND} more options", linestyle=""))
    return handles


def _node_handles(shown: _Shown) -> list[Any]:
    """What the marks of nodes mean, as far as there are such."""
    handles = [_line("best plan", color=_PLAN, linewidth=6)] if len(shown.plan) else []
    rim = {"markeredgecolor": "0.6"}
    for chosen, label, style in (
        ((shown.nodes["flags"] & TERMINAL) != 0, "terminal", {"marker": "s", "color": "white"}),
        (shown.rewarded, "rewarded", {"markeredgecolor": _END, "markeredgewidth": 1.6}),
        (shown.pruned & ~shown.known, "not new", {"marker": "x", "markersize": 5, **rim}),
        (shown.known, "known state", {"marker": "D", "color": "white", **rim}),
    ):
        if chosen.any():
            handles.append(_dot(label, **style))
    return handles


def _add_legend(ax: Axes, handles: list[Any], below: float = 0.02) -> None:
    longest = max((len(handle.get_label()) for handle in handles), default=1)
    inches = ax.get_window_extent().width / ax.figure.dpi
    columns = max(1, int(inches / (0.55 + 0.075 * longest)))
    ax.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, -below),
        ncols=min(columns, len(handles)),
        fontsize=8,
        frameon=False,
        labelspacing=0.7,
    )


def _positions(
    tree: TreeArrays,
    root: int,
    key: NestedKey | Callable[[TensorDictBase], Tensor],
    ids: np.ndarray,
) -> np.ndarray:
    if tree.states is None:
        raise ValueError(
            "This tree keeps no states (tree_search leaves them to its caller), so there are no "
            "positions to draw; plot() draws the tree itself."
        )
    states = tree.states[root][torch.from_numpy(ids)]
    entry = key(states) if callable(key) else states.get(key, None)
    if entry is None:
        raise ValueError(
            f"The states have no entry {key!r}, only "
            f"{sorted(map(str, states.keys(True, True)))}: the env's state_spec. Pass one of them "
            f"as key, or a callable that makes (x, y) of them."
        )
    points: np.ndarray = entry.detach().cpu().numpy().astype(float).reshape(len(ids), -1)
    if points.shape[1] != 2:
        raise ValueError(
            f"plot_positions draws (x, y); {key!r} has {points.shape[1]} numbers per node. Pass a "
            f"callable that makes two of the states."
        )
    return points


def _pyplot() -> Any:
    try:
        from matplotlib import pyplot
    except ImportError as error:
        raise ImportError(
            "Pictures need matplotlib, which is missing here: pip install torchrl_hmcts[train]."
        ) from error
    return pyplot


def layered_layout(parents: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Place the nodes of a tree across, float64 ``[N]``: parents over the middle of their children.

    Nodes of one layer are at least 1 apart, and subtrees as close as that allows; mirrored trees
    are mirror images (Reingold and Tilford, "Tidier drawings of trees", 1981). ``parents`` ``[N]``
    are the rows of the nodes above, -1 for the root; ``order`` ``[N]`` has siblings left to right.

    Example:
        >>> layered_layout(np.array([-1, 0, 0, 1, 1]), np.arange(5))
        array([ 0. , -0.5,  0.5, -1. ,  0. ])
    """
    return (_pack(parents, order) - _pack(parents, order[::-1])) / 2.0


def _pack(parents: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Place subtrees from left to right, each as far to the left as it goes."""
    below: list[list[int]] = [[] for _ in parents]
    for row in order.tolist():
        if parents[row] >= 0:
            below[parents[row]].append(row)
    offsets = np.zeros(len(parents))  # from the node above
    edges: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # left and right outline, by layer
    for row in reversed(range(len(parents))):
        rows = below[row]
        if not rows:
            edges[row] = np.zeros(1), np.zeros(1)
            continue
        left, right = edges.pop(rows[0])
        places = [0.0]
        for child in rows[1:]:
            child_left, child_right = edges.pop(child)
            common = min(len(right), len(child_left))
            gaps = np.full(common, 1.3)  # between cousins; 1 between sisters
            gaps[0] = 1.0
            place = float((right[:common] - child_left[:common] + gaps).max())
            left = np.concatenate((left, child_left[len(left) :] + place))
            right = np.concatenate((child_right + place, right[len(child_right) :]))
            places.append(place)
        middle = (places[0] + places[-1]) / 2.0
        offsets[rows] = np.array(places) - middle
        edges[row] = (
            np.concatenate(([0.0], left - middle)),
            np.concatenate(([0.0], right - middle)),
        )
    across = np.zeros(len(parents))
    for row in range(1, len(parents)):
        across[row] = across[parents[row]] + offsets[row]
    return across
