"""GIFs and videos of episodes."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tensordict import TensorDictBase

from torchrl_hmcts.trainers.figures.plots import option_rgb
from torchrl_hmcts.trainers.saving.files import left_out, replacing

if TYPE_CHECKING:
    from torchrl_hmcts.envs import WaterworldMazeEnv
    from torchrl_hmcts.trainers.experiments.demo import Episode

_VIDEO_SECONDS = 300  # after which ffmpeg is given up


def write_episode_gif(
    env: WaterworldMazeEnv,
    start: TensorDictBase,
    episode: Episode,
    path: Path,
    *,
    steps_per_frame: int = 2,
) -> None:
    """Write an episode as a GIF, the plan drawn in with one colour per option.

    Args:
        env: draws the frames.
        start: first state, without batch dimensions.
        episode: plan and positions.
        path: file to write.
        steps_per_frame: base steps from one frame to the next.
    """
    plan_points = episode.plan.states["position"][: int(episode.plan.lengths) + 1].numpy()
    plan_colors = [
        _pale(option_rgb(int(o))) for o in episode.plan.options[: int(episode.plan.lengths)]
    ]
    plan = [(plan_points, np.array(plan_colors))] if plan_colors else []
    frames = []
    last = len(episode.positions) - 1
    for step in [*range(0, last, steps_per_frame), last]:
        trail = episode.positions[: step + 1]
        colors = np.array([option_rgb(int(o)) for o in episode.options[:step]])
        state = start.clone().set("position", start["position"].new_tensor(trail[-1]))
        paths = [*plan, (trail, colors)] if step else plan
        frames.append(env.render(state, paths=paths))
    rate = 1.0 / (env.TIME_STEP * steps_per_frame)
    write_gif(frames, path, milliseconds=1000.0 / (2.0 * rate))  # twice real time


def write_gif(
    frames: Sequence[np.ndarray],
    path: str | Path,
    *,
    milliseconds: float,
    last: float | None = 1500.0,
) -> None:
    """Write pictures as an endless GIF, and as a video beside it (``.mp4``, H.264).

    A video that cannot be written, e.g. without ffmpeg, is left out; a line on stderr says so.

    Args:
        frames: uint8 ``[height, width, 3]`` each. Where several in a row are the same, one is
            written into the GIF that is shown as long as all of them.
        path: GIF to write; the video has the same name.
        milliseconds: for which a frame is shown.
        last: milliseconds for which the last one is shown. Default: a second and a half; ``None``:
            as long as the others.
    """
    kept, durations = [frames[0]], [0.0]
    for frame in frames:
        if not np.array_equal(frame, kept[-1]):
            kept.append(frame)
            durations.append(0.0)
        durations[-1] += milliseconds
    if last is not None:
        durations[-1] += last - milliseconds
    shown: float | list[float] = durations if len(kept) > 1 else durations[0]
    import imageio.v3 as iio  # here, so that a run without it loses no more than the picture

    with replacing(path) as temporary:  # written here: after an error imageio would try again
        content = iio.imwrite("<bytes>", np.stack(kept), extension=".gif", duration=shown, loop=0)
        temporary.write_bytes(content)
    still = 0 if last is None else round(last / milliseconds) - 1
    video = Path(path).with_suffix(".mp4")
    video.unlink(missing_ok=True)  # of an older episode
    with left_out(video.name), replacing(video) as temporary:
        _write_video([*frames, *[frames[-1]] * still], temporary, milliseconds)


def _write_video(frames: Sequence[np.ndarray], path: Path, milliseconds: float) -> None:
    """Write pictures as a video; ones of odd height or width get a row or column more."""
    import imageio_ffmpeg

    height, width = frames[0].shape[:2]
    room = ((0, height % 2), (0, width % 2), (0, 0))  # H.264 halves the colours' resolution
    shown = [np.pad(frame, room, mode="edge") for frame in frames]
    size = f"{width + width % 2}x{height + height % 2}"
    pictures = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{1000.0 / milliseconds}"]
    h264 = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "25", "-v", "error"]
    done = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-y", *pictures, "-i", "-", "-an", *h264, str(path)],
        input=b"".join(np.ascontiguousarray(frame).tobytes() for frame in shown),
        capture_output=True,
        timeout=_VIDEO_SECONDS,
    )
    if done.returncode:
        words = done.stderr.decode(errors="replace").split()
        raise RuntimeError(f"ffmpeg ended with {done.returncode}: {' '.join(words)}")


def _pale(color: tuple[int, int, int]) -> tuple[int, int, int]:
    red, green, blue = (round(255 - 0.35 * (255 - channel)) for channel in color)
    return red, green, blue
