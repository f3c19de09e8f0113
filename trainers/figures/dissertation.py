"""Every figure of the dissertation that shows data, by its number: what draws ours, from what."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchrl_hmcts.trainers.figures.foreign_files import refuse_foreign, stamp
from torchrl_hmcts.trainers.runs.folder import RunFolder, is_run, read_run
from torchrl_hmcts.trainers.saving.files import write_text

_LAB_RUNS = "hmcts train experiment=labmaze seed={seed} out=runs/labmaze_{seed}"
_GOAL_RUNS = "hmcts train experiment=waterworld_goals seed={seed} out=runs/goals_{seed}"
_A3C_RUNS = "hmcts train experiment=waterworld_a3c seed={seed} out=runs/a3c_{seed}"


class MissingData(ValueError):
    """What a figure is drawn from is not there; the message says which commands make it."""


@dataclass(frozen=True)
class Sources:
    """What figures may be drawn from.

    Args:
        runs: folders that were named on the command line.
        results: folder with measured results, ``docs/results`` of the repository, if there is one.
    """

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
class SourceFigure:
    """A figure or table of the dissertation.

    Args:
        name: its number, or ``"table5.1"``.
        shows: what it shows there.
        draws: function ``draw(sources, path, argument) -> caption`` as ``".module:function"``; it
            raises :class:`MissingData` if it lacks something.
        argument: handed to it.
        data: what ours is drawn from.
        commands: that make the data; ``{seed}`` stands for 0, 1, 2.
        file: name of the file that is written.

    Example:
        >>> find_figure("3.6").data
        'docs/results/goals/goal_agent.json, or runs of waterworld_goals and waterworld_a3c'
    """

    name: str
    shows: str
    draws: str
    data: str
    commands: tuple[str, ...] = ()
    argument: str = ""
    ending: str = ".png"

    @property
    def file(self) -> str:
        """Name of the file that is written."""
        return (
            f"{self.name if self.name.startswith('table') else 'figure_' + self.name}{self.ending}"
        )

    @property
    def draw(self) -> Callable[[Sources, Path, str], str]:
        """What draws ours; loads torch where it needs it."""
        module, _, name = self.draws.partition(":")
        function: Callable[[Sources, Path, str], str] = getattr(
            importlib.import_module(module, __package__), name
        )
        return function

    def how_to_get_data(self, what: str) -> MissingData:
        """Return the error that says what is missing and which commands make it."""
        lines = []
        for command in self.commands:
            seeds = "   (also for seeds 1, 2, ...)" if "{seed}" in command else ""
            lines.append(f"    {command.format(seed=0)}{seeds}")
        return MissingData("\n".join([f"{self.name}: {what} It is made with", *lines]))


@dataclass(frozen=True)
class Drawn:
    """A figure that was drawn, and a sentence on what it is drawn from."""

    figure: SourceFigure
    path: Path
    caption: str


def _game(number: int, game: str) -> SourceFigure:
    command = f"hmcts train experiment=atari game={game} seed={{seed}} out=runs/{game}_{{seed}}"
    return SourceFigure(
        f"5.{number}",
        f"scores of the hierarchical agent in {game} while it learns: mean, least and largest",
        ".atari_results:draw_game",
        "docs/results/atari, or runs of atari",
        (command, f"hmcts report figure=5.{number} runs/{game}_*"),
        argument=game,
    )


def _loss(number: int, curve: str, name: str) -> SourceFigure:
    return SourceFigure(
        f"4.{number}",
        f"training loss of the worker's {name} (DIAYN)",
        ".chapter_4:draw_loss",
        "docs/results/lab/curves.csv (seed 0), or runs of labmaze",
        (_LAB_RUNS, f"hmcts report figure=4.{number} runs/labmaze_*"),
        argument=curve,
    )


FIGURES = {
    figure.name: figure
    for figure in (
        SourceFigure(
            "3.1",
            "Waterworld: a random maze with the player and the target",
            ".chapter_3:draw_environments",
            "drawn afresh",
        ),
        SourceFigure(
            "3.2",
            "Gridworld: the same maze as the manager's tiles",
            ".chapter_3:draw_environments",
            "drawn afresh",
        ),
        SourceFigure(
            "3.4",
            "the tree search over tiles, and the plan it finds in the maze",
            ".chapter_3:draw_tile_search",
            "drawn afresh",
        ),
        SourceFigure(
            "3.5",
            "the manager's goals as red dots in an episode",
            ".chapter_3:draw_goals",
            "drawn afresh with a scripted worker, or with the worker of a run of waterworld_goals",
        ),
        SourceFigure(
            "3.6",
            "training of the goal-based agent and of A3C alone",
            ".chapter_3:draw_learning",
            "docs/results/goals/goal_agent.json, or runs of waterworld_goals and waterworld_a3c",
            (_GOAL_RUNS, _A3C_RUNS, "hmcts report figure=3.6 runs/goals_* runs/a3c_*"),
        ),
        SourceFigure(
            "4.4",
            "four random mazes of DeepMind Lab as text",
            ".chapter_4:draw_mazes",
            "drawn afresh",
        ),
        SourceFigure(
            "4.5",
            "trajectories of the skills: 10 mini-episodes of 100 frames for each",
            ".chapter_4:draw_skills",
            "the worker of a run of labmaze, or docs/results/lab/skills.png",
            (_LAB_RUNS, "hmcts report figure=4.5 runs/labmaze_0"),
        ),
        _loss(6, "loss_actor", "actor"),
        _loss(7, "qvalue_loss_0", "critic 1"),
        _loss(8, "qvalue_loss_1", "critic 2"),
        _loss(9, "loss_discriminator", "discriminator"),
        SourceFigure(
            "4.10",
            "mean time to solve a maze while the worker learns",
            ".chapter_4:draw_solving",
            "docs/results/lab/labmaze.json, or runs of labmaze",
            (_LAB_RUNS, "hmcts report figure=4.10 runs/labmaze_*"),
        ),
        _game(1, "BeamRider"),
        _game(2, "Breakout"),
        _game(3, "Enduro"),
        _game(4, "Pong"),
        _game(5, "Qbert"),
        _game(6, "Seaquest"),
        _game(7, "SpaceInvaders"),
        SourceFigure(
            "table5.1",
            "high scores of the hierarchical agent in seven games; beside it Table A.1's baselines",
            ".atari_results:write_table",
            "docs/results/atari, or runs of atari",
            (
                "hmcts train experiment=atari game=Breakout seed={seed} out=runs/Breakout_{seed}",
                "hmcts report figure=table5.1 runs/*",
            ),
            ending=".html",
        ),
    )
}


def find_figure(name: str) -> SourceFigure:
    """Return a figure by its number; ``figure_`` or ``Figure `` before it does no harm.

    Args:
        name: e.g. ``"3.6"`` or ``"table5.1"``.

    Raises:
        ValueError: if there is none of that name; the nearest are named.
    """
    short = name.lower().replace("figure", "").replace(" ", "").strip("_")
    if short not in FIGURES:
        near = difflib.get_close_matches(short, FIGURES, n=3, cutoff=0.5) or FIGURES
        raise ValueError(f"Unknown figure {name!r}. Did you mean: {', '.join(near)}?")
    return FIGURES[short]


def find_results(folder: str | None = None) -> Path | None:
    """Return the folder of measured results.

    Args:
        folder: as given by the user. Default: ``docs/results`` in the current folder, else that of
            the repository from which the package is installed.

    Raises:
        ValueError: if the given folder does not exist.
    """
    if folder is not None:
        if not Path(folder).is_dir():
            raise ValueError(f"results={folder} is no folder.")
        return Path(folder)
    repository = Path(__file__).resolve().parents[2]
    for place in (Path("docs/results"), repository / "docs" / "results"):
        if place.is_dir():
            return place
    return None


def draw_figure(
    name: str, folders: Sequence[str | Path], results: Path | None, out: str | Path
) -> Drawn:
    """Draw one figure.

    Args:
        name: its number.
        folders: of runs to draw it from; may be empty.
        results: folder of measured results.
        out: folder to write into.

    Raises:
        MissingData: if what it is drawn from is not there.
        ValueError: if the name is unknown, a folder is none of a run, or a file that was not drawn
            by this package would be replaced.
    """
    figure = find_figure(name)
    sources = Sources(tuple(read_run(folder) for folder in folders), results)
    Path(out).mkdir(parents=True, exist_ok=True)
    path = Path(out) / figure.file
    refuse_foreign(path)
    if figure.ending == ".html" and not path.exists() and path.with_suffix(".md").exists():
        refuse_foreign(path.with_suffix(".md"))  # the table beside the page
    caption = figure.draw(sources, path, figure.name)
    stamp(path)
    return Drawn(figure, path, caption)


def draw_all(
    folders: Sequence[str | Path], results: Path | None, out: str | Path
) -> tuple[Path, list[str]]:
    """Draw every figure whose data are there, and a page of all of them.

    Args:
        folders: of runs to draw from.
        results: folder of measured results.
        out: folder to write into.

    Returns:
        The page, and what is said about each figure that lacks its data.
    """
    from torchrl_hmcts.trainers.figures.page_parts import Html, page, picture, section, text

    file = Path(out) / "index.html"
    for path in (file, *(Path(out) / figure.file for figure in FIGURES.values())):
        refuse_foreign(path)
    if is_run(out):
        raise ValueError(f"out={out} is the folder of a run, whose page is index.html.")
    parts, lacking = [], []
    for figure in FIGURES.values():
        title = figure.name.replace("table", "Table ")
        title = title if title.startswith("Table") else f"Figure {title}"
        there = Html(f'<p class="lead">In the source: {text(figure.shows)}.</p>')
        try:
            drawn = draw_figure(figure.name, folders, results, out)
        except MissingData as error:
            lacking.append(str(error))
            parts.append(section(title, there, Html(f"<pre>{text(str(error))}</pre>")))
            continue
        if drawn.path.suffix == ".html":
            link = f'<p><a href="{text(drawn.path.name)}">{text(drawn.caption)}</a></p>'
            parts.append(section(title, there, Html(link)))
        else:
            parts.append(section(title, there, picture(drawn.path, drawn.caption, embed=True)))
    write_text(file, page("The dissertation's figures, drawn of this package", *parts))
    return file, lacking
