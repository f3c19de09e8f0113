"""Pictures of a run, each drawn on its own: one that fails is left out, and the run continues.

Pages and pictures replace older versions of their own, never a file of somebody else's.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_hmcts.trainers.saving.files import left_out, replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#7f10fd", "#ff8400", "#41687a", "#bf0d00", "#1caeff", "#6f031c", "#c49474")
"""Of curves and groups of runs, in their order; apart for the colour-blind (test_palette.py)."""
STAMP = {"Source": "torchrl_hmcts"}
"""Metadata of our PNGs, by which :func:`refuse_foreign` knows them."""
PAGE_MARK = '<meta name="generator" content="torchrl_hmcts">'
_MARKS = (
    b"Source\0torchrl_hmcts",
    PAGE_MARK.encode(),
    b'<link rel="icon" href="data:,">',  # of pages before that mark
)


class Pictures:
    """The pictures of a run's page."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.captions: dict[str, str] = {}

    @contextlib.contextmanager
    def one(self, name: str, caption: str) -> Iterator[Path]:
        """Hand out the path of a picture; after an error in the block it is not on the page.

        Import what draws it in the block: a library that does not load costs the picture too.
        """
        with left_out(name):
            yield self.folder / name
            self.captions[name] = caption


def save_figure(figure: Figure, path: str | Path, *, dpi: int = 110) -> None:
    """Write a figure of matplotlib as PNG in one move."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi, metadata=STAMP)


def refuse_foreign(file: str | Path) -> None:
    """Refuse to replace a file that this package did not write."""
    file = Path(file)
    if file.is_dir():
        raise ValueError(f"{file} is a folder. Name a file with out=.")
    content = file.read_bytes() if file.exists() else b""
    if content and not any(mark in content for mark in _MARKS):
        raise ValueError(
            f"{file} exists and was not written by hmcts report, so it is not replaced. Move it, "
            "or choose another place with out=."
        )
