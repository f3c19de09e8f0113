"""GIFs and videos of episodes."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchrl_hmcts.trainers.saving.files import left_out, replacing

STEPS_PER_FRAME = 2  # base steps from one picture of an episode to the next
_VIDEO_SECONDS = 300  # after which ffmpeg is given up


def steps_to_show(last: int) -> list[int]:
    """Return the base steps of an episode of which there is a picture."""
    return [*range(0, last, STEPS_PER_FRAME), last]


def write_gif(
    frames: Sequence[np.ndarray],
    path: str | Path,
    *,
    milliseconds: float,
    last: float | None = 1500.0,
) -> None:
    """Write pictures as an endless GIF, and as a video beside it (``.mp4``, H.264).

    A video that cannot be written, e.g. without ffmpeg, is left out; a line on stderr says so.
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
    try:
        import imageio.v3 as iio  # here, so that a run without it loses no more than the picture
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "Films need imageio, which is not installed: pip install 'torchrl_hmcts[train]'.",
            name="imageio",
        ) from error

    with replacing(path) as temporary:  # written here: after an error imageio would try again
        content = iio.imwrite("<bytes>", np.stack(kept), extension=".gif", duration=shown, loop=0)
        temporary.write_bytes(content)
    still = 0 if last is None else round(last / milliseconds) - 1
    video = Path(path).with_suffix(".mp4")
    video.unlink(missing_ok=True)  # of an older episode
    with left_out(video.name), replacing(video) as temporary:
        _write_video([*frames, *[frames[-1]] * still], temporary, milliseconds)


def _write_video(frames: Sequence[np.ndarray], path: Path, milliseconds: float) -> None:
    """Write a video with ffmpeg itself: imageio overlooks that it failed, and waits without end."""
    import imageio_ffmpeg

    height, width = frames[0].shape[:2]
    even = ((0, height % 2), (0, width % 2), (0, 0))  # H.264 shares the colours of two pixels
    size = f"{width + width % 2}x{height + height % 2}"
    pictures = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{1000.0 / milliseconds}"]
    h264 = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "25", "-v", "error"]
    done = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-y", *pictures, "-i", "-", "-an", *h264, str(path)],
        input=b"".join(np.pad(frame, even, mode="edge").tobytes() for frame in frames),
        capture_output=True,
        timeout=_VIDEO_SECONDS,
    )
    if done.returncode:
        words = done.stderr.decode(errors="replace").split()
        raise RuntimeError(f"ffmpeg ended with {done.returncode}: {' '.join(words)}")
