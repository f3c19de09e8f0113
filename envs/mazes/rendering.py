"""Pictures of mazes as numpy arrays: walls, player, target, plans and goals.

Letters: H rows and W columns of tiles, N points of a line, K dots, h x w pixels. All shapes are
drawn from their exact distance to each pixel centre, so that edges are smooth at any size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

Color = tuple[int, int, int]

WALL_COLOR: Color = (24, 24, 27)
FREE_COLOR: Color = (255, 255, 255)
PLAYER_COLOR: Color = (37, 99, 235)
TARGET_COLOR: Color = (22, 163, 74)
DOT_COLOR: Color = (213, 17, 120)

_BORDER_TILES = 0.25  # 9x9 tiles of 32 pixels become 304 x 304, a size video encoders accept
_LINE_RADIUS = 0.06
_DOT_RADIUS = 0.11


def draw_maze(
    walls: Any,
    *,
    player: Sequence[float] | None = None,
    player_radius: float = 0.25,
    target: Sequence[float] | None = None,
    target_radius: float = 0.25,
    paths: Sequence[tuple[Any, Any]] = (),
    dots: Any = (),
    tile_pixels: int = 32,
) -> np.ndarray:
    """Draw a maze: black walls and border on white, green target, blue player.

    The point (x, y) in tiles is drawn at pixel ``(border + x * tile_pixels, border + y *
    tile_pixels)`` with ``border = round(tile_pixels / 4)``. Paths lie below the target, the
    player and the dots.

    Args:
        walls (array or Tensor): bool ``[H, W]``, True = wall.
        player (sequence of float, optional): centre (x, y) of the player, in tiles.
        player_radius (float): in tiles. Default 0.25.
        target (sequence of float, optional): centre (x, y) of the target, in tiles.
        target_radius (float): in tiles. Default 0.25.
        paths (sequence): pairs (points, colour) with points ``[N, 2]`` (x, y) in tiles, drawn as a
            line; the colour is one RGB triple of 0 to 255, or ``[N - 1, 3]``, one per segment.
        dots (array or Tensor): ``[K, 2]`` centres of small magenta dots, e.g. the goals of a plan.
        tile_pixels (int): pixels per tile, at least 4. Default 32.

    Returns:
        uint8 array ``[h, w, 3]``, h = H * tile_pixels + 2 * border, RGB.

    Raises:
        ValueError: if ``walls`` has not two dimensions, ``tile_pixels`` is below 4 or a path has
            neither one colour nor one per segment.

    Reference:
        Dissertation, figures 3.1, 3.2 (maze, player, target) and 3.5 (goals, red there).

    Example:
        >>> walls = np.array([[False, True], [False, False]])
        >>> image = draw_maze(walls, player=(0.5, 0.5), target=(1.5, 1.5), tile_pixels=16)
        >>> image.shape, image[12, 12].tolist(), image[12, 28].tolist()
        ((40, 40, 3), [37, 99, 235], [24, 24, 27])
    """
    grid = np.asarray(walls, dtype=bool)
    if grid.ndim != 2:
        raise ValueError(
            f"draw_maze draws one maze [height, width], got shape {list(grid.shape)}. Index the "
            f"maze first, e.g. mazes[0]."
        )
    if tile_pixels < 4:
        raise ValueError(f"tile_pixels must be at least 4 to show a dot, got {tile_pixels}.")
    border = round(tile_pixels * _BORDER_TILES)
    solid = grid.repeat(tile_pixels, axis=0).repeat(tile_pixels, axis=1)
    solid = np.pad(solid, border, constant_values=True)
    image = np.where(solid[..., None], WALL_COLOR, FREE_COLOR).astype(np.float32)

    def to_pixels(points: Any) -> np.ndarray:
        return np.asarray(points, dtype=np.float64).reshape(-1, 2) * tile_pixels + border

    for points, color in paths:
        pixels = to_pixels(points)
        num_segments = max(len(pixels) - 1, 0)
        colors = np.asarray(color, dtype=np.float32)
        if colors.shape not in ((3,), (num_segments, 3)):
            raise ValueError(
                f"A path of {len(pixels)} points needs one RGB colour or one per segment, shape "
                f"[3] or [{num_segments}, 3]; got {list(colors.shape)}."
            )
        colors = np.broadcast_to(colors, (num_segments, 3))
        for start, end, rgb in zip(pixels[:-1], pixels[1:], colors, strict=True):
            _paint_capsule(image, start, end, _LINE_RADIUS * tile_pixels, rgb)
    for center, radius, rgb in (
        (target, target_radius, TARGET_COLOR),
        (player, player_radius, PLAYER_COLOR),
    ):
        if center is not None:
            pixel = to_pixels(center)[0]
            _paint_capsule(image, pixel, pixel, radius * tile_pixels, rgb)
    for pixel in to_pixels(dots):
        _paint_capsule(image, pixel, pixel, _DOT_RADIUS * tile_pixels, DOT_COLOR)
    return image.round().astype(np.uint8)


def draw_walls(
    axes: Any, walls: Any, *, north_up: bool = False, grid: bool = False, scale: float = 1.0
) -> None:
    """Draw walls as black squares in axes of matplotlib; a tile is ``scale`` long."""
    walls = np.asarray(walls)
    height, width = scale * walls.shape[0], scale * walls.shape[1]
    axes.imshow(
        np.where(walls, 0.12, 1.0),
        cmap="gray",
        vmin=0,
        vmax=1,
        extent=(0, width, 0, height) if north_up else (0, width, height, 0),
        interpolation="nearest",
    )
    axes.set_xticks(range(walls.shape[1] + 1) if grid else [], labels=[])
    axes.set_yticks(range(walls.shape[0] + 1) if grid else [], labels=[])
    axes.tick_params(length=0)
    if grid:
        axes.grid(color="0.8", linewidth=0.8)
        axes.set_axisbelow(False)
    for spine in axes.spines.values():
        spine.set_linewidth(2.5)


def draw_goal(axes: Any, goal: Any) -> None:
    """Draw the place to reach in axes of matplotlib."""
    axes.plot(*goal, "o", color=tuple(c / 255 for c in TARGET_COLOR), markersize=11)


def _paint_capsule(
    image: np.ndarray, start: np.ndarray, end: np.ndarray, radius: float, rgb: Any
) -> None:
    """Blend a line with round ends (a disc when start equals end) into the image, in place."""
    low = np.floor(np.minimum(start, end) - radius - 1).astype(int).clip(0)
    high = np.ceil(np.maximum(start, end) + radius + 1).astype(int).clip(0)
    xs = np.arange(low[0], min(high[0], image.shape[1])) + 0.5 - start[0]
    ys = np.arange(low[1], min(high[1], image.shape[0]))[:, None] + 0.5 - start[1]
    delta = end - start
    along = ((xs * delta[0] + ys * delta[1]) / max(delta @ delta, 1e-12)).clip(0, 1)
    distance = np.hypot(xs - along * delta[0], ys - along * delta[1])
    cover = (radius + 0.5 - distance).clip(0, 1)[..., None].astype(np.float32)
    patch = image[low[1] : high[1], low[0] : high[0]]
    patch += cover * (np.asarray(rgb, np.float32) - patch)
