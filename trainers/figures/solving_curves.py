"""Curves of what it takes to solve a maze while the worker learns, over several seeds.

Letters: S seeds, P points of a curve, G points of the common grid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter, StrMethodFormatter

from torchrl_hmcts.trainers.figures.pictures import save_figure

CURVE_COLORS = ("#1d4ed8", "#d97706", "#16a34a", "#7c3aed")

Curve = Mapping[str, Any]


def band(curves: Sequence[Curve], name: str) -> dict[str, np.ndarray]:
    """Bring the curves of several seeds to common training steps: their mean, least and largest.

    Seeds are tested after slightly different numbers of steps, so that each is interpolated to the
    steps of the first, as far as all of them go.

    Args:
        curves: per seed, ``"training_steps"`` ascending and ``name``, ``[P]`` each, as
            ``HMCTSTrainer.test_records.curve()`` gives them.
        name: entry to average.

    Returns:
        ``"training_steps"``, ``"mean"``, ``"least"`` and ``"largest"``, float64 ``[G]``.

    Raises:
        ValueError: if there is no curve.

    Example:
        >>> one = {"training_steps": [0, 10, 20], "solved": [0.0, 0.5, 1.0]}
        >>> two = {"training_steps": [0, 20], "solved": [0.5, 1.0]}
        >>> band([one, two], "solved")["mean"].tolist()
        [0.25, 0.625, 1.0]
    """
    if not curves:
        raise ValueError("band averages the curves of one seed or more; got none.")
    steps = [np.asarray(curve["training_steps"], float) for curve in curves]
    common = steps[0][steps[0] <= min(step[-1] for step in steps)]
    values = np.stack(
        [
            np.interp(common, step, np.asarray(curve[name], float))
            for step, curve in zip(steps, curves, strict=True)
        ]
    )  # [S, G]
    return {
        "training_steps": common,
        "mean": values.mean(0),
        "least": values.min(0),
        "largest": values.max(0),
    }


def draw_band(axes: Axes, curves: Sequence[Curve], name: str, *, color: str, **line: Any) -> None:
    """Draw the mean of several seeds' curves, and the band from the least to the largest.

    Args:
        axes: to draw in.
        curves: of the seeds, as in :func:`band`.
        name: entry to draw.
        color: of line and band.
        **line: of ``axes.plot``.
    """
    shown = band(curves, name)
    x = shown["training_steps"]
    if len(curves) > 1:
        axes.fill_between(x, shown["least"], shown["largest"], color=color, alpha=0.16, lw=0)
    axes.plot(x, shown["mean"], color=color, linewidth=2.2, **line)


def show_shares(axes: Axes) -> None:
    """Let the y axis go from 0 to 100 %."""
    axes.set_ylim(0.0, 1.03)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))


def save_curves(
    figure: Figure, path: str | Path, *, title: str, x_label: str = "training base steps"
) -> None:
    """Give all panels of a figure of training curves their common style, and write it.

    Args:
        figure: whose x axes count steps of training.
        path: PNG to write.
        title: heading of the picture.
        x_label: below all panels.
    """
    for axes in figure.axes:
        axes.grid(alpha=0.25)
        axes.set_xlim(left=0)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        axes.spines[["top", "right"]].set_visible(False)
    figure.supxlabel(x_label, fontsize=10)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    save_figure(figure, path)


def plot_solving_curves(
    runs: Mapping[str, Sequence[Curve]], path: str | Path, *, title: str
) -> None:
    """Draw base steps to solve a maze, and the share that is solved, against training base steps.

    Args:
        runs: for each way of training, the test curves of its seeds, with ``"training_steps"``,
            ``"base_steps"`` (simulated and executed), ``"executed_steps"`` and ``"solved"``.
        path: PNG to write.
        title: heading of the picture.

    Reference:
        Dissertation, figure 4.10.
    """
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
    handles = []
    for color, (name, curves) in zip(CURVE_COLORS, runs.items(), strict=False):
        for axes, entry in ((left, "base_steps"), (right, "solved")):
            draw_band(axes, curves, entry, color=color, marker="o", markersize=4)
        executed = band(curves, "executed_steps")
        left.plot(executed["training_steps"], executed["mean"], color=color, linestyle=":")
        handles.append(Line2D([], [], color=color, linewidth=2.2, marker="o", label=name))
    handles.append(Line2D([], [], color="#71717a", linestyle=":", label="executed only"))
    left.set_yscale("log")
    left.set_title("base steps to solve a maze, mean", fontsize=10, loc="left")
    left.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    left.legend(handles=handles, frameon=False, fontsize=9)
    right.set_title("mazes solved", fontsize=10, loc="left")
    show_shares(right)
    save_curves(figure, path, title=title)
