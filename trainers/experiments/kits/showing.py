"""What a run over any kit gives: learned skills, episodes, and pictures of both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import LossModule

from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner
from torchrl_hmcts.trainers.evaluation import Results
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.skills.rounds import RoundRecords

CAPTIONS: Mapping[str, str] = {
    "episode.gif": "A test maze as it was solved: the plan (pale; colours are skills) and the "
    "worker's way.",
    "unsolved": "A test maze that was NOT solved: the plan, if one was found (pale; colours "
    "are skills), and how far the worker came.",
    "search.png": "The search for that plan: every place an option led to (grey: refused by "
    "the novelty test), and the tree.",
    "skills.png": "The skills: 10 mini-episodes for each, in an open room and in a maze.",
    "losses.png": "Training of the worker: actor, both critics, discriminator.",
}
"""Captions of the pictures."""


@dataclass
class LearnedSkills:
    """A worker and how it became what it is.

    Attributes:
        worker (TensorDictModule): with its most probable actions.
        loss (LossModule, optional): with its networks; None where nothing was learned.
        history (mapping): all logged curves.
        tests (RoundRecords): what it achieved while it learned.
        steps (int): base steps of training, simulated ones included.
        worker_step (int): those that the networks have seen that are kept.
        rounds (int): of Algorithm 3.
        seconds (float): of the processor, tests included.
    """

    worker: TensorDictModuleBase
    loss: LossModule | None
    history: Mapping[str, list[float]]
    tests: RoundRecords
    steps: int
    worker_step: int
    rounds: int
    seconds: float


@dataclass
class Trial:
    """One episode from each start: a plan, executed in another instance of the env.

    Attributes:
        starts (TensorDict): states ``[M]``.
        planner (MCTSPlanner): with which the plans were made.
        results (Results): what they led to.
        second_searches (int): starts that were searched twice.
        compile_seconds (float): until the first plan of all was made.
        cpu_seconds (float): of all searches and episodes.
    """

    starts: TensorDictBase
    planner: MCTSPlanner
    results: Results
    second_searches: int
    compile_seconds: float
    cpu_seconds: float


def start_to_show(trial: Trial, lengths: np.ndarray) -> int:
    """Return a start that was solved, if any, with a rather long way, by their lengths ``[M]``."""
    solved = np.flatnonzero(trial.results.solved)
    among = solved if len(solved) else np.arange(len(trial.starts))
    by_length = among[np.argsort(lengths[among], kind="stable")]
    return int(by_length[int(0.85 * (len(by_length) - 1))])


def draw_run(kit: Any, pictures: Pictures, learned: LearnedSkills, trial: Trial) -> None:
    """Draw the pictures of a run."""
    config, captions = kit.config, kit.captions
    shown, episode, search = kit.replay(learned.worker, trial)
    drawing = kit.map(kit.make_env("test"))
    if drawing is not None:
        words = captions["episode.gif" if episode.solved[0] else "unsolved"]
        with pictures.one("episode.gif", words) as path:
            kit.write_film(episode, path)
        with pictures.one("search.png", captions["search.png"]) as path:
            from torchrl_hmcts.trainers.figures.maps import plot_search

            plot_search(drawing, search, path)
    if learned.loss is None:
        return
    if drawing is not None:
        steps = learned.worker_step * config.frames_per_step
        seen = f" The worker of all pictures is that after {steps:,} {kit.unit}."
        with pictures.one("skills.png", captions["skills.png"] + seen) as path:
            from torchrl_hmcts.trainers.figures.maps import plot_skill_fan

            generator = torch.Generator().manual_seed(config.seed)
            sampling = SkillPolicy(learned.loss.actor_network, generator=generator)
            maze = int(trial.starts[shown].get("maze_index", torch.zeros(())))
            rooms = drawing.rooms(10 * config.num_skills, maze)
            steps = 100 // config.frames_per_step
            plot_skill_fan(sampling, rooms, path, num_skills=config.num_skills, steps=steps)
    if not learned.history:
        return
    with pictures.one("losses.png", captions["losses.png"]) as path:
        from torchrl_hmcts.trainers.figures.curves import plot_losses

        plot_losses(learned.history, learned.steps, path)


def write_film(drawing: Any, episode: Results, path: str | Path) -> None:
    """Write an episode as a GIF, and as a video beside it, of the env's own pictures if any."""
    from torchrl_hmcts.trainers.figures import animation, maps

    if episode.frames or drawing is None:
        animation.write_gif(episode.frames, path, milliseconds=40.0)
        return
    options = episode.options[0].tolist()
    states = list(episode.states[0].unbind(0))
    maps.write_episode_gif(drawing, states, options, episode.plans[0], path)
