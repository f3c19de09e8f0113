"""The datasets that can be recorded, and how OGBench recorded each."""

from __future__ import annotations

from typing import NamedTuple

from torchrl_hmcts.trainers.runs.config import unknown_key


class Recipe(NamedTuple):
    """Recipe of a dataset, as in OGBench's scripts."""

    env: str  # id of the env
    kind: str  # navigate: goal after goal; stitch: one, 4 cells away; explore: none; play: presses
    episodes: int
    steps: int  # of an episode
    noise: float = 0.5  # standard deviation: of what is added to actions, in puzzles to the plan
    place: tuple[int, int] = (0, 2)  # columns of the observation: where the point, or the hand, is
    seen: tuple[int, int | None] = (0, None)  # columns that the worker sees
    progress_coeff: float = 2.0  # of the worker's loss
    updates: int = 4_000  # of the worker

    @property
    def is_ant(self) -> bool:
        """Whether an ant walks in it."""
        return self.env.startswith("ant")


_EPISODES = {"navigate": (1_000, 1_001), "stitch": (5_000, 201), "explore": (10_000, 501)}
_GIANT = {"navigate": (500, 2_001), "stitch": (5_000, 201)}
_POINTS = {
    f"pointmaze-{maze}-{kind}-v0": Recipe(
        f"pointmaze-{maze}-v0", kind, *(_GIANT if maze == "giant" else _EPISODES)[kind]
    )
    for maze in ("medium", "large", "giant", "teleport")
    for kind in ("navigate", "stitch")
}
_ANTS = {
    f"antmaze-{maze}-{kind}-v0": Recipe(
        f"antmaze-{maze}-v0",
        kind,
        *episodes,
        noise=1.0 if kind == "explore" else 0.2,
        progress_coeff=0.0,
        updates=10_000,
    )
    for maze in ("medium", "large", "giant", "teleport")
    for kind, episodes in (_GIANT if maze == "giant" else _EPISODES).items()
}
_PUZZLES = {
    f"puzzle-{size}-play-v0": Recipe(
        f"puzzle-{size}-v0", "play", episodes, 1_001, 0.1, (12, 15), (12, 18), 1.0, 10_000
    )
    for size, episodes in {"3x3": 1_000, "4x4": 1_000, "4x5": 3_000, "4x6": 5_000}.items()
}
RECIPES = _POINTS | _ANTS | _PUZZLES
"""By the dataset's name; numbers of ``data_gen_scripts/commands.sh`` in OGBench's repository."""


def split_name(name: str) -> Recipe:
    """Return how a dataset is recorded."""
    if name not in RECIPES:
        raise ValueError(unknown_key(name, RECIPES, "dataset"))
    return RECIPES[name]
