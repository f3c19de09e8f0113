"""GIFs as they are written."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from torchrl_hmcts.trainers.figures.animation import write_gif


def picture(grey: int) -> np.ndarray:
    return np.full((8, 12, 3), grey, np.uint8)


def durations(path: Path) -> list[float]:
    count = iio.improps(path, plugin="pillow").shape[0]
    return [iio.immeta(path, index=i, plugin="pillow")["duration"] for i in range(count)]


@pytest.mark.parametrize(
    ("greys", "last", "shown"),
    [
        ([0, 90, 200], 1500.0, [40, 40, 1500]),
        ([0, 90, 200], None, [40, 40, 40]),
        ([0, 90, 90, 200], 1500.0, [40, 80, 1500]),
    ],
)
def test_pictures_in_a_row_that_are_the_same_are_shown_longer(
    greys: list[int], last: float | None, shown: list[float], tmp_path: Path
) -> None:
    write_gif([picture(g) for g in greys], tmp_path / "a.gif", milliseconds=40.0, last=last)
    assert durations(tmp_path / "a.gif") == shown


@pytest.mark.parametrize("number", [1, 3])
def test_an_episode_in_which_nothing_happens_is_one_picture(number: int, tmp_path: Path) -> None:
    write_gif([picture(90)] * number, tmp_path / "a.gif", milliseconds=40.0)
    assert iio.imread(tmp_path / "a.gif").shape[-3:] == (8, 12, 3)
