"""Files that are written in one move, and files that a run can do without."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import math
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

_CHECKSUM = "checksum"


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Hand out a path to write to; the file there takes its place in one move at the end."""
    path = Path(path)
    remove_leftovers(path.parent, path.name)
    temporary = path.with_name(f".writing-{os.getpid()}.{path.name}")
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
        _sync(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            remove(temporary)
        raise


def write_text(path: str | Path, text: str) -> None:
    """Write a text as UTF-8 in one move; raises ``OSError`` if it cannot."""
    with replacing(path) as temporary:
        # A name from a locale without UTF-8 holds bytes as surrogates: they become bytes again.
        temporary.write_bytes(text.encode("utf-8", "surrogateescape"))


def write_json(path: str | Path, content: Any, *, checksum: bool = False) -> None:
    """Write numbers and texts as JSON in one move; a number that is not finite becomes null."""
    content = finite(content)
    if checksum:
        content = {**content, _CHECKSUM: digest(content)}
    write_text(path, json.dumps(content, indent=2) + "\n")


def read_json(path: str | Path) -> dict[str, Any]:
    """Return the content of a JSON file that holds a dict, once its checksum is compared."""
    try:
        content = json.loads(Path(path).read_bytes().decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read: {error}.") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} cannot be read: it holds no JSON object.")
    if _CHECKSUM in content and content.pop(_CHECKSUM) != digest(content):
        raise ValueError(f"{path} cannot be read: it differs from its checksum.")
    return content


def digest(content: Any) -> str:
    """Return the SHA-256 of numbers and texts as they come back from JSON, in any layout."""
    plain = json.loads(json.dumps(content))
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def write_csv(path: str | Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table as CSV in one move: names of the columns, and rows of values."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    write_text(path, text.getvalue())


@contextlib.contextmanager
def left_out(name: str) -> Iterator[list[str]]:
    """Continue after an error in the block, without the file it was to write; a line says so.

    The list that is yielded has the name then.
    """
    missing: list[str] = []
    try:
        yield missing
    except Exception as error:
        missing.append(name)
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        with contextlib.suppress(OSError):  # of a stderr on the same full disk
            print(f"Left out {name}: {reason}", file=sys.stderr, flush=True)


def remove(path: Path) -> None:
    """Remove a file or a folder, if it is there; of a link, the link and not its target."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def remove_leftovers(folder: Path, name: str = "") -> None:
    """Remove what processes that were killed while writing have left."""
    for path in folder.glob(".*writing-*"):
        process = int((re.findall(r"writing-(\d+)", path.name) or [0])[-1])
        if name in path.name and (process == os.getpid() or not _is_running(process)):
            with contextlib.suppress(OSError):
                remove(path)


def finite(content: Any) -> Any:
    """Return content with None in place of a number that is not finite: JSON has no other."""
    if isinstance(content, Mapping):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    if hasattr(content, "tolist"):  # of NumPy and torch
        return finite(content.tolist())
    return None if isinstance(content, float) and not math.isfinite(content) else content


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return process > 0
