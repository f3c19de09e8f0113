"""The score of the agent while its worker learns, frozen from time to time."""

from __future__ import annotations

from typing import Any

import torch

from torchrl_hmcts.envs import OptionWorker
from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent, AtariSearch
from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit

_FIRST = 9_000  # number of a point's first episode: others than those that are scored
CURVE = ("samples", "frames", "mean", "least", "largest")


class LearningCurve:
    """Plays test episodes with a worker that is frozen every so many training samples.

    The starts are the same at every point, and no worker or setting is chosen by what is measured.

    Args:
        kit: the game.
        search: how the agent plans.
        option_steps: base steps of an option.
        every: training samples between two points; the first is the untrained worker.
        episodes: of a point.
        max_steps: base steps after which an episode is ended; 0: none.

    Attributes:
        rows: for each point ``samples``, ``frames`` spent on learning, ``scores`` of the episodes,
            and their ``mean``, ``least`` and ``largest``.
        num_frames: emulated for the test episodes, which are no part of the budget.
    """

    def __init__(
        self,
        kit: AtariKit,
        search: AtariSearch,
        *,
        option_steps: int,
        every: int,
        episodes: int = 3,
        max_steps: int = 0,
    ) -> None:
        self.kit, self.search, self.option_steps = kit, search, option_steps
        self.every, self.episodes, self.max_steps = every, episodes, max_steps
        self.rows: list[dict[str, Any]] = []
        self.num_frames = 0

    def __call__(self, worker: OptionWorker, samples: int, frames: int) -> None:
        """Measure a worker, if a point is due."""
        if self.rows and samples < self.rows[-1]["samples"] + self.every:
            return
        scores = []
        with torch.random.fork_rng(devices=[]):  # what is measured changes nothing
            pool = self.kit.make_pool(worker, self.option_steps, split="test")
            for number in range(_FIRST, _FIRST + self.episodes):
                seed = self.kit.start_seed(number)
                pool.set_seed(seed)
                agent = AtariAgent(pool, self.search, seed=seed)
                scores.append(agent.play(max_steps=self.max_steps or None).score)
            self.num_frames += pool.num_frames
            pool.close()
        row: dict[str, Any] = {"samples": samples, "frames": frames, "scores": scores}
        row |= {"mean": sum(scores) / len(scores), "least": min(scores), "largest": max(scores)}
        self.rows.append(row)
        self.kit.log(f"after {samples:,} training samples: scores {scores}")
