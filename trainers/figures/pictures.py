"""Pictures of a run. Each is drawn on its own: one that fails is left out, and the run goes on."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_hmcts.trainers.saving.files import left_out, replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Pictures:
    """The pictures of a run's page.

    Args:
        folder: of the run.

    Attributes:
        captions: of the pictures that were drawn, by file.

    Example:
        >>> from pathlib import Path
        >>> pictures = Pictures(Path())
        >>> with pictures.one("search.png", "The tree.") as path:
        ...     _ = path.write_bytes(b"...")
        >>> with pictures.one("episode.gif", "An episode.") as path:
        ...     raise ImportError("No module named 'imageio'")  # said on stderr
        >>> pictures.captions
        {'search.png': 'The tree.'}
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.captions: dict[str, str] = {}

    @contextlib.contextmanager
    def one(self, name: str, caption: str) -> Iterator[Path]:
        """Hand out the path of a picture; after an error in the block it is not on the page.

        Import what draws it in the block: a library that does not load costs the picture too.

        Args:
            name: of the file.
            caption: on the page.
        """
        with left_out(name):
            yield self.folder / name
            self.captions[name] = caption


def save_figure(figure: Figure, path: str | Path, *, dpi: int = 110) -> None:
    """Write a figure of matplotlib as PNG in one move.

    Args:
        figure: to write.
        path: file.
        dpi: pixels of an inch.
    """
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
