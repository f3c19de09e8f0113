"""Test curves of agents while they learn, over several seeds: what Figure 3.6 compares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from torchrl_hmcts.trainers.figures.solving_curves import (
    CURVE_COLORS,
    Curve,
    draw_band,
    save_curves,
    show_shares,
)


def plot_learning_curves(
    runs: Mapping[str, Sequence[Curve]], path: str | Path, *, title: str, max_steps: int
) -> None:
    """Draw the share of test mazes solved, and the length of an episode, against training steps.

    Lines are means over the seeds, bands go from the least to the largest of them.

    Args:
        runs: for each agent, the test curves of its seeds, with ``"training_steps"``,
            ``"solved_share"`` and ``"episode_steps"`` (mean over all episodes, those cut off
            included).
        path: PNG to write.
        title: heading of the picture.
        max_steps: base steps at which an episode is cut off.

    Reference:
        Dissertation, figure 3.6.
    """
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for color, (name, curves) in zip(CURVE_COLORS, runs.items(), strict=False):
        for axes, entry in ((left, "solved_share"), (right, "episode_steps")):
            draw_band(axes, curves, entry, color=color, label=name)
    left.set_title("test mazes solved in time", fontsize=10, loc="left")
    show_shares(left)
    right.set_title("base steps of an episode, mean", fontsize=10, loc="left")
    right.set_ylim(0.0, 1.05 * max_steps)
    right.axhline(max_steps, color="#71717a", linestyle=":", linewidth=1.0)
    right.annotate(
        "cut off",
        (1.0, max_steps),
        xycoords=("axes fraction", "data"),
        xytext=(-4, 3),
        textcoords="offset points",
        ha="right",
        fontsize=8,
        color="#71717a",
    )
    right.legend(frameon=False, fontsize=9)
    save_curves(figure, path, title=title)
