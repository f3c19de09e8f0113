"""Lets wide pictures scroll on a phone, where their letters would be too small to read."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

WIDE = 1.5  # width over height
_PICTURE = re.compile(r'<img [^>]*?src="([^"]+\.png)"[^>]*>')


def wrap(
    app: Sphinx, pagename: str, templatename: str, context: dict[str, Any], doctree: Any
) -> None:
    """Put each wide picture of a page into a box of its own."""
    files = {name: Path(app.srcdir, path) for path, name in app.builder.images.items()}
    folder = Path(app.srcdir, "auto_tutorials", "images")  # of the gallery

    def wrapped(match: re.Match[str]) -> str:
        name = match[1].rsplit("/", 1)[-1]
        file = files.get(name, folder / name)
        if not file.exists():
            return match[0]
        width, height = struct.unpack(">II", file.read_bytes()[16:24])
        wide = width > WIDE * height and "sphx-glr-thumb" not in name
        return f'<span class="wide">{match[0]}</span>' if wide else match[0]

    if "body" in context:
        context["body"] = _PICTURE.sub(wrapped, context["body"])


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("html-page-context", wrap)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
