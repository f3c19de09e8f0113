"""Colours of options, curves and marks stay apart for people who see red, green or blue less.

Distances are those of CIELAB (1976): 2 is about the least that people notice side by side. Colour
blindness is simulated in linear RGB (Machado, Oliveira and Fernandes, 2009, severity 1).
"""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from torchrl_hmcts.envs.lab import first_person
from torchrl_hmcts.envs.mazes import rendering
from torchrl_hmcts.planners.drawing import OPTION_COLORS
from torchrl_hmcts.trainers.figures.pictures import COLORS

VISION = {
    "normal": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
WHITE = np.array([0.95047, 1.0, 1.08883])


def from_hex(text: str) -> tuple[int, int, int]:
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)


ROOT = Path(__file__).parents[1]
SETS = {  # what one picture tells apart, and how far apart it is at least
    "options": (OPTION_COLORS, 30),
    "curves": ([from_hex(color) for color in COLORS], 30),
    "mazes": (
        [
            *(rendering.TARGET_COLOR, rendering.PLAYER_COLOR, rendering.DOT_COLOR),
            *(rendering.WALL_COLOR, rendering.FREE_COLOR),
        ],
        25,
    ),
    "the player's view": (
        [getattr(first_person, f"_{name}") for name in ("APPLE", "GOAL", "WALL", "FLOOR", "SKY")],
        25,
    ),
}
HEX = re.compile(r'"(#[0-9a-f]{6})"')
DRAWN_IN = ("trainers", "torchrl_hmcts", "envs", "benchmarks", "docs/tutorials", "docs/_extensions")


def seen(color: tuple[int, int, int], vision: str) -> np.ndarray:
    """CIELAB of a colour 0 to 255, as somebody sees it."""
    part = np.array(color) / 255
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(np.array(VISION[vision]) @ linear, 0, 1) / WHITE
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def closest(colors: list[tuple[int, int, int]], vision: str) -> float:
    places = [seen(color, vision) for color in colors]
    return min(float(np.linalg.norm(a - b)) for a, b in combinations(places, 2))


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("name", SETS)
def test_no_two_categories_are_closer_than_a_stated_distance(name: str, vision: str) -> None:
    colors, least = SETS[name]
    assert closest(list(colors), vision) >= least


@pytest.mark.parametrize("vision", VISION)
def test_no_file_that_draws_names_two_colors_that_are_close(vision: str) -> None:
    for folder in DRAWN_IN:
        for path in (ROOT / folder).rglob("*.py"):
            colors = {from_hex(color) for color in HEX.findall(path.read_text(encoding="utf-8"))}
            assert len(colors) < 2 or closest(list(colors), vision) >= 25, path


def test_the_simulation_finds_red_and_green_to_be_one_colour() -> None:
    red_and_green = [(200, 80, 60), (140, 120, 40)]
    assert closest(red_and_green, "normal") > 40
    assert closest(red_and_green, "deuteranopia") < 15


def test_white_and_black_are_as_far_apart_as_can_be() -> None:
    assert closest([(0, 0, 0), (255, 255, 255)], "normal") == pytest.approx(100, abs=0.1)
