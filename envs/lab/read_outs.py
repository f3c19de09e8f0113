"""Entries that :class:`LabMazeEnv` writes besides its state.

Letters: *B batch, n its elements, M mazes, R rows and C columns of cells, K apples.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torchrl.data import Bounded

from torchrl_hmcts.envs.lab.kernels import APPLES, CELL
from torchrl_hmcts.envs.lab.layout import LabLayout

READ_OUTS = (
    "tile_position",
    "heading",
    "body_velocity",
    "goal",
    "walls_nearby",
    "map",
    "apples",
    "observation",
)
"""What :class:`LabMazeEnv` can write besides its state."""

PAIRS = ("position", "velocity", "turned", *READ_OUTS[:4])
"""Entries of two numbers that the compiled movement writes side by side."""

_COMPILED = READ_OUTS[:4]
_REACH = 2  # cells in each direction of "walls_nearby"


class LabReadOuts:
    """Those of the :data:`READ_OUTS` that are named, as functions of a batch of states."""

    def __init__(self, layout: LabLayout, names: Sequence[str]) -> None:
        self.names = tuple(names)
        unknown = [name for name in self.names if name not in READ_OUTS]
        if unknown or len(set(self.names)) < len(self.names):
            raise ValueError(
                f"LabMazeEnv writes each of the read-outs {list(READ_OUTS)} at most once; got "
                f"{list(self.names)}."
            )
        self._compiled = [(i, n) for i, n in enumerate(PAIRS) if n in self.names]
        self._others = [n for n in self.names if n not in _COMPILED]
        cells = layout.rows * layout.columns
        every = dict.fromkeys(_COMPILED, 2)
        every.update(walls_nearby=(2 * _REACH + 1) ** 2, map=cells, apples=cells)
        every["observation"] = 8 + 2 * cells
        self.sizes = {name: every[name] for name in self.names}
        self._size = np.array([layout.columns, layout.rows], np.float32)
        walls = layout.walls
        self._maps = walls.reshape(len(walls), cells).astype(np.float32)
        self._around = np.pad(
            walls, ((0, 0), (_REACH, _REACH), (_REACH, _REACH)), constant_values=True
        ).astype(np.float32)
        # Where each apple is in the map; those a maze does not have go to a column of their own.
        column = (layout.apples[..., 0] // CELL).astype(np.int64)
        row = layout.rows - 1 - (layout.apples[..., 1] // CELL).astype(np.int64)
        self._apple_cells = np.where(column >= 0, row * layout.columns + column, cells)
        self._bits = np.arange(layout.max_apples)

    def specs(self, device: torch.device | None) -> dict[str, Bounded]:
        """Return the spec of each read-out, without batch dimensions."""
        size = torch.from_numpy(self._size)
        one = torch.ones(2)
        limits = {
            "tile_position": (torch.zeros(2), size),
            "heading": (-one, one),
            "body_velocity": (-3 * one, 3 * one),  # along the body's axes, of a state's limits
            "goal": (-one, size),
        }
        out = {}
        for name, length in self.sizes.items():
            if name == "observation":
                low, high = (
                    torch.cat([*(limits[n][i] for n in _COMPILED), torch.full((length - 8,), i)])
                    for i in (0, 1)
                )
            else:
                low, high = limits.get(name, (torch.zeros(length), torch.ones(length)))
            out[name] = Bounded(low, high, dtype=torch.float32, device=device)
        return out

    def from_pairs(self, pairs: Sequence[torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return those read-outs that are among the :data:`PAIRS`."""
        return {name: pairs[i] for i, name in self._compiled}

    def others(self, pairs: np.ndarray, level: np.ndarray, maze: np.ndarray) -> dict[str, Any]:
        """Return the remaining read-outs, float32 ``[n, size]``, of pairs ``[7, n, 2]``."""
        out = {}
        for name in self._others:
            if name == "walls_nearby":
                out[name] = self._walls_nearby(maze, pairs[0])
            elif name == "map":
                out[name] = self._maps[maze]
            elif name == "apples":
                out[name] = self._apples(maze, level)
            else:
                parts = [*pairs[3:], self._maps[maze], self._apples(maze, level)]
                out[name] = np.concatenate(parts, 1)
        return out

    def _walls_nearby(self, maze: np.ndarray, position: np.ndarray) -> np.ndarray:
        column = (position[:, 0] / CELL).astype(np.int64)
        row = self._around.shape[1] - 2 * _REACH - 1 - (position[:, 1] / CELL).astype(np.int64)
        around = np.arange(2 * _REACH + 1)
        near = self._around[
            maze[:, None, None],
            row[:, None, None] + around[:, None],
            column[:, None, None] + around,
        ]
        return near.reshape(len(maze), -1)

    def _apples(self, maze: np.ndarray, level: np.ndarray) -> np.ndarray:
        cells = self._maps.shape[1]
        out = np.zeros((len(maze), cells + 1), np.float32)
        lies = level[:, APPLES, None] >> self._bits & 1
        out[np.arange(len(maze))[:, None], self._apple_cells[maze]] = lies
        return np.ascontiguousarray(out[:, :cells])
