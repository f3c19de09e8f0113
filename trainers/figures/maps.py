"""Skills, searches and episodes, drawn over a map of their environment.

Letters: N states, T base steps of an episode, Z skills.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_hmcts.envs import LabMazeEnv, WaterworldMazeEnv, draw_first_person
from torchrl_hmcts.envs.mazes.rendering import draw_goal, draw_walls
from torchrl_hmcts.modules import EffectModel, LandmarkModel
from torchrl_hmcts.planners import Plan, Search
from torchrl_hmcts.planners.drawing import OPTION_COLORS, option_color
from torchrl_hmcts.trainers.figures.animation import STEPS_PER_FRAME, steps_to_show, write_gif
from torchrl_hmcts.trainers.figures.pictures import COLORS, save_figure

_GREY, _PALE = "#71717a", "#d4d8e0"
_MAX_NODES = 600  # of a tree in a picture

Path2D = tuple[np.ndarray, np.ndarray]
"""Points ``[P, 2]`` and the colours 0 to 255 of the lines between them, ``[P - 1, 3]``."""


class MapDrawing(Protocol):
    """Draws the states of an environment; what the pictures of a kit need of it."""

    env: EnvBase
    milliseconds: float

    def background(self, axes: Axes, state: TensorDictBase) -> None:
        """Draw what lies below the states of an episode, e.g. walls and goal."""

    def points(self, states: TensorDictBase) -> Tensor:
        """Return where states ``[N]`` lie in such axes, ``[N, 2]``."""

    def picture(self, state: TensorDictBase, paths: Sequence[Path2D]) -> np.ndarray:
        """Return a picture of a state, uint8 ``[h, w, 3]``, with paths in the units of the axes."""

    def rooms(self, num: int, maze: int = 0) -> dict[str, tuple[MapDrawing, TensorDictBase]]:
        """Return, for each panel of :func:`plot_skill_fan`, a drawing and ``num`` equal states."""


@dataclass
class WaterworldMap:
    """Draws Waterworld's mazes, x to the right and y down, in tiles."""

    env: WaterworldMazeEnv

    def __post_init__(self) -> None:
        self.milliseconds = 500.0 * self.env.TIME_STEP  # twice real time

    def background(self, axes: Axes, state: TensorDictBase) -> None:
        self.env.draw_map(axes, state)

    def points(self, states: TensorDictBase) -> Tensor:
        position: Tensor = states["position"]
        return position

    def picture(self, state: TensorDictBase, paths: Sequence[Path2D]) -> np.ndarray:
        image: np.ndarray = self.env.render(state, paths=paths)
        return image

    def rooms(self, num: int, maze: int = 0) -> dict[str, tuple[MapDrawing, TensorDictBase]]:
        """Return an open room and a maze, with states in their middle."""
        walls = self.env.mazes[maze]
        height, width = walls.shape
        center = torch.tensor([width / 2, height / 2])
        tiles = (~walls).nonzero().flip(-1) + 0.5
        middle = tiles[(tiles - center).square().sum(-1).argmin()]
        found: dict[str, tuple[MapDrawing, TensorDictBase]] = {}
        rooms = (torch.zeros_like(walls), center), (walls, middle)
        for title, (here, start) in zip(_ROOMS, rooms, strict=True):
            env = WaterworldMazeEnv(
                here[None],
                observation=False,
                max_steps=10**9,
                steering=self.env.steering,
                drag=self.env.drag,
            )
            corner = (~here).nonzero()[-1].flip(-1) + 0.5  # reached last
            state = env.make_state(torch.zeros(num, dtype=torch.long), start, corner)
            found[title] = WaterworldMap(env), state
        return found


