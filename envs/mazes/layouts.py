"""Random tile mazes: generation, the fixed pool, text form and shortest paths.

Letters: M mazes, H rows, W columns, K walls and F free tiles per maze. A maze is a bool tensor
``[H, W]``, True where a tile is a wall, row 0 at the top; all outside is solid. Tile ``(row, col)``
has its centre at ``(col + 0.5, row + 0.5)``, x to the right and y downwards, in tiles.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import lru_cache
from operator import index
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

POOL_SIZE = 2342
POOL_TRAIN_SIZE = 2000
LARGE_WALLS = {15: 96, 31: 440}
"""Walls of the larger mazes by their side: the most frequent numbers that the algorithm grows."""
_LARGE_TRAIN, _LARGE_TEST = 256, 342

_DRAWS_PER_CALL = 4096


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


def _free_area_is_connected(mazes: Tensor) -> Tensor:
    """Whether the free tiles of each maze hang together, bool [M]; False without a free tile."""
    free = ~mazes
    # Start from the first free tile of each maze, where the count of free tiles becomes 1.
    reached = free & (free.flatten(1).cumsum(-1).view(free.shape) == 1)
    while True:
        grown = reached.clone()
        grown[:, 1:] |= reached[:, :-1]
        grown[:, :-1] |= reached[:, 1:]
        grown[:, :, 1:] |= reached[:, :, :-1]
        grown[:, :, :-1] |= reached[:, :, 1:]
        grown &= free
        if torch.equal(grown, reached):
            return (reached == free).flatten(1).all(-1) & free.flatten(1).any(-1)
        reached = grown


def generate_mazes(
    num_mazes: int,
    *,
    height: int = 9,
    width: int = 9,
    num_walls: int | None = 31,
    complexity: float = 0.75,
    density: float = 0.75,
    seed: int = 0,
    connected: bool = True,
) -> Tensor:
    """Generate distinct random mazes with N. P. Rougier's wall-growing algorithm.

    On a ``(height + 2) x (width + 2)`` grid with a solid border, ``int(density * s)`` walls are
    grown, ``s`` being the number of 2x2 blocks of the grid: each starts at a random point with even
    coordinates and makes ``int(complexity * 5 * (rows + columns))`` attempts to step to a random
    even neighbour two tiles away, filling it and the tile between when it is still empty. The
    border is then stripped, draws with another wall count are dropped, then repeated ones and, with
    ``connected``, those whose free tiles fall apart. (Grown walls never close a ring, so on odd
    sizes every draw is connected.)

    Args:
        num_mazes (int): number of mazes M, at least 1.
        height (int): rows H, at least 3. Default 9. An even size is cut out of the next odd one.
        width (int): columns W, at least 3. Default 9.
        num_walls (int, optional): exact number of wall tiles; ``None`` keeps any number. Default
            31, the most frequent number at 9x9 (46 % of draws), so that an observation listing the
            walls has one size.
        complexity (float): attempts per wall, in units of 5 (rows + columns). Default 0.75.
        density (float): number of walls, in units of one per 2x2 block. Default 0.75.
        seed (int): the result is a function of the arguments and this seed, on every platform.
        connected (bool): keep only mazes whose free tiles are connected. Default True.

    Returns:
        bool Tensor ``[num_mazes, height, width]``, True = wall, in the order drawn.

    Raises:
        ValueError: if an argument is out of range.
        RuntimeError: if so many are not found in 100 draws per maze asked for (at least 100,000).

    Reference:
        Wikipedia, "Maze generation algorithm" (Python example by N. P. Rougier, 2010), reference
        [31] of the dissertation; section 3.1.1 for 9x9 tiles and 31 walls.

    Example:
        >>> mazes = generate_mazes(3, seed=7)
        >>> mazes.shape, mazes.flatten(1).sum(-1)
        (torch.Size([3, 9, 9]), tensor([31, 31, 31]))
        >>> generate_mazes(2, height=5, width=13, num_walls=None).shape
        torch.Size([2, 5, 13])
    """
    if num_mazes < 1:
        raise ValueError(f"num_mazes must be at least 1, got {num_mazes}.")
    if height < 3 or width < 3:
        raise ValueError(
            f"A maze needs at least 3 rows and 3 columns for a wall to grow, got height={height}, "
            f"width={width}."
        )
    for name, value in (("complexity", complexity), ("density", density)):
        if not 0 <= value < float("inf"):
            raise ValueError(f"{name} must be a finite number >= 0, got {value}. Use e.g. 0.75.")
    if num_walls is not None and not 0 <= num_walls <= height * width - 2:
        raise ValueError(
            f"num_walls={num_walls} leaves no room for a player and a target among the "
            f"{height * width} tiles of a {height}x{width} maze: use 0 to {height * width - 2}, or "
            f"None for any number."
        )
    max_draws = max(100_000, 100 * num_mazes)
    rng_state = np.array([index(seed) % 2**64], dtype=np.uint64)
    kept: dict[bytes, Tensor] = {}
    wall_histogram = torch.zeros(height * width + 1, dtype=torch.int64)
    for _ in range(0, max_draws, _DRAWS_PER_CALL):
        mazes = draw_mazes(_DRAWS_PER_CALL, height, width, complexity, density, rng_state)
        counts = mazes.flatten(1).sum(-1)
        wall_histogram += counts.bincount(minlength=height * width + 1)
        keep = counts <= height * width - 2 if num_walls is None else counts == num_walls
        mazes = mazes[keep]
        if connected:
            mazes = mazes[_free_area_is_connected(mazes)]
        for maze in mazes:
            kept.setdefault(maze.numpy().tobytes(), maze)
            if len(kept) == num_mazes:
                return torch.stack(list(kept.values()))
    seen = wall_histogram.nonzero().flatten().tolist()
    raise RuntimeError(
        f"Found only {len(kept)} distinct{' connected' * connected} {height}x{width} mazes with "
        f"{'any number of' if num_walls is None else num_walls} walls in {max_draws:,} draws, but "
        f"num_mazes={num_mazes}. Draws with complexity={complexity}, density={density} had "
        f"{seen[0]} to {seen[-1]} walls, most often {int(wall_histogram.argmax())}. Use such a "
        "number, fewer mazes, or another complexity and density."
    )


def maze_pool(split: Literal["train", "test", "all"] = "all", size: int = 9) -> Tensor:
    """Return the fixed pool of 2,342 distinct connected 9x9 mazes with 31 walls, or a split of it.

    With ``size`` larger mazes by the same algorithm, 598 of a side. All are those of
    :func:`generate_mazes` with seed 0; the pool of 9x9 comes with the package.

    Args:
        split (str): ``"train"`` (the first 2,000), ``"test"`` (the other 342) or ``"all"``. Default
            ``"all"``.
        size (int): side of the mazes, 9, 15 (96 walls) or 31 (440 walls). Default 9. The larger
            ones are made when they are asked for.

    Returns:
        bool Tensor ``[2000 | 342 | 2342, 9, 9]``, of the larger ones ``[256 | 342 | 598, size,
        size]``, True = wall; a copy that may be changed freely.

    Raises:
        ValueError: if ``split`` is another word, or there are no mazes of that size.

    Reference:
        Dissertation, section 3.1.1 (the pool); the split is this project's.

    Example:
        >>> maze_pool("train").shape, maze_pool("test").shape
        (torch.Size([2000, 9, 9]), torch.Size([342, 9, 9]))
    """
    if split not in ("train", "test", "all"):
        raise ValueError(f'split must be "train", "test" or "all", got {split!r}.')
    if size != 9 and size not in LARGE_WALLS:
        raise ValueError(
            f"There are mazes of 9, {' and '.join(map(str, LARGE_WALLS))} tiles a side; got "
            f"{size!r}. Make others with generate_mazes(height=..., width=..., num_walls=...)."
        )
    pool, train = (_pool(), POOL_TRAIN_SIZE) if size == 9 else (_large(size), _LARGE_TRAIN)
    parts = {"train": slice(train), "test": slice(train, None), "all": slice(None)}
    return pool[parts[split]].clone()


@lru_cache(maxsize=len(LARGE_WALLS))
def _large(size: int) -> Tensor:
    count, walls = _LARGE_TRAIN + _LARGE_TEST, LARGE_WALLS[size]
    return generate_mazes(count, height=size, width=size, num_walls=walls)


@lru_cache(maxsize=1)
def _pool() -> Tensor:
    bits = np.fromfile(Path(__file__).with_name("pool.bin"), np.uint8)
    walls = np.unpackbits(bits, count=POOL_SIZE * 81).astype(np.bool_)
    return torch.from_numpy(walls.reshape(POOL_SIZE, 9, 9))


def check_mazes(mazes: Tensor) -> None:
    """Refuse mazes unless bool ``[M, H, W]``, equal in their wall counts, connected."""
    is_tensor = isinstance(mazes, Tensor)
    if not is_tensor or mazes.dtype != torch.bool or mazes.ndim != 3 or not mazes.numel():
        got = f"{mazes.dtype} {list(mazes.shape)}" if is_tensor else f"a {type(mazes).__name__}"
        raise ValueError(
            f"mazes must be a bool tensor [num_mazes, height, width], True = wall; got {got}. For "
            f"a single maze use maze[None], for another dtype mazes.bool()."
        )
    counts = mazes.flatten(1).sum(-1)
    if (counts != counts[0]).any():
        bad = int((counts != counts[0]).nonzero()[0])
        raise ValueError(
            f"All mazes must have the same number of walls, so that the observation has one size; "
            f"maze 0 has {int(counts[0])}, maze {bad} has {int(counts[bad])}. Use "
            f"generate_mazes(num_walls=...)."
        )
    num_free = mazes[0].numel() - int(counts[0])
    if num_free < 2:
        raise ValueError(
            f"A maze needs at least 2 free tiles, for the player and the target; got {num_free} in "
            f"each. Use fewer walls, e.g. generate_mazes(num_walls=31)."
        )
    connected = _free_area_is_connected(mazes)
    if not connected.all():
        bad = int((~connected).nonzero()[0])
        raise ValueError(
            f"The free tiles of maze {bad} are not connected, so a target may have no path to it:\n"
            f"{maze_to_text(mazes[bad])}\nOpen a wall, or use generate_mazes(connected=True)."
        )


def maze_from_text(text: str) -> tuple[Tensor, tuple[int, int] | None, tuple[int, int] | None]:
    """Read a maze drawn with ``#`` wall, ``.`` or space free, ``P`` player, ``T`` target.

    Args:
        text (str): one line per row, all of the same length; blank first and last lines and common
            indentation are not removed, except for one leading and trailing newline.

    Returns:
        the maze (bool Tensor ``[H, W]``) and the (row, col) tiles of player and target, or None.

    Raises:
        ValueError: if the rows differ in length, or a character or a second P or T is met.

    Example:
        >>> maze, player, target = maze_from_text("P#.\\n..T")
        >>> maze.int().tolist(), player, target
        ([[0, 1, 0], [0, 0, 0]], (0, 0), (1, 2))
    """
    lines = text.removeprefix("\n").removesuffix("\n").split("\n")
    if not lines[0] or len({len(line) for line in lines}) != 1:
        raise ValueError(
            f"The rows of a maze must have one length >= 1, got {[len(x) for x in lines]}. "
            f"Pad the short rows with '.' (free) or '#' (wall)."
        )
    found: dict[str, tuple[int, int]] = {}
    for row, line in enumerate(lines):
        for col, char in enumerate(line):
            if char not in "#. PT":
                raise ValueError(
                    f"Unknown character {char!r} at row {row}, column {col} of a maze. Use '#' "
                    f"wall, '.' or ' ' free, 'P' player, 'T' target."
                )
            if char in "PT" and found.setdefault(char, (row, col)) != (row, col):
                raise ValueError(
                    f"A maze has at most one {char!r}, found at {found[char]} and {(row, col)}. "
                    f"Remove one."
                )
    maze = torch.tensor([[char == "#" for char in line] for line in lines])
    return maze, found.get("P"), found.get("T")


def maze_to_text(
    maze: Tensor, player: Sequence[int] | None = None, target: Sequence[int] | None = None
) -> str:
    """Draw a maze as text, the inverse of :func:`maze_from_text`.

    Args:
        maze (Tensor): bool ``[H, W]``.
        player (sequence of int, optional): (row, col) tile drawn as ``P`` (over the target).
        target (sequence of int, optional): (row, col) tile drawn as ``T``.

    Returns:
        str, one line per row.

    Example:
        >>> print(maze_to_text(torch.tensor([[False, True], [False, False]]), (0, 0), (1, 1)))
        P#
        .T
    """
    rows = [["#" if wall else "." for wall in row] for row in maze.tolist()]
    for tile, char in ((target, "T"), (player, "P")):
        if tile is not None:
            rows[int(tile[0])][int(tile[1])] = char
    return "\n".join("".join(row) for row in rows)


def wall_centers(mazes: Tensor) -> Tensor:
    """Return the centres (x, y) of the K walls of ``[*B, H, W]``, float32 ``[*B, K, 2]``."""
    rows_cols = mazes.nonzero()[:, -2:].reshape(*mazes.shape[:-2], -1, 2)
    return rows_cols.flip(-1).to(torch.float32) + 0.5


def free_tiles(mazes: Tensor) -> Tensor:
    """Return the indices ``row * W + col`` of the free tiles, in row-major order.

    Args:
        mazes (Tensor): bool ``[*B, H, W]`` with the same number F of free tiles in each.

    Returns:
        int64 Tensor ``[*B, F]``.

    Example:
        >>> free_tiles(torch.tensor([[False, True], [True, False]])).tolist()
        [0, 3]
    """
    return (~mazes).flatten(-2).nonzero()[:, -1].reshape(*mazes.shape[:-2], -1)


def shortest_path_lengths(maze: Tensor, target: Sequence[int]) -> Tensor:
    """Return the number of tile-to-tile moves from every tile to the target (breadth first).

    Args:
        maze (Tensor): bool ``[H, W]``.
        target (sequence of int): (row, col) of a free tile.

    Returns:
        int64 Tensor ``[H, W]``; -1 on walls and on tiles that cannot reach the target.

    Raises:
        ValueError: if the target is a wall or outside the maze.

    Example:
        >>> shortest_path_lengths(torch.tensor([[False, True], [False, False]]), (0, 0)).tolist()
        [[0, -1], [1, 2]]
    """
    height, width = maze.shape
    row, col = int(target[0]), int(target[1])
    if not (0 <= row < height and 0 <= col < width) or maze[row, col]:
        raise ValueError(
            f"The target tile (row, col) = ({row}, {col}) is a wall or outside the "
            f"{height}x{width} maze. Choose a free tile, e.g. from free_tiles(maze)."
        )
    free = (~maze).tolist()
    lengths = [[-1] * width for _ in range(height)]
    queue = deque([(row, col)])
    lengths[row][col] = 0
    while queue:
        row, col = queue.popleft()
        for r, c in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
            if 0 <= r < height and 0 <= c < width and free[r][c] and lengths[r][c] < 0:
                lengths[r][c] = lengths[row][col] + 1
                queue.append((r, c))
    return torch.tensor(lengths)
