"""States and actions of :class:`LabMazeEnv`: entries, bounds, and checks of what is given.

Letters: *B batch of the tensordict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec

from torchrl_hmcts.checks import instance
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

LAB_ACTIONS: Mapping[str, tuple[int, int, int, int]] = {
    "forward": (0, 0, 0, 1),
    "back": (0, 0, 0, -1),
    "strafe left": (0, 0, -1, 0),
    "strafe right": (0, 0, 1, 0),
    "look left": (-20, 0, 0, 0),
    "look right": (20, 0, 0, 0),
    "forward and look left": (-20, 0, 0, 1),
    "forward and look right": (20, 0, 0, 1),
    "nothing": (0, 0, 0, 0),
}
"""The usual discrete actions: look right, look down (pixels per frame), strafe right, forward."""

NATIVE_ACTIONS: Mapping[str, tuple[int, int]] = {
    "LOOK_LEFT_RIGHT_PIXELS_PER_FRAME": (-512, 512),
    "LOOK_DOWN_UP_PIXELS_PER_FRAME": (-512, 512),
    "STRAFE_LEFT_RIGHT": (-1, 1),
    "MOVE_BACK_FORWARD": (-1, 1),
    "FIRE": (0, 1),
    "JUMP": (0, 1),
    "CROUCH": (0, 1),
}
"""The engine's action: lowest and highest value of each of its seven entries, in its order."""
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


def action_table(actions: Mapping[str, Sequence[int]]) -> np.ndarray:
    """Return discrete actions as int64 ``[A, 4]``: look right, look down, strafe right, forward."""
    if not actions:
        raise ValueError("At least one action is needed; got none. Leave the default LAB_ACTIONS.")
    bounds = list(NATIVE_ACTIONS.values())[:4]
    for name, action in actions.items():
        instance("LabMazeEnv", f"the action {name!r} of actions", action, Sequence)
        if len(action) != 4 or any(int(x) != x for x in action):
            raise ValueError(
                f"The action {name!r} must be four integers (look right, look down, strafe right, "
                f"move forward); got {tuple(action)}."
            )
        if not all(low <= x <= high for x, (low, high) in zip(action, bounds, strict=True)):
            raise ValueError(
                f"The action {name!r} = {tuple(action)} is out of range: looks are up to 512 "
                f"pixels per frame, strafe and move -1, 0 or 1."
            )
    return np.array(list(actions.values()), np.int64)


def heading_degrees(turned: np.ndarray, spawn_heading: np.ndarray) -> np.ndarray:
    """Return the heading as the engine reports it, from -180 to 180 in 65,536 steps.

    ``turned`` has the degrees of yaw since the spawn, ``spawn_heading`` has 65,536 to a turn.
    """
    units = np.floor(turned * np.float32(65536.0 / 360.0) + np.float32(0.5)).astype(np.int64)
    units = (units + spawn_heading + 32768) % 65536 - 32768
    return units * (360.0 / 65536.0)