@dataclass
class LabMap:
    """Draws lab mazes in cells, x to the east and y to the north."""

    env: LabMazeEnv

    def __post_init__(self) -> None:
        self.milliseconds = 1000.0 * self.env.num_steps / 60.0

    def background(self, axes: Axes, state: TensorDictBase) -> None:
        layout, maze = self.env.layout, int(state["maze_index"])
        draw_walls(axes, layout.walls[maze], north_up=True)
        if layout.goal[maze, 0] >= 0:
            draw_goal(axes, layout.goal[maze] / self.env.CELL)

    def points(self, states: TensorDictBase) -> Tensor:
        position: Tensor = states["position"] / self.env.CELL
        return position

    def picture(self, state: TensorDictBase, paths: Sequence[Path2D]) -> np.ndarray:
        shown = [
            (self.env.to_picture(torch.as_tensor(points) * self.env.CELL).numpy(), colors)
            for points, colors in paths
        ]
        tile = max(8, 288 // self.env.layout.rows)
        above = self.env.render(state, paths=shown, tile_pixels=tile)
        height = above.shape[0]
        seen = draw_first_person(self.env, state, width=height * 4 // 3, height=height)
        return np.concatenate((above, seen), 1)

    def rooms(self, num: int, maze: int = 0) -> dict[str, tuple[MapDrawing, TensorDictBase]]:
        """Return an open room and a maze, with states in their middle.

        Each state has a heading of its own: a skill is a direction on the map, whichever way the
        player faces.
        """
        generator = np.random.default_rng(0)
        layout = self.env.layout
        rows, columns = layout.rows, layout.columns
        inside = "*" + " " * (columns - 2) + "*"
        room = ["*" * columns, *[inside] * (rows - 2), "*" * columns]
        middle = columns // 2
        room[rows // 2] = inside[:middle] + "P" + inside[middle + 1 :]
        found: dict[str, tuple[MapDrawing, TensorDictBase]] = {}
        for title, text in zip(_ROOMS, (room, layout.text[maze]), strict=True):
            env = LabMazeEnv([text], num_steps=self.env.num_steps, read_outs=self.env.read_outs)
            places = env.layout.spawn[0, : env.layout.num_spawns[0]]
            center = env.CELL / 2.0 * np.array([columns, rows])
            start = places[np.square(places - center).sum(-1).argmin()]
            heading = torch.from_numpy(generator.random(num) * 360.0)
            index = torch.zeros(num, dtype=torch.long)
            found[title] = LabMap(env), env.make_state(index, torch.from_numpy(start), heading)
        return found


_ROOMS = ("in an open room", "in a test maze")


@dataclass
class FeatureMap:
    """Draws the states of an environment without a map: two of its features against each other."""

    env: EnvBase
    key: Any = "observation"
    features: tuple[int, int] = (0, 1)
    limits: tuple[tuple[float, float], tuple[float, float]] | None = None
    names: tuple[str, str] = ("", "")
    is_place: bool = False
    milliseconds: float = 40.0

    def background(self, axes: Axes, state: TensorDictBase) -> None:
        if self.is_place:
            axes.set_aspect("equal")
        axes.set(xlabel=self.names[0], ylabel=self.names[1])
        axes.grid(alpha=0.25)
        if self.limits is not None:
            axes.set(xlim=self.limits[0], ylim=self.limits[1])

    def points(self, states: TensorDictBase) -> Tensor:
        found: Tensor = states[self.key][..., list(self.features)]
        return found

    def picture(self, state: TensorDictBase, paths: Sequence[Path2D]) -> np.ndarray:
        figure = Figure(figsize=(4.0, 4.0), dpi=80, layout="constrained")
        canvas, axes = FigureCanvasAgg(figure), figure.subplots()
        self.background(axes, state)
        for points, colors in paths:
            for line, color in zip(zip(points[:-1], points[1:], strict=True), colors, strict=True):
                axes.plot(*np.array(line).T, color=np.asarray(color) / 255, linewidth=2.5)
        axes.plot(*self.points(state).tolist(), "o", color="black")
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def rooms(self, num: int, maze: int = 0) -> dict[str, tuple[MapDrawing, TensorDictBase]]:
        """Return states at the beginning of an episode, for :func:`plot_skill_fan`."""
        return {"from a start": (self, self.env.reset().expand(num).clone())}


@torch.no_grad()
def plot_skill_fan(
    policy: Any,
    rooms: Mapping[str, tuple[MapDrawing, TensorDictBase]],
    path: str | Path,
    *,
    num_skills: int,
    steps: int = 100,
) -> None:
    """Draw the trajectories of each skill, one colour each, in a panel for each room.

    Reference:
        Dissertation, figure 4.5: 10 mini-episodes of 100 frames for each policy.
    """
    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    panels = figure.subplots(1, len(rooms), squeeze=False)[0]
    for axes, (title, (drawing, td)) in zip(panels, rooms.items(), strict=True):
        drawing.background(axes, td[0].exclude("target"))  # skills know none
        skills = torch.arange(num_skills).repeat_interleave(len(td) // num_skills)
        points = [drawing.points(td)]
        for _ in range(steps):
            td = drawing.env.step(policy(td.set("skill", skills)))["next"].exclude("reward")
            points.append(drawing.points(td))
        lines = torch.stack(points, 1).numpy()
        for skill, line in zip(skills.tolist(), lines, strict=True):
            axes.plot(*line.T, color=option_color(skill), linewidth=1.3, alpha=0.7)
        axes.plot(*points[0][0].tolist(), "o", color="black", markersize=6)
        axes.set_title(title, fontsize=10, loc="left")
    handles = [Line2D([], [], color=option_color(z), label=f"skill {z}") for z in range(num_skills)]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(8, num_skills))
    save_figure(figure, path)


def plot_search(drawing: MapDrawing, search: Search, path: str | Path) -> None:
    """Draw where the options of a search led on the map, and the tree; the plan stands out.

    Reference:
        Dissertation, figure 3.4.
    """
    tree = search.tree
    assert tree.states is not None
    names = [f"skill {number}" for number in range(tree.num_options)]
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.15))
    drawing.background(left, tree.states[0, 0])
    tree.plot_positions(0, drawing.points, ax=left, option_names=names, legend=False)
    left.set_title("where the options led", fontsize=10, loc="left")
    tree.plot(0, ax=right, max_nodes=_MAX_NODES, option_names=names)
    legend_below(figure, right.get_legend(), ncols=6)  # one for both
    save_figure(figure, path)


def write_episode_gif(
    drawing: MapDrawing,
    states: Sequence[TensorDictBase],
    options: Sequence[int],
    plan: Plan,
    path: str | Path,
) -> None:
    """Write an episode as a GIF: the plan pale, the way so far in the colours of its options."""
    length = int(plan.lengths)
    colors = _colors(plan.options[:length].tolist())
    planned = drawing.points(plan.states[: length + 1]).numpy()
    paths = [(planned, (255 - 0.35 * (255 - colors)).round())] if length else []
    trail = torch.stack([drawing.points(state) for state in states]).numpy()
    taken = _colors(options)
    pictures = []
    for step in steps_to_show(len(states) - 1):
        walked = [(trail[: step + 1], taken[:step])] if step else []
        pictures.append(drawing.picture(states[step], [*paths, *walked]))
    write_gif(pictures, path, milliseconds=drawing.milliseconds * STEPS_PER_FRAME)


def plot_mazes(env: LabMazeEnv, path: str | Path) -> None:
    """Draw four mazes as text, goal "G" and walls "*", and below as they look from above.

    Reference:
        Dissertation, figure 4.4.
    """
    figure = Figure(figsize=(10.4, 5.4), layout="constrained")
    grid = figure.subplots(2, 4)
    size = 108.0 / env.layout.rows
    for maze, (above, below) in enumerate(grid.T):
        rows = (" ".join(row) for row in env.layout.text[maze])  # about as wide as high
        text = "\n".join(rows).replace("P", " ").replace("A", " ")
        above.text(
            0.5, 0.5, text, family="monospace", fontsize=size, ha="center", va="center",
            transform=above.transAxes, linespacing=1.05,
        )  # fmt: skip
        above.set_axis_off()
        LabMap(env).background(below, TensorDict({"maze_index": torch.tensor(maze)}))
    save_figure(figure, path)


def plot_ways(model: LandmarkModel | EffectModel, ways: Sequence[np.ndarray], path: Path) -> None:
    """Draw where options lead, and a way for each task."""
    places, longest = model.places.numpy()[:, :2], float("inf")
    jumps = np.zeros(len(places), np.bool_)
    figure = Figure(figsize=(7, 6), layout="constrained")
    axes = figure.add_subplot()
    if isinstance(model, LandmarkModel):
        starts, options = np.nonzero(model.targets.numpy() >= 0)
        lines = places[np.stack([starts, model.targets.numpy()[starts, options]], 1)]
        axes.add_collection(LineCollection(list(lines), colors=_PALE, linewidths=0.5, zorder=0))
        jumps, longest = model.is_jump.numpy(), float(model.jump)
    size = 6 if isinstance(model, LandmarkModel) else 90
    axes.scatter(places[~jumps, 0], places[~jumps, 1], s=size, color=_GREY, zorder=1)
    axes.scatter(places[jumps, 0], places[jumps, 1], s=90, color="black", marker="*", zorder=3)
    for task, (way, color) in enumerate(zip(ways, COLORS, strict=False), 1):
        way = way[:, :2]
        broken = np.linalg.norm(np.diff(way, axis=0), axis=1) > longest
        shown = np.insert(way, np.flatnonzero(broken) + 1, np.nan, axis=0)
        axes.plot(*shown.T, color=color, linewidth=1.8, zorder=2)
        axes.annotate(f"{task}", way[0], color=color, fontsize=13, fontweight="bold", zorder=4)
        axes.scatter(way[-1, 0], way[-1, 1], s=40, color=color, marker="s", zorder=4)
    axes.set_aspect("equal")
    axes.set_xlabel("x")
    axes.set_ylabel("y")
    axes.set_title("Number: where a task begins; square: where its episode ended", fontsize=10)
    save_figure(figure, path)


def legend_below(figure: Figure, legend: Legend, *, ncols: int) -> None:
    """Move a panel's legend below the figure, as the legend of all panels."""
    handles: Any = legend.legend_handles  # typed as if one could be None
    names = [text.get_text() for text in legend.get_texts()]
    legend.remove()
    figure.legend(
        handles, names, loc="outside lower center", ncols=ncols, fontsize=9, frameon=False
    )


def _colors(options: Sequence[int]) -> np.ndarray:
    """The colours of options, 0 to 255, ``[P, 3]``; they repeat after eight."""
    found = [OPTION_COLORS[int(option) % len(OPTION_COLORS)] for option in options]
    return np.array(found, dtype=float).reshape(-1, 3)
