"""The datasets that can be recorded, and the configuration of the ``ogbench`` experiment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from torchrl_hmcts.trainers.runs.config import ExperimentError, RunConfig, need_package, unknown_key

FOLDER = Path("data") / "ogbench"  # of recorded episodes


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


@dataclass
class OGBenchConfig(RunConfig):
    """Keys of ``hmcts train kit=ogbench env.id=NAME``: learn from recorded episodes, then act.

    The defaults were chosen on pointmaze-teleport-navigate, seed 0; what differs for ants and in
    puzzles is in the recipe of the dataset.
    """

    id: str = "pointmaze-medium-navigate-v0"
    """Name of OGBench's dataset: the env, and how it was recorded (navigate, stitch,
    explore or play)."""
    data: str = ""
    """Recorded episodes: a folder of `hmcts data`, or OGBench's own NAME.npz. Default:
    data/ogbench/NAME, recorded there (minutes; puzzles an hour) if it is not yet."""
    out: str = "runs/ogbench"
    radius: float = 1.5
    """Least distance of two landmarks, in units of the maze, whose corridors are 4 wide; the unit
    of distances that the worker sees."""
    min_count: int = 1
    """Recorded passages from a landmark to another that make an option."""
    jump_factor: float = 10.0
    """Median steps from which on a recorded step is a jump, whose outcomes are left to chance."""
    goal_steps: int = 30
    """Base steps by which a goal of the worker lies ahead, at most, and of an option; in mazes."""
    progress_coeff: float = -1.0
    """Weight of actions that led to the goal fast in the worker's cloning; 0: none. Default -1: 2
    for points, 0 for ants, and 1 in puzzles, where the arm has to leave a button first."""
    updates: int = 0
    """Updates of the worker. Default 0: 4,000 for points, 10,000 for ants and in puzzles."""
    batch_size: int = 512
    """Transitions of an update."""
    learning_rate: float = 1e-3
    """Adam's, falling to 0 in a straight line."""
    gamma: float = 0.9995
    """Discount per base step. An episode has a thousand: what is less likely must not win by being
    faster."""
    simulations: int = 200
    """Options that a search simulates before each option that is taken."""
    episodes: int = 50
    """Episodes of each of the five tasks."""

    EXPERIMENT = "ogbench"
    TOY = {"updates": 200, "episodes": 1}
    KEPT = (
        "seed",
        "toy",
        "id",
        "data",
        "radius",
        "min_count",
        "jump_factor",
        "goal_steps",
        "updates",
    )
    PATHS = ("out", "data")
    ABOVE_ZERO = ("radius", "learning_rate", "jump_factor")
    LEAST = {"progress_coeff": -1, "updates": 0}

    @property
    def recipe(self) -> Recipe:
        """What is known by hand of the env, and how it was recorded."""
        return split_name(self.id)

    @property
    def place(self) -> slice:
        """Columns of an observation that say where the point, the ant or the hand is."""
        return slice(*self.recipe.place)

    @property
    def num_updates(self) -> int:
        """Updates of the worker."""
        return self.updates or self.recipe.updates

    def check_inputs(self) -> None:
        """Check that there is such a dataset, and OGBench."""
        super().check_inputs()
        try:
            split_name(self.id)
        except ValueError as error:
            raise ExperimentError(str(error)) from None
        need_package("ogbench")
        if self.data and not Path(self.data).exists():
            raise ExperimentError(f"data={self.data} does not exist; record it: hmcts data.")
        if not self.data and self.recipe.is_ant and not (FOLDER / self.id).exists():
            raise ExperimentError(
                f"{FOLDER / self.id} does not exist, and ants are recorded by one that can walk: "
                f"hmcts data id={self.id} walker=DIR, with a run of kit=ant in DIR."
            )
