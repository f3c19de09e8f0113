"""draw_maze: pixels by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_hmcts.envs import draw_maze, maze_from_text
from torchrl_hmcts.envs.mazes.rendering import (
    DOT_COLOR,
    FREE_COLOR,
    PLAYER_COLOR,
    TARGET_COLOR,
    WALL_COLOR,
)

WALLS, _, _ = maze_from_text("..#\n...")  # 3 wide, 2 high
TILE, BORDER = 32, 8


def pixel(image, x, y):
    """The colour at (x, y) in tiles."""
    return tuple(image[int(BORDER + y * TILE), int(BORDER + x * TILE)].tolist())


def test_walls_and_border_are_dark_and_free_tiles_white():
    image = draw_maze(WALLS, tile_pixels=TILE)
    assert image.dtype == np.uint8
    assert image.shape == (2 * TILE + 2 * BORDER, 3 * TILE + 2 * BORDER, 3)
    dark = (image == WALL_COLOR).all(-1)
    assert dark.sum() == image[..., 0].size - 5 * TILE**2
    assert dark[BORDER : BORDER + TILE, BORDER + 2 * TILE :].all()
    assert (image[~dark] == FREE_COLOR).all()


def test_player_target_and_dots_are_drawn_where_they_are():
    image = draw_maze(
        WALLS, player=(0.5, 0.5), target=(1.5, 1.5), dots=[(0.5, 1.5)], tile_pixels=TILE
    )
    assert pixel(image, 0.5, 0.5) == PLAYER_COLOR
    assert pixel(image, 1.5, 1.5) == TARGET_COLOR
    assert pixel(image, 0.5, 1.5) == DOT_COLOR
    assert pixel(image, 0.5, 0.9) == FREE_COLOR


def test_disc_area_is_right_and_its_edge_smooth():
    image = draw_maze(np.zeros((3, 3)), player=(1.5, 1.5), player_radius=0.5, tile_pixels=40)
    white = np.array(FREE_COLOR, float)
    inner = image[10:-10, 10:-10].astype(float)
    cover = ((white - inner) @ (white - PLAYER_COLOR)) / np.square(white - PLAYER_COLOR).sum()
    assert cover.sum() == pytest.approx(np.pi * 20**2, rel=0.01)
    assert ((cover > 0.05) & (cover < 0.95)).sum() > 50


def test_path_segments_have_their_own_colours():
    points = torch.tensor([[0.5, 0.5], [1.5, 0.5], [1.5, 1.5]])
    colors = [(200, 0, 0), (0, 0, 200)]
    image = draw_maze(WALLS, paths=[(points, colors)], tile_pixels=TILE)
    assert pixel(image, 1.0, 0.5) == (200, 0, 0)
    assert pixel(image, 1.5, 1.0) == (0, 0, 200)
    one = draw_maze(WALLS, paths=[(points, (1, 2, 3))], tile_pixels=TILE)
    assert pixel(one, 1.0, 0.5) == pixel(one, 1.5, 1.0) == (1, 2, 3)


@pytest.mark.parametrize("points", [[], [(0.5, 0.5)], [(0.5, 0.5), (0.5, 0.5)]])
def test_a_path_without_extent_is_no_error(points):
    draw_maze(WALLS, paths=[(points, (1, 2, 3))])


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"walls": np.zeros((2, 3, 3))}, r"one maze .* got shape \[2, 3, 3\]"),
        ({"walls": WALLS, "tile_pixels": 3}, "tile_pixels must be at least 4.*got 3"),
        (
            {"walls": WALLS, "paths": [([(0, 0), (1, 1)], [(1, 2, 3), (1, 2, 3)])]},
            r"2 points needs .*\[1, 3\]; got \[2, 3\]",
        ),
    ],
)
def test_bad_arguments_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        draw_maze(**kwargs)
