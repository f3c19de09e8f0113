"""Mazes of DeepMind Lab's level ``demos/random_maze``, from the seed of an episode.

Letters: R rows, C columns of the text map, border included; M mazes.
"""

from __future__ import annotations

import torch

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.envs.mazes.layouts import shortest_path_lengths

_MASK = (1 << 64) - 1
_N, _M = 312, 156
_MATRIX = 0xB5026F5AA96619E9
_UPPER, _LOWER = 0xFFFFFFFF80000000, 0x7FFFFFFF

WALL, OPEN, APPLE, SPAWN, GOAL = "*", " ", "A", "P", "G"
OPENING_PROBABILITY = 0.15
"""Chance of each cell inside the border to be opened after the maze is carved."""
SPAWN_DISTANCE = 5
"""Cells: the player appears farther from the goal than this, apples lie nearer."""


class MersenneTwister64:
    """The 64-bit Mersenne Twister, with uniform integers and reals as libstdc++ draws them.

    Reference:
        Nishimura, "Tables of 64-bit Mersenne Twisters", 2000; Lemire, "Fast random integer
        generation in an interval", 2019 (the integers of libstdc++ since gcc 11).
    """

    def __init__(self, seed: int) -> None:
        state = [seed]
        for i in range(1, _N):
            last = state[-1]
            state.append((6364136223846793005 * (last ^ (last >> 62)) + i) & _MASK)
        self._state = state
        self._index = _N

    def next(self) -> int:
        """Return the next 64 random bits."""
        if self._index == _N:
            self._twist()
        x = self._state[self._index]
        self._index += 1
        x ^= (x >> 29) & 0x5555555555555555
        x ^= (x << 17) & 0x71D67FFFEDA60000
        x ^= (x << 37) & 0xFFF7EEE000000000
        return x ^ (x >> 43)

    def uniform_int(self, low: int, high: int) -> int:
        """Return a uniform integer from ``low`` to ``high``, both included."""
        count = high - low + 1
        product = self.next() * count
        if product & _MASK < count:
            threshold = (1 << 64) % count
            while product & _MASK < threshold:
                product = self.next() * count
        return low + (product >> 64)

    def uniform_real(self) -> float:
        """Return a uniform float in [0, 1)."""
        return min(self.next() / 18446744073709551616.0, 1.0 - 2.0**-53)

    def _twist(self) -> None:
        state = self._state
        for i in range(_N):
            x = (state[i] & _UPPER) | (state[(i + 1) % _N] & _LOWER)
            state[i] = state[(i + _M) % _N] ^ (x >> 1) ^ (_MATRIX if x & 1 else 0)
        self._index = 0


def lab_maze(seed: int, rows: int = 9, columns: int = 9, *, mixer_seed: int = 0) -> tuple[str, ...]:
    """Generate the maze that DeepMind Lab makes from an episode's seed.

    A depth-first maze on the cells of even row and column (counted from 1), each cell inside the
    border then opened with probability 0.15; a goal ``G`` on a random even cell; apples ``A``
    nearer than 5 cells to it, spawn points ``P`` farther.

    Args:
        seed: of the episode, as given to ``Lab.reset(seed=...)``, 0 to 2**31 - 1.
        rows, columns: size with the border, odd, at least 5. Default 9 by 9, as the dissertation;
            the level that comes with DeepMind Lab has 15 by 15.
        mixer_seed: the engine's setting of that name. Default 0.

    Returns:
        The text map, one string per row, the top (north) row first.

    Raises:
        ValueError: if the size is even or below 5, or a seed is out of range.

    Reference:
        Beattie et al., "DeepMind Lab", 2016, arXiv 1612.03801; dissertation, section 4.3.

    Example:
        >>> for row in lab_maze(1):
        ...     print(row)
        *********
        *PPP*PPP*
        *P*P*P*P*
        *P*P*P*P*
        *P***** *
        *PPPPP A*
        *******A*
        *AAAAGAA*
        *********
    """
    rows, columns = (
        whole_number("lab_maze", name, size, least=5)
        for name, size in (("rows", rows), ("columns", columns))
    )
    if rows % 2 == 0 or columns % 2 == 0:
        raise ValueError(f"lab_maze needs odd numbers of rows and columns; got {rows}, {columns}.")
    seed, mixer_seed = (
        whole_number("lab_maze", name, value)
        for name, value in (("seed", seed), ("mixer_seed", mixer_seed))
    )
    if max(seed, mixer_seed) >= 2**32:
        raise ValueError(
            f"lab_maze needs seed and mixer_seed below 2**32; got {seed}, {mixer_seed}."
        )
    mixer = mixer_seed << 32
    level_seed = MersenneTwister64(seed ^ mixer).uniform_int(1, 2**31 - 1)
    random = MersenneTwister64(level_seed ^ mixer)
    is_open = _carve(random, rows, columns)
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            if random.uniform_real() < OPENING_PROBABILITY:
                is_open[row][column] = True
    goal = _even_cell(random, rows, columns)
    distance = shortest_path_lengths(~torch.tensor(is_open), goal).tolist()
    return tuple(
        "".join(
            _letter(is_open[row][column], distance[row][column], (row, column) == goal)
            for column in range(columns)
        )
        for row in range(rows)
    )


def _letter(is_open: bool, distance: int, is_goal: bool) -> str:
    if is_goal:
        return GOAL
    if not is_open:
        return WALL
    if distance < 0 or distance == SPAWN_DISTANCE:
        return OPEN
    return SPAWN if distance > SPAWN_DISTANCE else APPLE


def _even_cell(random: MersenneTwister64, rows: int, columns: int) -> tuple[int, int]:
    """Draw a cell of even row and column, counted from 1."""
    row = 2 * random.uniform_int(1, rows // 2)
    return row - 1, 2 * random.uniform_int(1, columns // 2) - 1


def _carve(random: MersenneTwister64, rows: int, columns: int) -> list[list[bool]]:
    """Carve a depth-first maze; every cell of odd index from 0 is reached."""
    is_open = [[False] * columns for _ in range(rows)]
    path = [_even_cell(random, rows, columns)]
    is_open[path[0][0]][path[0][1]] = True
    while path:
        row, column = path[-1]
        unvisited = [
            (r, c)
            for r, c in ((row - 2, column), (row, column - 2), (row + 2, column), (row, column + 2))
            if 0 < r < rows - 1 and 0 < c < columns - 1 and not is_open[r][c]
        ]
        if not unvisited:
            path.pop()
            continue
        r, c = unvisited[random.uniform_int(1, len(unvisited)) - 1]
        is_open[(row + r) // 2][(column + c) // 2] = is_open[r][c] = True
        path.append((r, c))
    return is_open
