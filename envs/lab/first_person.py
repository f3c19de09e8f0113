"""The view of the player of a lab maze, drawn by casting a ray through every column of the picture.

Letters: R rows and C columns of cells (row 0 is the south), h x w pixels, K things to draw.
"""

# No annotations in compiled functions: numba infers the types of their arguments.

from __future__ import annotations

import math

import numpy as np
from tensordict import TensorDictBase

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.envs.lab.kernels import APPLES, SPAWN_HEADING
from torchrl_hmcts.envs.lab.maze_env import LabMazeEnv
from torchrl_hmcts.envs.lab.states import heading_degrees

_EYE = 0.51  # height of the eye in cells; the ceiling is at 1
_APPLE, _GOAL = (120, 0, 40), (90, 230, 40)
_WALL, _FLOOR, _SKY = (176, 138, 104), (96, 104, 116), (186, 204, 222)
_RADII = (0.12, 0.22)  # of apples and the goal, in cells


def draw_first_person(
    env: LabMazeEnv,
    tensordict: TensorDictBase,
    *,
    width: int = 320,
    height: int = 240,
    field_of_view: float = 90.0,
) -> np.ndarray:
    """Draw what the player sees: brick walls, dark red apples, a light green goal.

    A picture for people, not the engine's: its textures and lights are others. The direction of a
    column :math:`u` of the picture is :math:`d + \\tan(\\text{fov} / 2)\\, u\\, r` with the heading
    :math:`d`, the direction :math:`r` to its right, and :math:`u` from -1 to 1.

    Args:
        env: whose maze it is.
        tensordict: state without batch dimensions.
        width, height: of the picture, in pixels. Default 320 by 240, the engine's.
        field_of_view: degrees from the left to the right edge. Default 90, the engine's.

    Returns:
        uint8 array ``[height, width, 3]``, RGB.

    Raises:
        ValueError: if the tensordict has batch dimensions, or a number is out of range.

    Reference:
        Dissertation, figure 4.3 (a picture of the environment).

    Example:
        >>> env = LabMazeEnv([["*******", "*P   G*", "*******"]])
        >>> picture = draw_first_person(env, env.make_state(0, (150.0, 150.0), heading=0.0))
        >>> red, green, blue = picture[122, 160].tolist()  # the goal, straight ahead
        >>> picture.shape, green > 2 * red
        ((240, 320, 3), True)
    """
    if tensordict.batch_size:
        raise ValueError(
            f"draw_first_person draws one state, got a batch {list(tensordict.batch_size)}. Index "
            f"it, e.g. td[0]."
        )
    if min(width, height) < 8 or not 10.0 <= field_of_view <= 150.0:
        raise ValueError(
            f"draw_first_person needs at least 8 by 8 pixels and a field of view from 10 to 150 "
            f"degrees; got {width} by {height} and {field_of_view}."
        )
    layout, maze = env.layout, int(tensordict["maze_index"])
    level = tensordict["level"].numpy(force=True)
    turned = tensordict["turned"].numpy(force=True)
    (degrees,) = heading_degrees(turned[:1], level[[SPAWN_HEADING]])
    angle = math.radians(float(degrees))
    eye = tensordict["position"].numpy(force=True).astype(np.float64) / env.CELL
    walls = np.pad(layout.walls[maze, ::-1], 1, constant_values=True)
    wide = math.tan(math.radians(field_of_view) / 2.0)
    pitch = math.tan(math.radians(float(turned[1]))) * 0.5 * width / wide
    image = np.empty((height, width, 3), np.float64)
    depth = np.empty(width)
    _cast(image, depth, walls, eye[0], eye[1], angle, wide, pitch)
    left = [k for k in range(int(layout.num_apples[maze])) if int(level[APPLES]) >> k & 1]
    things = [(place, _APPLE, _RADII[0]) for place in layout.apples[maze, left]]
    if layout.goal[maze, 0] >= 0:
        things.append((layout.goal[maze], _GOAL, _RADII[1]))
    things = [(place.astype(np.float64) / env.CELL, *rest) for place, *rest in things]
    for place, color, radius in sorted(things, key=lambda x: -float(np.hypot(*(x[0] - eye)))):
        _ball(image, depth, place - eye, angle, wide, pitch, radius, np.array(color, np.float64))
    out: np.ndarray = image.clip(0, 255).astype(np.uint8)
    return out


