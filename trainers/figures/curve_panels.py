"""Small pictures of curves for a page: one per logged value, readable on a phone."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import numpy as np

from torchrl_hmcts.trainers.runs.folder import RunCurve

GROUP_COLORS = (
    "#1d4ed8", "#d97706", "#16a34a", "#7c3aed", "#db2777", "#0891b2", "#854d0e", "#4b5563",
)  # fmt: skip
_SMOOTHED = 80  # points from which on a curve is drawn pale, with its moving average


def panel(name: str, groups: Mapping[str, Sequence[RunCurve]]) -> str:
    """Draw one value of several groups of runs: mean, and band from the least to the largest.

    Args:
        name: of the value.
        groups: the curves of each group's seeds; colours go by the order of the groups.

    Returns:
        An SVG document.

    Example:
        >>> panel("entropy", {"": [RunCurve("entropy", [0, 1], [2, 1], "steps")]})[:5]
        '<?xml'
    """
    from matplotlib import rc_context  # here: a page without it lacks its curves, no more
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, MaxNLocator

    figure = Figure(figsize=(4.3, 2.7), layout="constrained")
    axes = figure.subplots()
    label = "steps"
    for i, curves in enumerate(groups.values()):
        color = GROUP_COLORS[i % len(GROUP_COLORS)]
        if not curves:
            continue
        label = curves[0].step_label
        steps, values = common_steps(curves)
        mean = values.mean(0)
        if len(curves) > 1:
            axes.fill_between(
                steps, values.min(0), values.max(0), color=color, alpha=0.16, linewidth=0
            )
        if len(steps) >= _SMOOTHED and len(groups) == 1 and len(curves) == 1:
            axes.plot(steps, mean, color="#b9c4d6", linewidth=0.7)
            width = max(1, len(steps) // 40)
            smooth = np.convolve(mean, np.ones(width) / width, mode="valid")
            axes.plot(steps[width // 2 :][: len(smooth)], smooth, color=color, linewidth=1.7)
        else:
            marker = "o" if len(steps) <= 3 else None
            axes.plot(steps, mean, color=color, linewidth=1.8, marker=marker, markersize=4)
    axes.set_title(name, fontsize=11, loc="left")
    axes.set_xlabel(label, fontsize=9)
    axes.tick_params(labelsize=9)
    axes.grid(alpha=0.25)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.spines[["top", "right"]].set_visible(False)
    file = io.StringIO()
    # Without a date and with fixed ids, so that the same runs give the same page.
    with rc_context({"svg.hashsalt": name}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()


def common_steps(curves: Sequence[RunCurve]) -> tuple[np.ndarray, np.ndarray]:
    """Bring curves to common steps, as far as all of them go.

    Args:
        curves: one per seed, S of them.

    Returns:
        Steps ``[G]`` and values ``[S, G]``.

    Example:
        >>> one = RunCurve("x", [0, 10, 20], [0, 1, 2], "steps")
        >>> two = RunCurve("x", [0, 20], [1, 3], "steps")
        >>> common_steps([one, two])[1].mean(0).tolist()
        [0.5, 1.5, 2.5]
    """
    first = min(curves, key=lambda curve: curve.steps[-1])
    begin = max(curve.steps[0] for curve in curves)
    steps = np.asarray([x for x in first.steps if x >= begin] or [first.steps[-1]], dtype=float)
    values = np.stack([np.interp(steps, curve.steps, curve.values) for curve in curves])
    return steps, values
