"""Landmarks of a learned option model, and the ways that an agent took over them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from torchrl_hmcts.modules import EffectModel, LandmarkModel
from torchrl_hmcts.trainers.figures.pictures import COLORS, save_figure

_GREY, _PALE = "#71717a", "#d4d8e0"


def plot_ways(model: LandmarkModel | EffectModel, ways: Sequence[np.ndarray], path: Path) -> None:
    """Draw where options lead, and a way for each task."""
    places, longest = model.places.numpy()[:, :2], float("inf")
    jumps = np.zeros(len(places), np.bool_)
    figure = Figure(figsize=(7, 6), layout="constrained")
    axes = figure.add_subplot()
    if isinstance(model, LandmarkModel):
        starts, options = np.nonzero(model.targets.numpy() >= 0)
        lines = places[np.stack([starts, model.targets.numpy()[starts, options]], 1)]
        axes.add_collection(LineCollection(list(lines), colors=_PALE, linewidths=0.5, zorder=0))
        jumps, longest = model.is_jump.numpy(), float(model.jump)
    size = 6 if isinstance(model, LandmarkModel) else 90
    axes.scatter(places[~jumps, 0], places[~jumps, 1], s=size, color=_GREY, zorder=1)
    axes.scatter(places[jumps, 0], places[jumps, 1], s=90, color="black", marker="*", zorder=3)
    for task, (way, color) in enumerate(zip(ways, COLORS, strict=False), 1):
        way = way[:, :2]
        broken = np.linalg.norm(np.diff(way, axis=0), axis=1) > longest
        shown = np.insert(way, np.flatnonzero(broken) + 1, np.nan, axis=0)
        axes.plot(*shown.T, color=color, linewidth=1.8, zorder=2)
        axes.annotate(f"{task}", way[0], color=color, fontsize=13, fontweight="bold", zorder=4)
        axes.scatter(way[-1, 0], way[-1, 1], s=40, color=color, marker="s", zorder=4)
    axes.set_aspect("equal")
    axes.set_xlabel("x")
    axes.set_ylabel("y")
    axes.set_title("Number: where a task begins; square: where its episode ended", fontsize=10)
    save_figure(figure, path)
