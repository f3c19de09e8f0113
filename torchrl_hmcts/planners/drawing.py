"""Pictures of a search tree, by matplotlib: in layers, or where its states lie in the plane.

Letters: ``N`` nodes drawn, ``A`` options.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.planners.export import (
    best_plan,
    check_root,
    option_labels,
    plural,
    shown_nodes,
)
from torchrl_hmcts.planners.tree import PRUNED, REWARDED, TERMINAL, TreeArrays

Axes = Any  # matplotlib.axes.Axes; matplotlib is loaded by the first picture only
Color = tuple[float, float, float]

OPTION_COLORS = (
    (230, 97, 0),
    (93, 58, 155),
    (0, 121, 140),
    (212, 17, 89),
    (140, 110, 0),
    (90, 90, 90),
    (26, 133, 255),
    (64, 176, 60),
)  # 0 to 255
_PRUNED = (0.77, 0.77, 0.77)
_PLAN = "#ffd23f"
_INK = "#1f2430"
_START, _END = "#2563eb", "#16a34a"
_MAX_LEGEND = 16  # options in a legend


def option_color(option: int) -> Color:
    """Return the colour of an option, 0 to 1; colours repeat after eight.

    Example:
        >>> option_color(3) == option_color(11)
        True
    """
    red, green, blue = OPTION_COLORS[option % len(OPTION_COLORS)]
    return red / 255, green / 255, blue / 255


class _Shown(NamedTuple):
    """The nodes to draw, renumbered from 0; the root is the first."""

    ids: np.ndarray  # [N] their numbers in the tree
    nodes: np.ndarray  # [N] their records
    parents: np.ndarray  # [N] row of the node above, -1 for the root
    pruned: np.ndarray  # [N] bool, refused by the novelty test or known from elsewhere
    plan: np.ndarray  # [L] rows of the best plan, from the root on; empty without one
    left_out: int


def _shown(tree: TreeArrays, root: int, max_nodes: int | None) -> _Shown:
    count = check_root(tree, root)
    ids = shown_nodes(tree, root, max_nodes)
    nodes = tree.nodes[root, ids]
    rows = np.full(count, -1)
    rows[ids] = np.arange(len(ids))
    plan = rows[best_plan(tree, root)] if best_plan(tree, root) else np.empty(0, np.int64)
    return _Shown(
        ids=ids,
        nodes=nodes,
        parents=np.where(nodes["parent"] >= 0, rows[nodes["parent"]], -1),
        pruned=(nodes["flags"] & PRUNED) != 0,
        plan=plan[plan >= 0],
        left_out=count - len(ids),
    )


def plot_tree(
    tree: TreeArrays,
    root: int = 0,
    *,
    ax: Axes | None = None,
    max_nodes: int | None = 300,
    option_names: Sequence[str] | None = None,
    cmap: str = "Blues",
    legend: bool = True,
    colorbar: bool = True,
) -> Axes:
    """Draw the tree of one root in layers: a node stands as deep as options lead to it.

    Nodes are coloured by their value V and sized by their visits, on a logarithmic scale. Edges
    have the colour of their option. The best plan lies on a yellow band. White squares are
    terminal, green rims earned a reward, grey crosses were refused by the novelty test, grey
    diamonds are states that are searched elsewhere in the tree.

    Args:
        tree: of a finished or interrupted search.
        root: which of the ``B`` roots. Default 0.
        ax: axes to draw in. Default: those of a new figure of pyplot, sized to the tree.
        max_nodes: how many nodes at most: those with most visits, and the best plan. None for
            all. Default 300.
        option_names: one for each of the ``A`` options. Default: their numbers.
        cmap: matplotlib's name of the colours of values. Default ``"Blues"``.
        legend: whether to say what colours and shapes mean. Default True.
        colorbar: whether to show the scale of values. Default True.

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
    across = layered_layout(shown.parents, _sibling_order(shown))
    points = np.stack((across, shown.nodes["depth"].astype(float)), 1)
    width, depth = float(np.ptp(across)), int(shown.nodes["depth"].max())
    if ax is None:
        size = (np.clip(0.17 * width + 2.5, 6.4, 15.0), np.clip(0.55 * depth + 2.2, 3.6, 9.5))
        ax = pyplot.subplots(figsize=size, layout="constrained")[1]
    ax.set_xlim(across.min() - 0.03 * width - 0.6, across.max() + 0.03 * width + 0.6)
    ax.set_ylim(depth + 0.5, -0.5)

    inches = ax.get_window_extent().width / ax.figure.dpi * (0.85 if colorbar else 0.95)
    spacing = 72.0 * inches / (width + 2.0)  # points from leaf to leaf
    row = 72.0 * ax.get_window_extent().height / ax.figure.dpi / (depth + 1.0)
    largest = float(np.clip(min(1.1 * spacing, 0.45 * row), 7.0, 15.0))
    smallest = float(np.clip(0.62 * spacing, 1.4, 7.0))
    visits = np.maximum(shown.nodes["visits"], 1)
    fewest, most = int(visits.min()), int(visits.max())

    def share(number: Any) -> Any:
        return np.log(number / fewest) / np.log(max(most, fewest + 1) / fewest)

    def diameter(number: Any) -> Any:
        return smallest + (largest - smallest) * share(number)

    diameters = diameter(visits)
    diameters[shown.plan] = np.maximum(diameters[shown.plan], 6.0)
    _draw_tree_edges(ax, shown, points, share(visits), spacing)
    colors = _draw_nodes(ax, shown, points, diameters, cmap)

    ax.set_xticks([])
    ax.spines[["top", "right", "bottom"]].set_visible(False)
    ax.yaxis.get_major_locator().set_params(integer=True)
    ax.set_ylim(depth + 0.5, -0.5)
    ax.set_ylabel("options from the root")
    ax.set_title("\n".join(_title(tree, root, shown)), fontsize=10, loc="left")
    if colorbar and colors.norm.vmin < colors.norm.vmax:
        bar = ax.figure.colorbar(colors, ax=ax, fraction=0.03, pad=0.01, aspect=30)
        bar.set_label("value V of the node")
        bar.outline.set_visible(False)
    if legend:
        handles = _option_handles(shown, labels, option_names is not None)
        handles += _node_handles(shown, diameter, fewest, most)
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

    Straight lines join each node to the one above, in the colour of the option; what was refused is
    grey, the best plan thick. The blue dot is the root, the green ring the end of the best plan.

    Args:
        tree: of a finished or interrupted search, whose states are kept.
        root: which of the ``B`` roots. Default 0.
        key: entry of the state with (x, y), any shape of two numbers; or a callable that makes
            ``[N, 2]`` of the states ``[N]``. Default ``"position"``.
        ax: axes to draw over, whose limits stay if they show something already, e.g. a maze.
            Default: those of a new figure of pyplot.
        max_nodes: how many nodes at most: those with most visits, and the best plan. Default: all.
        option_names: one for each of the ``A`` options. Default: their numbers.
        legend: whether to say what the colours mean. Default True.

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
    fresh = not ax.has_data()
    if fresh:
        ax.set_aspect("equal")
    limits = ax.get_xlim(), ax.get_ylim()
    on_plan = _on_plan(shown)
    for chosen, line_width, alpha, order in (
        (shown.pruned & ~on_plan, 0.7, 0.7, 2),
        (~shown.pruned & ~on_plan, 1.1, 0.85, 3),
        (on_plan, 3.6, 1.0, 4),
    ):
        rows = np.flatnonzero(chosen & (shown.parents >= 0))
        _add_lines(
            ax,
            np.stack((points[shown.parents[rows]], points[rows]), 1),
            _edge_colors(shown, rows),
            linewidths=line_width,
            alpha=alpha,
            zorder=order,
        )
    ax.plot(*points[0], "o", color=_START, markersize=11, zorder=5)
    if len(shown.plan):
        ax.plot(*points[shown.plan[-1]], "o", mec=_END, mew=2.5, mfc="white", ms=7.5, zorder=5)
    if fresh:
        ax.autoscale_view()
    else:
        ax.set_xlim(limits[0])
        ax.set_ylim(limits[1])
    if legend:
        from matplotlib.lines import Line2D

        handles = _option_handles(shown, labels, option_names is not None)
        if shown.pruned.any():
            handles.append(Line2D([], [], color=_PRUNED, label="refused"))
        _add_legend(ax, handles, below=0.08 if fresh else 0.02)
    return ax


