"""GIFs as they are written."""

from __future__ import annotations

import subprocess
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
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
    greys: list[int], last: float | None, shown: list[float], tmp_path
) -> None:
    write_gif([picture(g) for g in greys], tmp_path / "a.gif", milliseconds=40.0, last=last)
    assert durations(tmp_path / "a.gif") == shown


@pytest.mark.parametrize("number", [1, 3])
def test_an_episode_in_which_nothing_happens_is_one_picture(number: int, tmp_path) -> None:
    write_gif([picture(90)] * number, tmp_path / "a.gif", milliseconds=40.0)
    assert iio.imread(tmp_path / "a.gif").shape[-3:] == (8, 12, 3)


@pytest.mark.parametrize(("height", "width"), [(16, 24), (15, 23)])
def test_a_video_of_the_same_length_lies_beside_the_gif(height: int, width: int, tmp_path) -> None:
    greys = [0, 90, 90, 200]
    frames = [np.full((height, width, 3), grey, np.uint8) for grey in greys]
    write_gif(frames, tmp_path / "a.gif", milliseconds=40.0, last=120.0)
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / "a.mp4")]
    read = subprocess.run(
        [*program, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    shown = np.frombuffer(read.stdout, np.uint8).reshape(-1, 16, 24, 3)
    assert len(shown) == 6  # the last picture three times
    means = shown.reshape(6, -1).mean(-1)
    assert np.abs(means - np.array([*greys, 200, 200])).max() < 6
    assert b"25 fps" in read.stderr
