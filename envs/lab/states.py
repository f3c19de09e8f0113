"""The state of :class:`LabMazeEnv`: its entries, its bounds, and the check of a state from outside.

Letters: *B batch of the tensordict.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical

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


class LabStates:
    """What is a state of the player in a maze.

    Args:
        layout: the mazes.
        max_frames: of an episode.

    Example:
        >>> from torchrl_hmcts.envs.lab.layout import LabLayout
        >>> LabStates(LabLayout([["*****", "*P G*", "*****"]]), 100).level_limits[FRAME]
        (0, 100)
    """

    def __init__(self, layout: LabLayout, max_frames: int) -> None:
        self.layout = layout
        self.level_limits = [(0, 0)] * LEVEL_SIZE
        """Lowest and highest value of each column of ``"level"``."""
        self.level_limits[SPAWN_HEADING] = (0, 65535)
        self.level_limits[APPLES] = (0, 2**layout.max_apples - 1)
        self.level_limits[GOAL_MET] = (0, 1)
        self.level_limits[FRAME] = (0, max_frames)
        self.level_limits[LOTTERY] = (0, 2**32 - 1)
        self.level_limits[CLOCK] = (0, 49)
        self.level_limits[LEAD] = (-1000, 1000)

    def specs(self, device: torch.device | None) -> dict[str, Any]:
        """Return the spec of each entry, without batch dimensions; new ones at every call."""
        size = torch.tensor([self.layout.columns, self.layout.rows], device=device) * float(CELL)
        low, high = (torch.tensor(x, device=device) for x in zip(*self.level_limits, strict=True))
        return {
            "maze_index": Categorical(len(self.layout), shape=(), device=device),
            "position": Bounded(torch.zeros_like(size), size, device=device),
            "velocity": Bounded(-MAX_SPEED, MAX_SPEED, shape=(2,), device=device),
            "turned": Bounded(-360.0, 360.0, shape=(2,), device=device),
            "level": Bounded(low, high, dtype=torch.int64, device=device),
        }

    def check(self, td: TensorDictBase | None) -> None:
        """Raise ValueError unless ``td`` holds a state that can be simulated."""
        missing = [key for key in STATE if td is None or key not in td.keys()]
        if td is None or missing:
            raise ValueError(
                f"reset(td, set_state=True) needs the whole state in td; missing: {missing}. Build "
                f"it with env.make_state(maze_index, position, heading)."
            )
        dtypes = {"maze_index": torch.int64, "level": torch.int64}
        for key in STATE:
            value, dtype = td.get(key), dtypes.get(key, torch.float32)
            shape = [*td.batch_size, *TRAILING[key]]
            if value.dtype != dtype or list(value.shape) != shape:
                raise ValueError(
                    f'"{key}" must be {dtype} {shape}; got {value.dtype} {list(value.shape)}. '
                    f"env.make_state(...) builds a state of the right form."
                )
            self.check_range(key, value)
        self._check_place(td.get("position"), td.get("maze_index"))

    def check_range(self, key: str, value: Tensor) -> None:
        """Raise ValueError if a number of an entry is not finite or out of its bounds."""
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise ValueError(
                f'"{key}" = {value[~torch.isfinite(value)][0].item()} is not finite. A state with '
                f"NaN or infinity cannot be simulated; find the step that wrote it."
            )
        limits: dict[str, tuple[float, float]] = {
            "maze_index": (0, len(self.layout) - 1),
            "velocity": (-MAX_SPEED, MAX_SPEED),
            "turned": (-360.0, 360.0),
        }
        columns: list[tuple[str, Tensor, tuple[float, float]]] = []
        if key in limits:
            columns = [(f'"{key}"', value, limits[key])]
        elif key == "level":
            columns = [
                (f'"level"[..., {i}]', value[..., i], limit)
                for i, limit in enumerate(self.level_limits)
            ]
        for name, column, (low, high) in columns:
            bad = (column < low) | (column > high)
            if bad.any():
                raise ValueError(
                    f"{name} = {column[bad][0].item()} is out of range: {low:g} to {high:g} are "
                    f"allowed."
                )

    def _check_place(self, position: Tensor, maze: Tensor) -> None:
        """Raise ValueError unless every position is in an open cell, clear of its walls."""
        place = np.ascontiguousarray(position.reshape(-1, 2).numpy(force=True))
        index = np.ascontiguousarray(maze.reshape(-1).numpy(force=True))
        column, row = np.floor(place / CELL).astype(np.int64).T
        rows, columns = self.layout.rows, self.layout.columns
        inside = (0 <= column) & (column < columns) & (0 <= row) & (row < rows)
        solid = self.layout.walls[
            index, rows - 1 - row.clip(0, rows - 1), column.clip(0, columns - 1)
        ]
        bad = ~inside | solid
        for wrong, why in (
            (bad, "is not in an open cell"),
            (overlaps_wall(place, index, self.layout.faces) & ~bad, "is in or behind a wall"),
        ):
            if wrong.any():
                i = int(wrong.argmax())
                raise ValueError(
                    f'"position" (x, y) = ({place[i, 0]:g}, {place[i, 1]:g}) {why} of maze '
                    f"{index[i]}: cells are {CELL:g} units wide, counted from the south west, and "
                    f"the player's centre keeps more than 16 units from walls. Choose e.g. one of "
                    f"env.layout.spawn[maze]."
                )