def layered_layout(parents: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Place the nodes of a tree across: parents over the middle of their children, no overlaps.

    Nodes of one layer are at least 1 apart, and subtrees as close as that allows. The mean of the
    layouts packed from the left and from the right: mirrored trees are drawn as mirror images.

    Args:
        parents: int64 ``[N]``, row of the node above, which comes first; -1 for the root, row 0.
        order: int64 ``[N]``, all rows, those of siblings from left to right.

    Returns:
        float64 ``[N]``, the root at 0.

    Reference:
        Reingold and Tilford, "Tidier drawings of trees", 1981.

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


def _sibling_order(shown: _Shown) -> np.ndarray:
    """All rows, those of siblings by option and then as they were drawn."""
    return np.lexsort((shown.ids, shown.nodes["option"]))


def _draw_tree_edges(
    ax: Axes, shown: _Shown, points: np.ndarray, share: np.ndarray, spacing: float
) -> None:
    on_plan = _on_plan(shown)
    rows = np.arange(1, len(points))
    curves = _curves(points[shown.parents[rows]], points[rows])
    thin = float(np.clip(spacing / 12.0, 0.3, 0.8))
    widths = np.where(shown.pruned[rows], thin, thin + 1.8 * share[rows])
    widths = np.where(on_plan[rows], np.maximum(widths, 2.2), widths)
    _add_lines(ax, curves[on_plan[rows]], _PLAN, linewidths=8.0, capstyle="round", zorder=1)
    sequence = np.argsort(~shown.pruned[rows] + 2 * on_plan[rows], kind="stable")
    _add_lines(
        ax,
        curves[sequence],
        _edge_colors(shown, rows[sequence]),
        linewidths=widths[sequence],
        alpha=0.9,
        zorder=2,
    )


def _draw_nodes(
    ax: Axes, shown: _Shown, points: np.ndarray, diameters: np.ndarray, cmap: str
) -> Any:
    """Draw the nodes, each once; return what a colour bar is made of."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    searched = ~shown.pruned
    values = shown.nodes["value"].astype(float)
    flags, twin = shown.nodes["flags"], shown.nodes["twin"]
    terminal = (flags & TERMINAL) != 0
    scale = values[searched & ~terminal] if (searched & ~terminal).any() else values
    colors = ScalarMappable(Normalize(float(scale.min()), float(scale.max())), cmap)
    rewarded = (flags & REWARDED) != 0
    thin = np.clip(diameters / 12.0, 0.3, 0.9)
    for chosen, marker in (
        (searched & ~terminal, "o"),
        (searched & terminal, "s"),
    ):
        rows = np.flatnonzero(chosen)
        rims = [_END if rewarded[i] else _INK for i in rows]
        ax.scatter(
            *points[rows].T,
            s=diameters[rows] ** 2 * (0.8 if marker == "s" else 1.0),
            c="white" if marker == "s" else colors.to_rgba(values[rows]),
            marker=marker,
            edgecolors=rims,
            linewidths=np.where(rewarded[rows], np.maximum(1.6, thin[rows]), thin[rows]),
            zorder=4,
        )
    for chosen, marker in ((twin < 0, "x"), (twin >= 0, "D")):
        rows = np.flatnonzero(shown.pruned & chosen)
        if len(rows):
            ax.scatter(
                *points[rows].T,
                s=(0.75 * diameters[rows]) ** 2,
                marker=marker,
                **({"c": [(0.6, 0.6, 0.6)]} if marker == "x" else _HOLLOW),
                linewidths=np.clip(diameters[rows] / 6.0, 0.5, 1.0),
                zorder=3,
            )
    return colors


_HOLLOW = {"facecolors": "white", "edgecolors": [(0.6, 0.6, 0.6)]}


def _title(tree: TreeArrays, root: int, shown: _Shown) -> list[str]:
    nodes = tree.nodes[root, : tree.num_nodes[root]]
    lines = [
        f"{plural(len(nodes), 'node')}, depth {int(nodes['depth'].max()):,}, "
        f"{plural(int(nodes['visits'][0]), 'visit')}, root value {nodes['value'][0]:.4g}"
    ]
    plan = best_plan(tree, root)
    if plan:
        end = nodes[plan[-1]]
        lines.append(
            f"best plan: {plural(len(plan) - 1, 'option')}, "
            f"{plural(int(end['base_steps']), 'base step')}, return {end['path_return']:.4g}"
        )
    if shown.left_out:
        lines.append(
            f"shown: the {len(shown.ids):,} most visited; {plural(shown.left_out, 'node')} left out"
        )
    return lines


def _option_handles(shown: _Shown, labels: list[str], named: bool) -> list[Any]:
    from matplotlib.lines import Line2D

    options = np.unique(shown.nodes["option"][1:][~shown.pruned[1:]]).tolist()
    handles: list[Any] = [
        Line2D(
            [],
            [],
            color=option_color(o),
            linewidth=2,
            label=labels[o].split(" ", 1)[1] if named else f"option {o}",
        )
        for o in options[:_MAX_LEGEND]
    ]
    if len(options) > _MAX_LEGEND:
        handles.append(
            Line2D([], [], linestyle="", label=f"... {len(options) - _MAX_LEGEND} more options")
        )
    return handles


def _node_handles(shown: _Shown, diameter: Any, fewest: int, most: int) -> list[Any]:
    from matplotlib.lines import Line2D

    def dot(label: str, **style: Any) -> Any:
        style = {"marker": "o", "color": "#d6e4f2", "markeredgecolor": _INK, **style}
        return Line2D([], [], linestyle="", label=label, **style)

    handles = []
    if len(shown.plan):
        handles.append(Line2D([], [], color=_PLAN, linewidth=6, label="best plan"))
    flags, twin = shown.nodes["flags"], shown.nodes["twin"]
    if ((flags & TERMINAL) != 0).any():
        handles.append(dot("terminal", marker="s", color="white"))
    if ((flags & REWARDED) != 0).any():
        handles.append(dot("rewarded", markeredgecolor=_END, markeredgewidth=1.6))
    if (shown.pruned & (twin < 0)).any():
        handles.append(dot("not new", marker="x", markersize=5, markeredgecolor="0.6"))
    if (twin >= 0).any():
        handles.append(dot("known state", marker="D", color="white", markeredgecolor="0.6"))
    for number in dict.fromkeys([fewest, round((fewest * most) ** 0.5), most]):
        handles.append(
            dot(plural(number, "visit"), markersize=diameter(number), markeredgewidth=0.5)
        )
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


def _add_lines(ax: Axes, lines: np.ndarray, colors: Any, **style: Any) -> None:
    from matplotlib.collections import LineCollection

    if len(lines):
        ax.add_collection(LineCollection(list(lines), colors=colors, **style))


def _edge_colors(shown: _Shown, rows: np.ndarray) -> list[Color]:
    return [
        _PRUNED if shown.pruned[i] else option_color(int(shown.nodes["option"][i])) for i in rows
    ]


def _on_plan(shown: _Shown) -> np.ndarray:
    """Which nodes an edge of the best plan leads to, bool ``[N]``."""
    on_plan = np.zeros(len(shown.nodes), np.bool_)
    on_plan[shown.plan[1:]] = True
    return on_plan


def _curves(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Lines from node to node that leave and arrive upright, ``[N, 13, 2]``."""
    t = np.linspace(0.0, 1.0, 13)[None, :, None]
    along = np.concatenate((t * t * (3.0 - 2.0 * t), t), -1)
    curves: np.ndarray = start[:, None] + (end - start)[:, None] * along
    return curves


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
