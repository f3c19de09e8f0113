"""The figures of chapter 4: lab mazes, skills, their training, and solving mazes with them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.trainers.experiments.settings import LabMazeConfig
from torchrl_hmcts.trainers.experiments.lab.training import curve_script_frames
from torchrl_hmcts.trainers.experiments.lab.worker import (
    held_out_seeds,
    make_lab_env,
    make_worker_loss,
)
from torchrl_hmcts.trainers.figures.curve_panels import common_steps
from torchrl_hmcts.trainers.figures.dissertation import Sources, find_figure
from torchrl_hmcts.trainers.figures.lab_figures import (
    plot_frames_curves,
    plot_mazes,
    plot_skill_fan,
)
from torchrl_hmcts.trainers.figures.pictures import save_figure
from torchrl_hmcts.trainers.runs.folder import RunFolder, load_config, read_curves

_NAMES = {"diayn": "DIAYN", "hmcts": "Algorithm 3"}


def draw_mazes(sources: Sources, path: Path, name: str) -> str:
    """Draw four test mazes as text and from above.

    Args:
        sources: not needed.
        path: PNG to write.
        name: of the figure.

    Returns:
        The caption.
    """
    plot_mazes(make_lab_env(held_out_seeds(4)), path)
    return "Four test mazes, made afresh from their seeds."


def draw_skills(sources: Sources, path: Path, name: str) -> str:
    """Draw the trajectories of the skills of a run's worker."""
    runs = sources.of("labmaze")
    if runs:
        from torchrl_hmcts.trainers.runs.worker_file import load_networks

        config: LabMazeConfig = load_config(runs[0])[1]
        loss = make_worker_loss(config.num_skills, seed=config.seed)
        load_networks(loss, runs[0].path)
        sampling = SkillPolicy(
            loss.actor_network, generator=torch.Generator().manual_seed(config.seed)
        )
        env = make_lab_env(held_out_seeds(4), num_steps=config.frames_per_step)
        plot_skill_fan(sampling, env, path, num_skills=config.num_skills)
        return f"The skills of {runs[0].name}: 10 mini-episodes of 100 frames for each."
    measured = sources.result("lab/skills.png")
    if measured is None:
        raise find_figure(name).how_to_get_data("there is no run of labmaze.")
    shutil.copyfile(measured, path)
    return "The skills of a worker with seed 0 (docs/results): 10 mini-episodes of 100 frames each."


def draw_loss(sources: Sources, path: Path, name: str) -> str:
    """Draw a loss of the worker while it learns: mean, least and largest over the seeds."""
    figure = find_figure(name)
    runs = [run.curves for run in _alike(sources) if figure.argument in run.curves]
    measured = sources.result("lab/curves.csv")
    where = "given runs"
    if not sources.of("labmaze") and measured is not None:
        runs = [found for found in [read_curves(measured.parent)] if figure.argument in found]
        where = "docs/results"
    if not runs:
        raise figure.how_to_get_data("there is no run of labmaze with its curves.")
    curves = [run[figure.argument] for run in runs]
    steps, values = common_steps(curves)
    width = max(1, len(steps) // 40)

    def smooth(line: np.ndarray) -> np.ndarray:
        return np.convolve(line, np.ones(width) / width, mode="valid")

    shown = Figure(figsize=(6.6, 4.0), layout="constrained")
    axes = shown.subplots()
    axes.plot(steps, values.mean(0), color="#b9c4d6", linewidth=0.7)
    x = steps[width // 2 :][: len(steps) - width + 1]
    lines = np.stack([smooth(line) for line in values])
    if len(runs) > 1:
        low, high = lines.min(0), lines.max(0)
        axes.fill_between(x, low, high, color="#1d4ed8", alpha=0.16, linewidth=0)
    axes.plot(x, lines.mean(0), color="#1d4ed8", linewidth=1.8)
    axes.set_title(figure.shows, fontsize=11, loc="left")
    axes.set_xlabel(curves[0].step_label)
    axes.grid(alpha=0.25)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.spines[["top", "right"]].set_visible(False)
    save_figure(shown, path)
    band = ", band from the least to the largest" if len(runs) > 1 else ""
    return (
        f"{figure.shows[0].upper()}{figure.shows[1:]}, {len(runs)} seed(s) of {where}: moving "
        f"average{band}; pale: as it is logged."
    )


def draw_solving(sources: Sources, path: Path, name: str) -> str:
    """Draw frames of an episode in held-out mazes against frames of training."""
    runs = _alike(sources)
    curves: list[dict[str, Any]] = []
    config = LabMazeConfig()
    where = f"{len(runs)} run(s) given"
    for run in runs:
        if "frames" in run.curves and "solved" in run.curves:
            frames, solved = run.curves["frames"], run.curves["solved"]
            config = load_config(run)[1]
            curves.append(
                {
                    "training_steps": frames.steps,
                    "frames": frames.values,
                    "solved": solved.values,
                }
            )
    measured = sources.result("lab/labmaze.json")
    if not curves and measured is not None:
        results = json.loads(measured.read_text(encoding="utf-8"))["results"]
        curves = [
            row["curve"]
            for key, row in results.items()
            if key.startswith("diayn ") and key.endswith(" training")
        ]
        where = f"{len(curves)} seed(s) of docs/results"
    if not curves:
        raise find_figure(name).how_to_get_data("there is no run of labmaze with its curves.")
    title = f"{_NAMES[config.algorithm]}: {config.curve_mazes} held-out mazes of 9 x 9"
    plot_frames_curves(curves, path, title=title, script=curve_script_frames(config))
    return f"Frames to solve a held-out maze while the worker learns; {where}."


def _alike(sources: Sources) -> list[RunFolder]:
    """The runs of labmaze with the config of the first one."""
    runs = sources.of("labmaze")
    keys = ("algorithm", "train_frames", "num_skills", "option_frames", "frames_per_step")
    return [r for r in runs if all(r.config.get(k) == runs[0].config.get(k) for k in keys)]
