"""The datasets that can be recorded, and how OGBench recorded each."""

from __future__ import annotations

import difflib
from typing import NamedTuple


class Recipe(NamedTuple):
    """Recipe of a dataset, as in OGBench's scripts."""

    env: str  # id of the env
    kind: str  # "navigate": goal after goal; "stitch": one goal, four cells away; "play": presses
    episodes: int
    steps: int  # of an episode
    noise: float = 0.5  # standard deviation: of what is added to actions, in puzzles to the plan
    place: tuple[int, int] = (0, 2)  # columns of the observation: where the point, or the hand, is


_MAZES = {
    f"pointmaze-{maze}-{kind}-v0": Recipe(
        f"pointmaze-{maze}-v0",
        kind,
        *(
            (5_000, 201)
            if kind == "stitch"
            else (500, 2_001)
            if maze == "giant"
            else (1_000, 1_001)
        ),
    )
    for maze in ("medium", "large", "giant", "teleport")
    for kind in ("navigate", "stitch")
}
_PUZZLES = {
    f"puzzle-{size}-play-v0": Recipe(f"puzzle-{size}-v0", "play", episodes, 1_001, 0.1, (12, 15))
    for size, episodes in {"3x3": 1_000, "4x4": 1_000, "4x5": 3_000, "4x6": 5_000}.items()
}
RECIPES = _MAZES | _PUZZLES
"""By the dataset's name; numbers of ``data_gen_scripts/commands.sh`` in OGBench's repository."""


def split_name(name: str) -> Recipe:
    """Return how a dataset is recorded.

    Args:
        name: as OGBench names it.

    Raises:
        ValueError: if there is none of that name; the nearest are named.

    Example:
        >>> split_name("pointmaze-giant-navigate-v0")[:4]
        ('pointmaze-giant-v0', 'navigate', 500, 2001)
    """
    if name not in RECIPES:
        near = difflib.get_close_matches(name, RECIPES, n=3, cutoff=0.4) or RECIPES
        raise ValueError(f"Unknown dataset {name!r}. Did you mean: {', '.join(near)}?")
    return RECIPES[name]
