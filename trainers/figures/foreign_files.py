"""Pages and figures replace their own older versions only, never a file of somebody else's."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

_STAMP = b"Source\0torchrl_hmcts"
_PAGE_MARKS = (
    b'<meta name="generator" content="torchrl_hmcts">',
    b'<link rel="icon" href="data:,">',  # of pages before that mark
)


def refuse_foreign(file: str | Path) -> None:
    """Refuse to replace a file that this package did not write.

    Args:
        file: that is about to be written; need not exist.

    Raises:
        ValueError: if it is another's, or a folder.

    Example:
        >>> refuse_foreign("nothing_there.html")
    """
    file = Path(file)
    if file.is_dir():
        raise ValueError(f"{file} is a folder. Name a file with out=.")
    if not file.exists():
        return
    content = file.read_bytes()
    marks = (_STAMP,) if file.suffix.lower() == ".png" else _PAGE_MARKS
    if content and not any(mark in content for mark in marks):
        raise ValueError(
            f"{file} exists and was not written by hmcts report, so it is not replaced. Move it, "
            "or choose another place with out=."
        )


def stamp(file: str | Path) -> None:
    """Mark a PNG as written by this package; other files carry their mark already.

    Args:
        file: that was written.
    """
    file = Path(file)
    content = file.read_bytes()
    if file.suffix.lower() != ".png" or _STAMP in content:
        return
    chunk = b"tEXt" + _STAMP
    framed = struct.pack(">I", len(_STAMP)) + chunk + struct.pack(">I", zlib.crc32(chunk))
    end = content.rindex(b"IEND") - 4
    half = file.with_name(f".{file.name}.writing")
    half.write_bytes(content[:end] + framed + content[end:])
    half.replace(file)
