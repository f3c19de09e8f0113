"""The datasets that can be recorded, and how OGBench recorded each."""

from __future__ import annotations

from typing import NamedTuple

from torchrl_hmcts.trainers.runs.config import unknown_key


class Recipe(NamedTuple):
    """Recipe of a dataset, as in OGBench's scripts."""

    env: str  # id of the env
    kind: str  # "navigate": goal after goal; "stitch": one goal, four cells away
    episodes: int
    steps: int  # of an episode
    noise: float = 0.5  # standard deviation added to actions


RECIPES = {
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
        raise ValueError(unknown_key(name, RECIPES, "dataset"))
    return RECIPES[name]
