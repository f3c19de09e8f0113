"""Every figure of the dissertation that shows data, by its number: what draws ours, from what."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchrl_hmcts.trainers.runs.config import unknown_key
from torchrl_hmcts.trainers.saving.run_folder import RunFolder

_LAB_RUNS = "hmcts train experiment=labmaze seed={seed} out=runs/labmaze_{seed}"
_GOAL_RUNS = "hmcts train experiment=waterworld_goals seed={seed} out=runs/goals_{seed}"
_A3C_RUNS = "hmcts train experiment=waterworld_a3c seed={seed} out=runs/a3c_{seed}"


class MissingData(ValueError):
    """Data of a figure are not there; the message says which commands make them."""


@dataclass(frozen=True)
class Sources:
    """Data that figures may be drawn from."""

    runs: tuple[RunFolder, ...] = ()
    results: Path | None = None

    def of(self, *experiments: str) -> list[RunFolder]:
        """Return the runs of these experiments."""
        return [run for run in self.runs if run.experiment in experiments]

    def result(self, name: str) -> Path | None:
        """Return a file of the measured results, if it is there."""
        path = None if self.results is None else self.results / name
        return path if path is not None and path.exists() else None


@dataclass(frozen=True)
class DissertationFigure:
    """A figure or table of the dissertation.

    ``draws`` names a function ``draw(figure, sources, path) -> caption`` of the module
    ``dissertation_figures``; it raises :class:`MissingData` if it lacks something.
    """

    name: str  # its number, or "table5.1"
    shows: str  # its content there
    draws: str
    data: str = "drawn afresh"  # that ours is drawn from
    commands: tuple[str, ...] = ()  # that make the data; {seed} stands for 0, 1, 2
    argument: str = ""  # of the function, e.g. the game
    ending: str = ".png"

    @property
    def file(self) -> str:
        """Name of the file that is written."""
        return ("" if self.name.startswith("table") else "figure_") + self.name + self.ending

    def missing(self, what: str) -> MissingData:
        """Return the error that says what is missing and which commands make it."""
        lines = [f"{self.name}: {what} It is made with"]
        for command in self.commands:
            seeds = "   (also for seeds 1, 2, ...)" if "{seed}" in command else ""
            lines.append(f"    {command.format(seed=0)}{seeds}")
        return MissingData("\n".join(lines))


def _loss(number: int, curve: str, name: str) -> DissertationFigure:
    return DissertationFigure(
        f"4.{number}",
        f"training loss of the worker's {name} (DIAYN)",
        "draw_loss",
        "docs/results/lab/curves.csv (seed 0), or runs of labmaze",
        (_LAB_RUNS, f"hmcts report figure=4.{number} runs/labmaze_*"),
        curve,
    )


def _game(number: int, game: str) -> DissertationFigure:
    command = f"hmcts train experiment=atari game={game} seed={{seed}} out=runs/{game}_{{seed}}"
    return DissertationFigure(
        f"5.{number}",
        f"running score of the episodes that the agent plays in {game}: mean, least and largest "
        "over the seeds; no worker learns here, the learning curve is learning.png of a run",
        "draw_scores",
        "docs/results/atari, or runs of atari",
        (command, f"hmcts report figure=5.{number} runs/{game}_*"),
        game,
    )


_GAMES = ("BeamRider", "Breakout", "Enduro", "Pong", "Qbert", "Seaquest", "SpaceInvaders")
_ALL = (
    DissertationFigure(
        "3.1", "Waterworld: a random maze with the player and the target", "draw_environments"
    ),
    DissertationFigure(
        "3.2", "Gridworld: the same maze as the manager's tiles", "draw_environments"
    ),
    DissertationFigure(
        "3.4", "the tree search over tiles, and the plan it finds in the maze", "draw_tile_search"
    ),
    DissertationFigure(
        "3.5",
        "the manager's goals as dots in an episode",
        "draw_goals",
        "drawn afresh with a scripted worker, or with the worker of a run of waterworld_goals",
    ),
    DissertationFigure(
        "3.6",
        "training of the goal-based agent and of A3C alone",
        "draw_learning",
        "docs/results/goals/goal_agent.json, or runs of waterworld_goals and waterworld_a3c",
        (_GOAL_RUNS, _A3C_RUNS, "hmcts report figure=3.6 runs/goals_* runs/a3c_*"),
    ),
    DissertationFigure("4.4", "four random mazes of DeepMind Lab as text", "draw_mazes"),
    DissertationFigure(
        "4.5",
        "trajectories of the skills: 10 mini-episodes of 100 frames for each",
        "draw_skills",
        "the worker of a run of labmaze, or docs/results/lab/skills.png",
        (_LAB_RUNS, "hmcts report figure=4.5 runs/labmaze_0"),
    ),
    _loss(6, "loss_actor", "actor"),
    _loss(7, "qvalue_loss_0", "critic 1"),
    _loss(8, "qvalue_loss_1", "critic 2"),
    _loss(9, "loss_discriminator", "discriminator"),
    DissertationFigure(
        "4.10",
        "mean time to solve a maze while the worker learns",
        "draw_solving",
        "docs/results/lab/labmaze.json, or runs of labmaze",
        (_LAB_RUNS, "hmcts report figure=4.10 runs/labmaze_*"),
    ),
    *(_game(number, game) for number, game in enumerate(_GAMES, 1)),
    DissertationFigure(
        "table5.1",
        "high scores of the hierarchical agent in seven games; beside it Table A.1's baselines",
        "draw_table",
        "docs/results/atari, or runs of atari",
        (
            "hmcts train experiment=atari game=Breakout seed={seed} out=runs/Breakout_{seed}",
            "hmcts report figure=table5.1 runs/*",
        ),
        ending=".html",
    ),
)
FIGURES = {figure.name: figure for figure in _ALL}


def find_figure(name: str) -> DissertationFigure:
    """Return a figure by its number; ``figure_`` or ``Figure `` before it does no harm."""
    short = name.lower().replace("figure", "").replace(" ", "").strip("_")
    if short not in FIGURES:
        raise ValueError(unknown_key(short, FIGURES, "figure"))
    return FIGURES[short]


def find_results(folder: str | None = None) -> Path | None:
    """Return the folder of measured results."""
    if folder is not None:
        if not Path(folder).is_dir():
            raise ValueError(f"results={folder} is no folder.")
        return Path(folder)
    repository = Path(__file__).resolve().parents[2]
    places = (Path("docs/results"), repository / "docs" / "results")
    return next((place for place in places if place.is_dir()), None)
