"""Draws the curves of the results page from the data in docs/results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from torchrl_hmcts.trainers.experiments.dissertation_figures import draw_figure
from torchrl_hmcts.trainers.figures.curves import style
from torchrl_hmcts.trainers.figures.pictures import COLORS


def draw_curves(results: Path, folder: Path) -> dict[str, dict[str, str]]:
    """Write the pictures into a folder; return captions by name, by the file that they show."""
    drawn: dict[str, dict[str, str]] = {}
    for name, draw in (
        ("a3c/a3c_figures.json", cartpole),
        ("lab/labmaze.json", lab_training),
        ("planner/peers_128.json", peers),
    ):
        if (results / name).exists():
            picture = name.replace("/", "_").removesuffix(".json") + ".png"
            figure = Figure(figsize=(8.0, 3.6), layout="constrained")
            draw(json.loads((results / name).read_text()), figure)
            figure.savefig(folder / picture, dpi=160)
            drawn[name] = {picture: ""}
    if (results / "atari/runs.json").exists():
        games = [draw_figure(f"5.{number}", [], results, folder) for number in range(1, 8)]
        drawn["atari/runs.json"] = {
            path.name: f"The dissertation's figure 5.{number}. {caption}"
            for number, (path, caption) in enumerate(games, 1)
        }
    return drawn


def _axes(figure: Figure, title: str, **labels: str) -> Any:
    axes = figure.subplots()
    style(axes, title)
    axes.set(**labels)
    return axes


def cartpole(data: dict[str, Any], figure: Figure) -> None:
    axes = _axes(figure, "CartPole-v1, return of the policy under evaluation", xlabel="frames")
    for color, run in zip(COLORS, data["cartpole"], strict=False):
        axes.plot(
            run["eval_frames"], run["eval_return"], "o-", color=color, label=f"seed {run['seed']}"
        )
    axes.set_ylim(0, 520)
    axes.legend(frameon=False)


def lab_training(data: dict[str, Any], figure: Figure) -> None:
    axes = _axes(
        figure,
        "Figure 4.10: frames to solve a test maze while the worker learns",
        xlabel="frames of training",
        ylabel="frames, mean",
    )
    runs = {k: v for k, v in data["results"].items() if k.endswith("training") and v.get("curve")}
    for color, (name, run) in zip(COLORS, runs.items(), strict=False):
        label = name.removesuffix(" training").replace(" ", ", seed ")
        curve = run["curve"]
        axes.plot(curve["training_steps"], curve["frames"], "o-", color=color, label=label)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)


def peers(data: dict[str, Any], figure: Figure) -> None:
    axes = _axes(
        figure,
        "Simulations per CPU second, 128 per root",
        xlabel="roots searched side by side",
    )
    libraries = dict.fromkeys(row["library"] for row in data["figures"])
    for color, library in zip(COLORS, libraries, strict=False):
        rows = [
            row
            for row in data["figures"]
            if row["library"] == library and row.get("simulations_per_cpu_second")
        ]
        axes.plot(
            [row["batch"] for row in rows],
            [row["simulations_per_cpu_second"] for row in rows],
            "o-",
            color=color,
            linewidth=2.4 if library.startswith("ours") else 1.3,
            label=library.split(" [")[0],
        )
    axes.set(xscale="log", yscale="log")
    axes.set_xticks(sorted({row["batch"] for row in data["figures"]}))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_minor_formatter("")
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.legend(frameon=False, fontsize=8, bbox_to_anchor=(1.0, 1.0), loc="upper left")
