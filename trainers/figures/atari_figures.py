"""Pictures of Atari runs: scores against frames, and an episode as it was played."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from tensordict import TensorDict

from torchrl_hmcts.envs import AtariOptionPool, AtariRAMEnv
from torchrl_hmcts.trainers.figures.animation import write_gif
from torchrl_hmcts.trainers.figures.atari_scores import HUMAN_AND_RANDOM, TABLE_5_1
from torchrl_hmcts.trainers.figures.curves import draw_band, style
from torchrl_hmcts.trainers.figures.pictures import COLORS, save_figure

_EVERY = 3  # base steps between two pictures


def plot_scores(episodes: Sequence[Mapping[str, float]], path: Path, *, title: str) -> None:
    """Plot the score of each episode, and the best so far, against emulated frames."""
    frames = np.array([row["frames"] for row in episodes])
    scores = np.array([row["score"] for row in episodes])
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.step(frames, np.maximum.accumulate(scores), where="post", color="#9ca3af", label="best")
    axes.plot(frames, scores, "o", color="#2563eb", label="episode")
    axes.set(title=title, xlabel="emulated frames, real and simulated", ylabel="score")
    axes.xaxis.set_major_formatter(EngFormatter())
    axes.margins(x=0.08)
    axes.legend(frameon=False)
    axes.grid(alpha=0.25)
    save_figure(figure, path, dpi=120)


def plot_learning(
    workers: Mapping[str, Sequence[Sequence[Mapping[str, Any]]]], path: Path, *, title: str
) -> None:
    """Plot mean, least and largest score against training samples.

    Each worker has a curve for each seed, whose points have ``samples`` and the ``scores`` of the
    test episodes.
    """
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for (name, seeds), color in zip(workers.items(), itertools.cycle(COLORS)):
        episodes = [
            ([row["samples"] for row in rows], scores)
            for rows in seeds
            for scores in zip(*(row["scores"] for row in rows), strict=True)
        ]
        draw_band(axes, episodes, color=color, marker="o", label=name)
    style(axes, title, short=True)
    axes.set(xlabel="training samples", ylabel="score, worker frozen")
    axes.legend(frameon=False)
    save_figure(figure, path, dpi=120)


def write_atari_gif(
    recorder: AtariOptionPool, options: Sequence[int], path: Path, *, real_steps: int = 450
) -> tuple[int, float]:
    """Execute the options of an episode once more and write what the screen shows."""
    env = AtariRAMEnv(recorder.game, repeat_action_probability=0.0)
    pictures = []
    shown, score = 0, 0.0
    state = recorder.reset(TensorDict(batch_size=[1]))
    for option in options:
        after = recorder.step(state.clone().set("option", torch.tensor([option])))["next"]
        td = env.reset(state.squeeze(0).select("emulator_state"), set_state=True)
        for i in range(int(after["duration"])):
            td = env.step(td.set("action", after["inner_action"][0, i]))["next"]
            if i % _EVERY == 0:
                pictures.append(env.render())
        shown, score = shown + int(after["duration"]), score + float(after["score"].sum())
        state = after.select("emulator_state", "ram", "observation", strict=False)
        if shown >= real_steps or bool(after["done"].any()):
            break
    assert isinstance(recorder.frame_skip, int)
    seconds = _EVERY * recorder.frame_skip / 60.0
    frames = [p.repeat(2, axis=1) for p in pictures]  # a console's pixels are wide
    write_gif(frames, path, milliseconds=1000.0 * seconds, last=None)
    return shown, score


def plot_sticky(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Plot the score of each planned episode against all emulated frames, a panel for each game.

    The dotted line is a human's score; rows of a game are its seeds.
    """
    rows = [row for row in rows if row["episodes"]]
    games = [game for game in TABLE_5_1 if any(row["game"] == game for row in rows)]
    figure = Figure(figsize=(10.0, 5.2), layout="constrained")
    panels = figure.subplots(2, 4).flatten()
    for axes, game in zip(panels, games, strict=False):
        for row, color in zip((r for r in rows if r["game"] == game), itertools.cycle(COLORS)):
            frames = [episode["frames"] for episode in row["episodes"]]
            scores = [episode["score"] for episode in row["episodes"]]
            axes.plot(frames, scores, ".", color=color, alpha=0.4)
            means = [np.mean(scores[max(0, i - 9) : i + 1]) for i in range(len(scores))]
            axes.plot(frames, means, color=color)
        axes.axhline(HUMAN_AND_RANDOM[game][0], color="#9ca3af", linestyle=":")
        style(axes, game, short=True)
        axes.set_xlim(left=0)
        axes.locator_params(axis="x", nbins=4)
    for axes in panels[len(games) :]:
        axes.set_axis_off()
    figure.supxlabel("emulated frames, all kinds", fontsize=10)
    figure.supylabel("score: episodes, and the mean of the last ten", fontsize=10)
    save_figure(figure, path, dpi=110)
