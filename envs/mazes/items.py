"""Things that lie in mazes: apples of different worth, and the key without which a target is shut.

Letters: *B batch, n its elements, M mazes, K things per maze.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.checks import instance, real_number, whole_number
from torchrl_hmcts.envs.mazes.layouts import free_tiles


@dataclass(frozen=True)
class MazeItems:
    """Apples and a key on random tiles of each maze, the same in every episode there.

    An item is taken when the player touches it. An apple earns its worth, once. With a ``key`` the
    target ends the episode, and pays, only for a player who has taken it.

    Args:
        apples (int): apples per maze. Default 0.
        worth (sequence of float): each apple's worth is drawn from these. Default 0.2 and 1.
        key (bool): whether there is a key. Default False.
        seed (int): of the draw. Default 0.

    Raises:
        ValueError: if a number is out of range, or there is neither an apple nor a key.

    Reference:
        This project's; the dissertation's mazes have no reward but the target's.

    Example:
        >>> MazeItems(apples=3, key=True).count
        4
    """

    apples: int = 0
    worth: tuple[float, ...] = (0.2, 1.0)
    key: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        whole_number("MazeItems", "apples", self.apples)
        whole_number("MazeItems", "seed", self.seed)
        instance("MazeItems", "key", self.key, bool)
        instance("MazeItems", "worth", self.worth, tuple, list)
        if not self.count or not self.worth:
            raise ValueError(
                f"MazeItems needs an apple or a key, and a worth for apples; got {self}. Leave "
                f"items=None for a maze without."
            )
        for worth in self.worth:
            real_number("MazeItems", "worth", worth)

    @property
    def count(self) -> int:
        """Items per maze; the key is the last."""
        return self.apples + self.key


class PlacedItems:
    """The items of many mazes, and how they are taken within a distance ``touch``.

    ``places`` are float32 ``[M, K, 2]``, (x, y) in tiles; ``worth`` is float32 ``[M, K]``, 0 for a
    key.
    """

    def __init__(self, items: MazeItems, mazes: Tensor, touch: float) -> None:
        tiles = free_tiles(mazes.cpu())  # [M, F]
        if items.count > tiles.shape[1] - 2:
            raise ValueError(
                f"{items} has {items.count} items; a maze of {tiles.shape[1]} free tiles has room "
                f"for {tiles.shape[1] - 2}, besides player and target."
            )
        generator = torch.Generator().manual_seed(items.seed)
        order = torch.rand(tiles.shape, generator=generator).argsort(-1)[:, : items.count]
        chosen = tiles.gather(1, order)
        width = mazes.shape[2]
        self.places = (torch.stack((chosen % width, chosen // width), -1) + 0.5).numpy()
        drawn = torch.randint(len(items.worth), chosen.shape, generator=generator)
        self.worth = torch.tensor(items.worth, dtype=torch.float32)[drawn].numpy()
        if items.key:
            self.worth[:, -1] = 0.0
        self._key, self._reach = items.key, touch**2

    def draw(self, axes: Any, maze: int) -> None:
        """Draw the items of a maze in axes of matplotlib: apples by their worth, the key a star."""
        x, y = self.places[maze].T
        size = 8.0 + 32.0 * self.worth[maze] / max(1e-9, float(self.worth.max()))
        last = len(x) - self._key
        axes.scatter(x[:last], y[:last], s=size[:last], color="#d55e00", zorder=3)
        axes.scatter(x[last:], y[last:], s=90.0, marker="*", color="#cc79a7", zorder=3)

    def take(
        self, maze: np.ndarray, position: np.ndarray, left: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take what players touch: mazes ``[n]``, positions ``[n, 2]``, items left ``[n, K]``.

        Returns what is left, bool ``[n, K]``, the worth of what was taken, float32 ``[n]``, and
        whether the target is open, bool ``[n]``.
        """
        offset = self.places[maze] - position[:, None]
        offset *= offset
        taken = left & (offset[..., 0] + offset[..., 1] < self._reach)
        after = left & ~taken
        is_open = ~after[:, -1] if self._key else np.ones(len(maze), np.bool_)
        return after, (self.worth[maze] * taken).sum(-1), is_open
