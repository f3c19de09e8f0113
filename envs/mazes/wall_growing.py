"""N. P. Rougier's wall-growing algorithm: the compiled kernel behind ``generate_mazes``."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor


def _grow_walls(
    num_draws: int, rows: int, cols: int, num_starts: int, walk_steps: int, rng_state: Any
) -> Any:
    """Draw mazes with the border included, uint8 [num_draws, rows, cols]; compiled by numba.

    ``rng_state`` (uint64 [1]) is a SplitMix64 state, updated in place. The generator is spelled out
    so that a seed gives the same mazes with every version of numpy and numba.
    """
    grids = np.zeros((num_draws, rows, cols), dtype=np.uint8)
    neighbours = np.zeros((4, 2), dtype=np.int64)
    state = rng_state[0]
    for draw in range(num_draws):
        grid = grids[draw]
        grid[0, :] = 1
        grid[rows - 1, :] = 1
        grid[:, 0] = 1
        grid[:, cols - 1] = 1
        for _ in range(num_starts):
            # A random even point of the lattice, border included.
            state = state + np.uint64(0x9E3779B97F4A7C15)
            bits = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            bits = bits ^ (bits >> np.uint64(31))
            row = 2 * np.int64((bits >> np.uint64(32)) % np.uint64(rows // 2 + 1))
            col = 2 * np.int64((bits & np.uint64(0xFFFFFFFF)) % np.uint64(cols // 2 + 1))
            grid[row, col] = 1
            for _ in range(walk_steps):
                count = 0
                empty = 0
                for direction in range(4):
                    next_row = row + (-2 if direction == 0 else 2 if direction == 1 else 0)
                    next_col = col + (-2 if direction == 2 else 2 if direction == 3 else 0)
                    if 0 <= next_row < rows and 0 <= next_col < cols:
                        neighbours[count, 0] = next_row
                        neighbours[count, 1] = next_col
                        count += 1
                        empty += 1 - grid[next_row, next_col]
                if empty == 0:
                    break  # walls never vanish: the walk cannot leave this point any more
                state = state + np.uint64(0x9E3779B97F4A7C15)
                bits = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
                bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
                bits = bits ^ (bits >> np.uint64(31))
                choice = np.int64(bits % np.uint64(count))
                next_row = neighbours[choice, 0]
                next_col = neighbours[choice, 1]
                if grid[next_row, next_col] == 0:
                    grid[next_row, next_col] = 1
                    grid[(row + next_row) // 2, (col + next_col) // 2] = 1
                    row = next_row
                    col = next_col
    rng_state[0] = state
    return grids


@lru_cache(maxsize=1)
def _compiled_grow_walls() -> Callable[..., Any]:
    # numba takes a second to import; only generation needs it, not a pool read from the cache.
    from torchrl_hmcts.compiling import njit

    return njit()(_grow_walls)


def draw_mazes(
    num_draws: int,
    height: int,
    width: int,
    complexity: float,
    density: float,
    rng_state: np.ndarray,
) -> Tensor:
    """Draw mazes without any filter, bool [num_draws, H, W]."""
    # Walls live on the even points of an odd lattice; an even size is cut out of the next odd one.
    rows, cols = height + 2 + (height + 1) % 2, width + 2 + (width + 1) % 2
    num_starts = int(density * ((rows // 2) * (cols // 2)))
    walk_steps = int(complexity * (5 * (rows + cols)))
    grids = _compiled_grow_walls()(num_draws, rows, cols, num_starts, walk_steps, rng_state)
    return torch.from_numpy(grids[:, 1 : height + 1, 1 : width + 1].astype(np.bool_))
