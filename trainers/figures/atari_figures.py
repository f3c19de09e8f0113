"""Pictures of Atari runs: scores against frames, and an episode as it was played."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from torchrl_hmcts.envs import AtariOptionPool, AtariRAMEnv
from torchrl_hmcts.trainers.atari.agent import AtariAgent
from torchrl_hmcts.trainers.figures.animation import write_gif
from torchrl_hmcts.trainers.figures.pictures import save_figure

_EVERY = 3  # base steps between two pictures


def plot_scores(episodes: Sequence[Mapping[str, float]], path: Path, *, title: str) -> None:
    """Plot the score of each episode, and the best so far, against emulated frames.

    Args:
        episodes: with ``"frames"`` (emulated so far, at their end) and ``"score"``.
        path: PNG to write.
        title: e.g. the game.
    """
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


def write_atari_gif(
    agent: AtariAgent, recorder: AtariOptionPool, path: Path, *, real_steps: int = 450
) -> None:
    """Play the beginning of an episode and write what the screen shows.

    Args:
        agent: plays in the pool it plans in; its episode begins anew.
        recorder: a pool of the same options with ``record=True``: what the agent plays in.
        path: GIF to write.
        real_steps: base steps to show at most.
    """
    env = AtariRAMEnv(recorder.game, repeat_action_probability=0.0)
    pictures = []
    agent.real = recorder
    agent.begin()
    while not agent.progress.done and agent.progress.real_steps < real_steps:
        assert agent.state is not None
        before = agent.state
        agent.play(1)
        assert agent.last_step is not None
        td = env.reset(before.squeeze(0).select("emulator_state"), set_state=True)
        for i in range(int(agent.last_step["duration"])):
            td = env.step(td.set("action", agent.last_step["inner_action"][0, i]))["next"]
            if i % _EVERY == 0:
                pictures.append(env.render())
    seconds = _EVERY * recorder.frame_skip / 60.0
    frames = [p.repeat(2, axis=1) for p in pictures]  # a console's pixels are wide
    write_gif(frames, path, milliseconds=1000.0 * seconds, last=None)
