"""An ant that walks in any direction: the expert that records the episodes of ant mazes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_hmcts.envs.gym.ant import body_of, seen_from, turns
from torchrl_hmcts.envs.gym.skill_worker import SkillWorker
from torchrl_hmcts.trainers.experiments.gym_settings import AntConfig
from torchrl_hmcts.trainers.experiments.kits import make_kit
from torchrl_hmcts.trainers.experiments.kits.ant import open_arena
from torchrl_hmcts.trainers.experiments.skills import load_skills

_MAZE = "antmaze-medium-v0"  # all have the same ant
_TRIAL = 100  # steps in which a skill shows its direction


class AntWalker:
    """Walks in any direction, by a skill of ``hmcts train kit=ant`` and quarter turns of the body.

    A skill was learned as seen from the heading that the ant had when it began. Seen from a frame
    that is turned it leads elsewhere. Of the four quarters the one is taken whose frame is nearest
    to the heading. So an action is a function of the state and the direction, as it is of OGBench's
    expert, and a network can clone it.
    """

    def __init__(self, folder: str | Path) -> None:
        learned = load_skills(make_kit(AntConfig(id=_MAZE)), folder)
        assert learned.loss is not None
        self._skills = SkillWorker(learned.loss.actor_network, deterministic=True)
        self._body, self._action, _ = turns()
        self._draws = np.random.default_rng(0)  # not used: the most probable action
        arena, skills = open_arena(_MAZE), range(self._skills.num_options)
        self._skill = 0
        moved = [self._try(arena, skill) for skill in skills]
        arena.close()
        self._skill = max(skills, key=lambda skill: math.hypot(*moved[skill]))
        x, y = moved[self._skill]
        self._angle = math.atan2(y, x)

    def _try(self, arena: Any, skill: int) -> tuple[float, float]:
        """How far a skill leads, in the frame that it begins with."""
        self._skill, (seen, _) = skill, arena.reset(seed=0)
        begin, (_, frame) = seen[:2].copy(), body_of(seen)
        for _ in range(_TRIAL):
            seen, *_ = arena.step(self._act(seen, frame, 0))
        x, y = seen_from(frame, *(seen[:2] - begin))
        return float(x), float(y)

    def _act(self, seen: np.ndarray, frame: Any, quarter: int) -> np.ndarray:
        body = self._body(body_of(seen, frame)[0], quarter)
        return self._action(self._skills.act(body, self._skill, self._draws), -quarter % 4)

    def __call__(self, seen: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Return an action ``[8]`` of an ant, ``[29]``, that shall walk along a vector ``[2]``."""
        _, (c, s) = body_of(seen)
        first = math.atan2(way[1], way[0]) - self._angle  # of the frame, without a quarter
        quarter = round((first - math.atan2(s, c)) / (math.pi / 2))
        frame = first - quarter * math.pi / 2
        return self._act(seen, (math.cos(frame), math.sin(frame)), quarter % 4)
