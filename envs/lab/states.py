"""The state of :class:`LabMazeEnv`: its entries, its bounds, and the check of a state from outside.

Letters: *B batch of the tensordict.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec

from torchrl_hmcts.envs.lab.kernels import (
    APPLES,
    CELL,
    CLOCK,
    FRAME,
    GOAL_MET,
    LEAD,
    LEVEL_SIZE,
    LOTTERY,
    SPAWN_HEADING,
    overlaps_wall,
)
from torchrl_hmcts.envs.lab.layout import LabLayout

STATE = ("maze_index", "position", "velocity", "turned", "level")
TRAILING = {"maze_index": (), "position": (2,), "velocity": (2,), "turned": (2,), "level": (7,)}
MAX_SPEED = 640.0
"""World units per second along an axis, the most that a state may have: twice the top speed."""


def state_specs(
    layout: LabLayout, max_frames: int, device: torch.device | None
) -> dict[str, TensorSpec]:
    """Return the spec of each entry of one state, which has its bounds."""
    limits = [(0, 0)] * LEVEL_SIZE
    limits[SPAWN_HEADING] = (0, 65535)
    limits[APPLES] = (0, 2**layout.max_apples - 1)
    limits[GOAL_MET] = (0, 1)
    limits[FRAME] = (0, max_frames)
    limits[LOTTERY] = (0, 2**32 - 1)
    limits[CLOCK] = (0, 49)
    limits[LEAD] = (-1000, 1000)
    low, high = (torch.tensor(x, device=device) for x in zip(*limits, strict=True))
    size = torch.tensor([layout.columns, layout.rows], device=device) * float(CELL)
    return {
        "maze_index": Categorical(len(layout), shape=(), device=device),
        "position": Bounded(torch.zeros_like(size), size, device=device),
        "velocity": Bounded(-MAX_SPEED, MAX_SPEED, shape=(2,), device=device),
        "turned": Bounded(-360.0, 360.0, shape=(2,), device=device),
        "level": Bounded(low, high, dtype=torch.int64, device=device),
    }


def check_place(layout: LabLayout, position: Tensor, maze: Tensor) -> None:
    """Raise ValueError unless every position is in an open cell, clear of its walls."""
    place = np.ascontiguousarray(position.reshape(-1, 2).numpy(force=True))
    index = np.ascontiguousarray(maze.reshape(-1).numpy(force=True))
    column, row = np.floor(place / CELL).astype(np.int64).T
    rows, columns = layout.rows, layout.columns
    inside = (0 <= column) & (column < columns) & (0 <= row) & (row < rows)
    solid = layout.walls[index, rows - 1 - row.clip(0, rows - 1), column.clip(0, columns - 1)]
    bad = ~inside | solid
    for wrong, why in (
        (bad, "is not in an open cell"),
        (overlaps_wall(place, index, layout.faces) & ~bad, "is in or behind a wall"),
    ):
        if wrong.any():
            i = int(wrong.argmax())
            raise ValueError(
                f'"position" (x, y) = ({place[i, 0]:g}, {place[i, 1]:g}) {why} of maze '
                f"{index[i]}: cells are {CELL:g} units wide, counted from the south west, and "
                f"the player's centre keeps more than 16 units from walls. Choose e.g. one of "
                f"env.layout.spawn[maze]."
            )
