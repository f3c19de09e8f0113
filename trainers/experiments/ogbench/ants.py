"""An ant that walks in any direction: the expert that records the episodes of ant mazes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_hmcts.envs.gym.ant import body_of, seen_from, turns
from torchrl_hmcts.envs.gym.skill_worker import SkillWorker
from torchrl_hmcts.trainers.agent import HMCTS
from torchrl_hmcts.trainers.experiments.kits.ant import open_arena

_KEEP = math.radians(40.0)  # between heading and frame, as long as a skill lasts
_MAZE = "antmaze-medium-v0"  # all have the same ant
_TRIAL = 100  # steps in which a skill shows its direction


class AntWalker:
    """Walks in any direction, by the skills of ``hmcts train kit=ant`` and turns of the body.

    A skill was learned as seen from the heading that the ant had when it began. Seen from another
    frame it leads elsewhere. Of all skills and quarter turns of the body the one is taken whose
    frame is nearest to the heading, until these are 40 degrees apart.

    Args:
        folder: of a run or an agent of the kit ``ant`` in one of OGBench's mazes.
    """

    def __init__(self, folder: str | Path) -> None:
        agent = HMCTS(_MAZE, kit="ant", worker=str(folder))
        self._skills = SkillWorker(agent.worker.actor, deterministic=True)
        self._body, self._action, _ = turns()
        self._draws = np.random.default_rng(0)  # not used: the most probable action
        arena = open_arena(_MAZE)
        angles = [self._try(arena, skill) for skill in range(self._skills.num_options)]
        arena.close()
        self._options = [
            (skill, quarter, angle + quarter * math.pi / 2)
            for skill, angle in enumerate(angles)
            for quarter in range(4)
        ]
        self._taken: tuple[int, int, float] | None = None

    def _try(self, arena: Any, skill: int) -> float:
        """The direction of a skill, in the frame that it begins with."""
        seen, _ = arena.reset(seed=0)
        begin, (_, frame) = seen[:2].copy(), body_of(seen)
        for _ in range(_TRIAL):
            seen, *_ = arena.step(self._act(seen, frame, skill, 0))
        x, y = seen_from(frame, *(seen[:2] - begin))
        return math.atan2(y, x)

    def _act(self, seen: np.ndarray, frame: Any, skill: int, quarter: int) -> np.ndarray:
        body = self._body(body_of(seen, frame)[0], quarter)
        return self._action(self._skills.act(body, skill, self._draws), -quarter % 4)

    def __call__(self, seen: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Return an action.

        Args:
            seen: positions and velocities of the ant, ``[29]``.
            way: where it shall walk, a vector ``[2]``.

        Returns:
            ``[8]``.
        """
        _, (c, s) = body_of(seen)
        ahead = math.atan2(way[1], way[0]) - math.atan2(s, c)

        def apart(option: tuple[int, int, float]) -> float:
            return abs((ahead - option[2] + math.pi) % (2 * math.pi) - math.pi)

        if self._taken is None or apart(self._taken) > _KEEP:
            self._taken = min(self._options, key=apart)
        skill, quarter, angle = self._taken
        frame = math.atan2(way[1], way[0]) - angle
        return self._act(seen, (math.cos(frame), math.sin(frame)), skill, quarter)
