"""Text maps of DeepMind Lab as arrays: walls, what lies where, and the faces players meet.

Letters: M mazes, R rows and C columns of cells, K apples, S spawn points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_hmcts.checks import instance
from torchrl_hmcts.envs.lab.kernels import CELL, EAST, NORTH, SOUTH, WEST
from torchrl_hmcts.envs.lab.mazes import APPLE, GOAL, OPEN, SPAWN, WALL

_NOWHERE = -1.0e6


class LabLayout:
    """Mazes of one size as arrays.

    Text maps are sequences of R rows of C letters, the north first: ``*`` wall, ``P`` spawn, ``G``
    goal, ``A`` apple, space.

    Attributes:
        walls: bool ``[M, R, C]``, the north first, as in the text.
        apples, spawn: float32 ``[M, K, 2]``, ``[M, S, 2]``, centres in world units, padded.
        num_apples, num_spawns: int64 ``[M]``.
        goal: float32 ``[M, 2]``; far outside where there is none.
        faces: uint8 ``[M, R, C]``, sides of open cells with a wall, as bits, the south first.
        tables: the arguments of the compiled movement.
    """

    def __init__(self, mazes: Sequence[Sequence[str]]) -> None:
        if not len(mazes):
            raise ValueError("LabMazeEnv needs at least one maze; got none.")
        for maze in mazes:
            instance("LabMazeEnv", "each of mazes", maze, Sequence)
        text = [tuple(maze) for maze in mazes]
        sizes = {(len(maze), len(row)) for maze in text for row in maze}
        if len(sizes) != 1:
            raise ValueError(
                f"All rows of all mazes must have one size (rows, columns); got {sorted(sizes)}."
            )
        self.text = text
        self.rows, self.columns = sizes.pop()
        letters = np.array([[list(row) for row in maze] for maze in text])  # [M, R, C]
        other = sorted(set(letters.ravel().tolist()) - {WALL, OPEN, APPLE, SPAWN, GOAL})
        if other:
            raise ValueError(
                f"A maze is drawn with '*', ' ', 'A', 'P' and 'G'; got the letters {other}."
            )
        self.walls = letters == WALL
        self.apples, self.num_apples = self._places(letters == APPLE)
        self.spawn, self.num_spawns = self._places(letters == SPAWN)
        if self.max_apples > 62:
            raise ValueError(f"A maze can hold at most 62 apples; one has {self.max_apples}.")
        goals, num_goals = self._places(letters == GOAL)
        for i in range(len(text)):
            if num_goals[i] > 1 or self.num_spawns[i] < 1:
                raise ValueError(
                    f"Maze {i} has {num_goals[i]} goals and {self.num_spawns[i]} spawn points; it "
                    f"needs at most one 'G' and at least one 'P'."
                )
        self.goal = goals[:, 0]
        self.faces = self._faces()
        self.tables = (
            self.faces,
            self.apples,
            self.num_apples,
            self.goal,
            self.spawn,
            self.num_spawns,
        )

    def __len__(self) -> int:
        return len(self.text)

    @property
    def max_apples(self) -> int:
        """K, at least 1."""
        return self.apples.shape[1]

    def _places(self, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres of the marked cells ``[M, K, 2]`` in reading order, and how many there are."""
        counts = where.sum((1, 2))
        out = np.full((len(where), max(1, int(counts.max())), 2), _NOWHERE, np.float32)
        for maze, cells in enumerate(where):
            row, column = np.nonzero(cells)
            out[maze, : len(row), 0] = CELL * column + CELL / 2
            out[maze, : len(row), 1] = CELL * (self.rows - 1 - row) + CELL / 2
        return out, counts.astype(np.int64)

    def _faces(self) -> np.ndarray:
        """Sides of open cells with a wall, as bits, uint8 ``[M, R, C]``, the south first."""
        solid = np.pad(self.walls[:, ::-1], ((0, 0), (1, 1), (1, 1)), constant_values=True)
        is_open = ~solid[:, 1:-1, 1:-1]
        faces = np.zeros(is_open.shape, np.uint8)
        faces |= WEST * (is_open & solid[:, 1:-1, :-2]).astype(np.uint8)
        faces |= EAST * (is_open & solid[:, 1:-1, 2:]).astype(np.uint8)
        faces |= SOUTH * (is_open & solid[:, :-2, 1:-1]).astype(np.uint8)
        faces |= NORTH * (is_open & solid[:, 2:, 1:-1]).astype(np.uint8)
        return faces
