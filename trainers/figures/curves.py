"""Curves against the steps of training: over several seeds, with their band.

Letters: S seeds, P points of a curve, G points that all seeds have reached.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter, StrMethodFormatter

from torchrl_hmcts.trainers.figures.pictures import COLORS, save_figure

_PALE, _GREY = "#b9c4d6", "#71717a"
_SMOOTHED = 80  # points from which on a curve of a page is drawn pale, with its moving average

Points = tuple[Sequence[float] | np.ndarray, Sequence[float] | np.ndarray]
"""Steps, ascending, and values: ``[P]`` each."""


def common_steps(curves: Sequence[Points]) -> tuple[np.ndarray, np.ndarray]:
    """Bring curves to common steps, as far as all of them go.

    Returns the steps ``[G]`` of the curve that ends first, and values ``[S, G]`` at them.
    """
    if not curves:
        raise ValueError("common_steps needs the curve of one seed or more; got none.")
    shortest = min((steps for steps, _ in curves), key=lambda steps: steps[-1])
    begin = max(steps[0] for steps, _ in curves)
    common = np.array([x for x in shortest if x >= begin] or [shortest[-1]], dtype=float)
    return common, np.stack([np.interp(common, steps, values) for steps, values in curves])


def says_something(steps: Sequence[float], values: Sequence[float]) -> bool:
    """Return whether a curve is worth a panel: it is neither constant nor a straight line."""
    x, y = np.asarray(steps, float), np.asarray(values, float)
    if len(x) < 2:
        return False
    if len(x) == 2:
        return bool(np.ptp(y) > 0)
    rest = y - np.polyval(np.polyfit(x, y, 1), x)
    return bool(np.abs(rest).max() > 1e-6 * max(float(np.abs(y).max()), 1e-12))


def draw_band(
    axes: Axes, curves: Sequence[Points], *, color: str, smooth: bool = False, **line: Any
) -> None:
    """Draw the mean of several seeds' curves, and the band from the least to the largest."""
    steps, values = common_steps(curves)
    if smooth:
        axes.plot(steps, values.mean(0), color=_PALE, linewidth=0.8)
        width = max(1, len(steps) // 40)
        values = np.stack([np.convolve(x, np.ones(width) / width, mode="valid") for x in values])
        steps = steps[width // 2 :][: values.shape[1]]
    if len(curves) > 1:
        low, high = values.min(0), values.max(0)
        axes.fill_between(steps, low, high, color=color, alpha=0.16, linewidth=0)
    axes.plot(steps, values.mean(0), color=color, **{"linewidth": 1.8, **line})


def style(axes: Axes, title: str, *, short: bool = False) -> None:
    """Give axes of curves their common style."""
    axes.set_title(title, fontsize=10, loc="left")
    axes.grid(alpha=0.25)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    thousands = EngFormatter(sep="") if short else StrMethodFormatter("{x:,.0f}")
    axes.xaxis.set_major_formatter(thousands)
    axes.spines[["top", "right"]].set_visible(False)


def legend_of_all(figure: Figure, *, ncols: int) -> None:
    """Write one legend for all axes below a figure."""
    pairs = [axes.get_legend_handles_labels() for axes in figure.axes]
    shown = {name: line for lines, names in pairs for line, name in zip(lines, names, strict=True)}
    lines, names = list(shown.values()), list(shown)
    figure.legend(lines, names, loc="outside lower center", ncols=ncols, frameon=False, fontsize=9)


def panel(name: str, groups: Sequence[Sequence[Points]], x_label: str = "steps") -> str:
    """Draw one logged value of several groups of runs, small enough for a phone."""
    figure = Figure(figsize=(4.3, 2.7), layout="constrained")
    axes = figure.subplots()
    for i, curves in enumerate(groups):
        if curves:
            points = min(len(steps) for steps, _ in curves)
            alone = len(groups) == len(curves) == 1
            marker = "o" if points <= 3 else None
            draw_band(
                axes,
                curves,
                color=COLORS[i % len(COLORS)],
                smooth=alone and points >= _SMOOTHED,
                marker=marker,
                markersize=4,
            )
    style(axes, name, short=True)
    axes.set_xlabel(x_label, fontsize=9)
    axes.tick_params(labelsize=9)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    file = io.StringIO()
    with rc_context({"svg.hashsalt": name}):  # ids that are the same each time
        figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()


@dataclass(frozen=True)
class Panel:
    """One panel of :func:`plot_training`."""

    entry: str  # of the curves
    title: str
    share: bool = False  # whether the y axis goes from 0 to 100 %
    log: bool = False  # whether it is logarithmic
    dotted: tuple[str, str] | None = None  # a further entry, and its name in the legend
    level: tuple[float, str] | None = None  # of a dashed line, and its name


def plot_training(
    runs: Mapping[str, Sequence[Mapping[str, Any]]],
    panels: Sequence[Panel],
    path: str | Path,
    *,
    title: str,
    x_label: str = "training base steps",
) -> None:
    """Draw test curves of agents while they learn; bands go from the least to the largest seed.

    Reference:
        Dissertation, figures 3.6 and 4.10.
    """
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    rows = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, shown in zip(rows, panels, strict=True):
        for color, (name, seeds) in zip(COLORS, runs.items(), strict=False):
            curves = [(seed["training_steps"], seed[shown.entry]) for seed in seeds]
            few = min(len(steps) for steps, _ in curves) <= 40
            points: dict[str, Any] = {"marker": "o", "markersize": 4} if few else {}
            draw_band(axes, curves, color=color, label=name, linewidth=2.2, **points)
            if shown.dotted:
                below = common_steps([(s["training_steps"], s[shown.dotted[0]]) for s in seeds])
                axes.plot(below[0], below[1].mean(0), color=color, linestyle=":")
        style(axes, shown.title)
        axes.set_xlim(left=0)
        if shown.share:
            axes.set_ylim(0.0, 1.03)
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        else:
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
            axes.set(yscale="log") if shown.log else axes.set_ylim(bottom=0)
        if shown.dotted:
            axes.plot([], [], color=_GREY, linestyle=":", label=shown.dotted[1])
        if shown.level:
            axes.axhline(shown.level[0], color=_GREY, linestyle="--", label=shown.level[1])
        axes.set_xlabel(x_label, fontsize=9)
    legend_of_all(figure, ncols=4)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    save_figure(figure, path)


def learning_panels(max_steps: int) -> list[Panel]:
    """Return the panels of figure 3.6: mazes solved in time, and the length of an episode."""
    return [
        Panel("solved_share", "test mazes solved in time", share=True),
        Panel("episode_steps", "base steps of an episode, mean", level=(max_steps, "cut off")),
    ]


def solving_panels(script: float) -> list[Panel]:
    """Return the panels of figure 4.10: the frames of an episode, and the share that is solved."""
    level = (script, "script on the shortest path")
    return [
        Panel("frames", "frames of an episode, mean", level=level),
        Panel("solved", "mazes solved at the first trial", share=True),
    ]


def plot_losses(history: Mapping[str, Sequence[float]], base_steps: int, path: Path) -> None:
    """Draw the four training curves of the worker and the discriminator's accuracy.

    Reference:
        Dissertation, figures 4.6 to 4.9.
    """
    titles = {
        "loss_actor": "Actor loss",
        "qvalue_loss_0": "Critic 1 loss",
        "qvalue_loss_1": "Critic 2 loss",
        "loss_discriminator": "Discriminator loss",
    }
    if "discriminator_loss" not in history:  # another objective
        del titles["loss_discriminator"]
        titles |= {
            k: k.replace("_", " ") for k in ("encoder_loss", "dynamics_loss") if k in history
        }
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    for axes, (key, title) in zip(figure.subplots(2, 2).flat, titles.items(), strict=False):
        steps = np.linspace(0, base_steps, len(history[key]), endpoint=False)
        draw_band(axes, [(steps, history[key])], color=COLORS[0], smooth=True)
        style(axes, title)
    if "loss_discriminator" not in titles:
        figure.supxlabel("base steps", fontsize=10)
        save_figure(figure, path)
        return
    twin = axes.twinx()  # of the discriminator
    draw_band(twin, [(steps, history["discriminator_accuracy"])], color=COLORS[1], smooth=True)
    twin.lines[0].remove()  # pale
    twin.set_ylim(0, 1)
    twin.set_ylabel("accuracy", color=COLORS[1], fontsize=9)
    twin.spines["top"].set_visible(False)
    figure.supxlabel("base steps", fontsize=10)
    save_figure(figure, path)