@njit()
def _cast(image, depth, walls, x, y, angle, wide, pitch):
    """Draw floor, ceiling and walls; write the distance of each column's wall to ``depth``."""
    height, width, _ = image.shape
    scale = 0.5 * width / wide  # pixels of one cell at a distance of one cell
    horizon = 0.5 * height - pitch
    cosine, sine = math.cos(angle), math.sin(angle)
    for column in range(width):
        u = ((column + 0.5) / width * 2.0 - 1.0) * wide
        dx, dy = cosine + u * sine, sine - u * cosine
        cell_x, cell_y = int(math.floor(x)), int(math.floor(y))
        step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        per_x = abs(1.0 / dx) if dx != 0.0 else 1e30
        per_y = abs(1.0 / dy) if dy != 0.0 else 1e30
        next_x = per_x * (cell_x + 1 - x if dx > 0 else x - cell_x)
        next_y = per_y * (cell_y + 1 - y if dy > 0 else y - cell_y)
        distance, is_x = 0.0, True
        while True:
            is_x = next_x < next_y
            if is_x:
                distance, next_x, cell_x = next_x, next_x + per_x, cell_x + step_x
            else:
                distance, next_y, cell_y = next_y, next_y + per_y, cell_y + step_y
            if walls[cell_y + 1, cell_x + 1]:
                break
        distance = max(distance, 1e-3)
        depth[column] = distance
        along = (y + distance * dy) if is_x else (x + distance * dx)
        for row in range(height):
            v = (horizon - row - 0.5) / scale  # up, at a distance of one
            up = _EYE + distance * v
            if 0.0 <= up < 1.0:
                shade = (0.86 if is_x else 1.0) / (1.0 + 0.05 * distance * distance)
                brick = math.floor(up * 8.0)
                offset = along * 4.0 + 0.5 * (brick % 2)
                tone = 0.92 + 0.08 * math.sin(12.9898 * math.floor(offset) + 78.233 * brick)
                seam = min(up * 8.0 - brick, offset - math.floor(offset) if distance < 4.0 else 1.0)
                if seam < 0.09:
                    tone *= 0.78
                red, green, blue = _WALL
            else:
                flat = (_EYE if v < 0.0 else 1.0 - _EYE) / max(abs(v), 1e-6)
                shade = 1.0 / (1.0 + 0.05 * flat * flat)
                odd = (math.floor(2.0 * (x + flat * dx)) + math.floor(2.0 * (y + flat * dy))) % 2
                tone = 1.0 - 0.10 * odd
                red, green, blue = _FLOOR if v < 0.0 else _SKY
            light = shade * tone
            image[row, column, 0] = red * light
            image[row, column, 1] = green * light
            image[row, column, 2] = blue * light


@njit()
def _ball(image, depth, offset, angle, wide, pitch, radius, color):
    """Draw a ball at half the height of the walls, where no wall is nearer."""
    height, width, _ = image.shape
    scale = 0.5 * width / wide
    ahead = offset[0] * math.cos(angle) + offset[1] * math.sin(angle)
    right = offset[0] * math.sin(angle) - offset[1] * math.cos(angle)
    if ahead < 0.05:
        return
    size = radius * scale / ahead
    middle_x = 0.5 * width + right / ahead * scale
    middle_y = 0.5 * height - pitch + (_EYE - 0.4) / ahead * scale
    for column in range(max(0, int(middle_x - size)), min(width, int(middle_x + size) + 2)):
        if depth[column] < ahead:
            continue
        for row in range(max(0, int(middle_y - size)), min(height, int(middle_y + size) + 2)):
            a, b = (column + 0.5 - middle_x) / size, (row + 0.5 - middle_y) / size
            inside = 1.0 - a * a - b * b
            cover = min(1.0, max(0.0, inside * size * 0.5 + 0.5))
            if cover > 0.0:
                light = 0.45 + 0.55 * max(
                    0.0, math.sqrt(max(0.0, inside)) * 0.8 - 0.5 * b - 0.3 * a
                )
                light /= 1.0 + 0.03 * ahead * ahead
                for channel in range(3):
                    old = image[row, column, channel]
                    image[row, column, channel] = old + cover * (color[channel] * light - old)
