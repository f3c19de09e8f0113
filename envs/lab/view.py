"""Pictures of DeepMind Lab's mazes from above."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from torchrl_hmcts.envs.lab.kernels import CELL
from torchrl_hmcts.envs.lab.layout import LabLayout
from torchrl_hmcts.envs.mazes.rendering import PLAYER_COLOR, draw_maze


def draw_lab_maze(
    layout: LabLayout,
    maze: int,
    position: np.ndarray,
    heading: float,
    apples: int,
    **options: Any,
) -> np.ndarray:
    """Draw a maze from above: player (blue, with its heading), goal (green), apples (red).

    Args:
        layout: the mazes.
        maze: which one.
        position: ``[2]`` of the player, world units.
        heading: degrees, 0 east and 90 north.
        apples: a bit for each that is left.
        **options: keywords of :func:`~torchrl_hmcts.envs.draw_maze`; ``paths`` in cells, x to the
            east and y to the south.

    Returns:
        uint8 array ``[h, w, 3]``.

    Example:
        >>> layout = LabLayout([["*****", "*P G*", "*****"]])
        >>> draw_lab_maze(layout, 0, layout.spawn[0, 0], 90.0, 0).shape
        (112, 176, 3)
    """

    def to_picture(points: np.ndarray) -> np.ndarray:
        x, y = (points.astype(np.float64) / CELL).T
        return np.stack((x, layout.rows - y), -1)

    player = to_picture(position)
    angle = math.radians(heading)
    nose = np.stack((player, player + 0.38 * np.array((math.cos(angle), -math.sin(angle)))))
    left = [k for k in range(int(layout.num_apples[maze])) if apples >> k & 1]
    return draw_maze(
        layout.walls[maze],
        player=player.tolist(),
        player_radius=0.15,
        target=to_picture(layout.goal[maze]).tolist() if layout.goal[maze, 0] >= 0 else None,
        **{
            "dots": to_picture(layout.apples[maze, left]),
            **options,
            "paths": [*options.get("paths", ()), (nose, PLAYER_COLOR)],
        },
    )


def heading_degrees(turned: np.ndarray, spawn_heading: np.ndarray) -> np.ndarray:
    """Return the heading as the engine reports it, from -180 to 180 in 65,536 steps.

    Args:
        turned: float32, degrees of yaw since the spawn.
        spawn_heading: int64, 65,536 to a full turn.

    Example:
        >>> heading_degrees(np.float32([90.0]), np.array([16384])).tolist()
        [-180.0]
    """
    units = np.floor(turned * np.float32(65536.0 / 360.0) + np.float32(0.5)).astype(np.int64)
    units = (units + spawn_heading + 32768) % 65536 - 32768
    return units * (360.0 / 65536.0)
