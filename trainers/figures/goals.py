"""Pictures of the goal-based agent: its two environments, its plans, and its episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from tensordict import TensorDictBase

from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.envs.mazes.rendering import PLAYER_COLOR, TARGET_COLOR, draw_walls
from torchrl_hmcts.planners import Search
from torchrl_hmcts.planners.drawing import option_color
from torchrl_hmcts.trainers.figures.animation import STEPS_PER_FRAME, steps_to_show, write_gif
from torchrl_hmcts.trainers.figures.maps import legend_below
from torchrl_hmcts.trainers.figures.pictures import save_figure

_TRAIL_COLOR = (147, 178, 245)  # the player's blue, pale
_PLAYER, _TARGET = (np.array(color) / 255 for color in (PLAYER_COLOR, TARGET_COLOR))
_ACTIONS = ("up", "down", "left", "right", "none")


def draw_goals(
    env: WaterworldMazeEnv, start: TensorDictBase, track: Any, step: int, *, tile_pixels: int = 32
) -> np.ndarray:
    """Draw one base step of an episode: goals not yet met as magenta dots, the path so far in blue.

    Args:
        env: draws the maze.
        start: first state of the episode, without batch dimensions.
        track: the episode, as ``play_mazes(..., record=True)`` records it.
        step: base step, 0 to the last of the episode.
        tile_pixels: pixels per tile.

    Returns:
        uint8 array ``[h, w, 3]``.

    Reference:
        Dissertation, figure 3.5.

    Example:
        >>> import numpy as np
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> from torchrl_hmcts.trainers import GoalTrack
        >>> env = WaterworldMazeEnv(seed=0)
        >>> start = env.reset()
        >>> plan = {0: start["target"][None].numpy()}
        >>> track = GoalTrack(start["position"][None].numpy(), plan, np.zeros(1, int), False)
        >>> draw_goals(env, start, track, 0).shape
        (304, 304, 3)
    """
    trail = track.positions[: step + 1]
    state = start.clone().set("position", start["position"].new_tensor(trail[-1]))
    met_all = track.solved and step == len(track.positions) - 1
    goals = () if met_all else track.plan_at(step)[int(track.goal_index[step]) :]
    paths = [(trail, _TRAIL_COLOR)] if step else []
    image: np.ndarray = env.render(state, paths=paths, dots=goals, tile_pixels=tile_pixels)
    return image


def plot_goals(env: WaterworldMazeEnv, start: TensorDictBase, track: Any, path: Path) -> None:
    """Draw an episode at its start, half way and at its end (figure 3.5)."""
    last = len(track.positions) - 1
    captions = {
        0: f"the plan: {len(track.plan_at(0))} goals",
        last // 2: f"base step {last // 2}",
        last: f"base step {last}: {'target reached' if track.solved else 'out of time'}",
    }
    figure = Figure(figsize=(4.0 * len(captions), 4.3), layout="constrained")
    panels = figure.subplots(1, len(captions), squeeze=False)[0]
    for axes, (step, caption) in zip(panels, captions.items(), strict=True):
        _show(axes, draw_goals(env, start, track, step, tile_pixels=48), caption)
    save_figure(figure, path)


def write_goal_gif(env: WaterworldMazeEnv, start: TensorDictBase, track: Any, path: Path) -> None:
    """Write an episode as a GIF at twice its real speed; goals vanish as they are met."""
    steps = steps_to_show(len(track.positions) - 1)
    frames = [draw_goals(env, start, track, step) for step in steps]
    write_gif(frames, path, milliseconds=500.0 * env.TIME_STEP * STEPS_PER_FRAME)


def plot_macro_env(env: WaterworldMazeEnv, state: TensorDictBase, path: Path) -> None:
    """Draw a state of Waterworld, and the Gridworld in which the manager plans from it.

    Reference:
        Dissertation, figures 3.1 and 3.2.
    """
    figure = Figure(figsize=(8.2, 4.3), layout="constrained")
    left, right = figure.subplots(1, 2)
    _show(left, env.render(state, tile_pixels=48), "Waterworld: positions and speeds")
    draw_walls(right, env.mazes[int(state["maze_index"])], grid=True)
    for key, color in (("target", _TARGET), ("position", _PLAYER)):
        right.add_patch(Rectangle(np.floor(state[key].numpy()).tolist(), 1, 1, color=color))
    right.set_title("Gridworld: tiles", fontsize=11, loc="left")
    save_figure(figure, path)


def plot_tile_search(
    env: WaterworldMazeEnv, state: TensorDictBase, search: Search, goals: Any, path: Path
) -> None:
    """Draw the search over tiles from a state: the tree, and the plan's options in the maze.

    Reference:
        Dissertation, figure 3.4.
    """
    figure = Figure(figsize=(12.0, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    search.tree.plot(0, ax=left, option_names=_ACTIONS)
    legend = left.get_legend()
    draw_walls(right, env.mazes[int(state["maze_index"])], grid=True)
    points = np.concatenate(([np.floor(state["position"].numpy()) + 0.5], np.asarray(goals)))
    options = search.tree.options(0, int(search.best_node[0]))
    for here, there, option in zip(points[:-1], points[1:], options, strict=True):
        arrow = {
            "arrowstyle": "-|>,head_width=0.32,head_length=0.5",
            "color": option_color(option),
            "linewidth": 2.6,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        right.annotate("", there, here, arrowprops=arrow)
    right.plot(*points[0], "o", color=_PLAYER, markersize=13, zorder=3)
    right.plot(*points[-1], "o", color=_TARGET, markersize=13, zorder=1)
    right.set_title(f"the plan: {len(goals)} tiles", fontsize=10, loc="left")
    legend_below(figure, legend, ncols=8)
    save_figure(figure, path)


def _show(axes: Axes, image: np.ndarray, caption: str) -> None:
    axes.imshow(image)
    axes.set_axis_off()
    axes.set_title(caption, fontsize=11, loc="left")
