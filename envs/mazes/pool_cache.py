"""The cache file of the maze pool: found in a user folder, trusted only to the last bit."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path

import numpy as np


def pool_cache_path(sha256: str) -> Path | None:
    """Where the pool with this digest is kept: ``TORCHRL_HMCTS_CACHE`` or the XDG cache folder."""
    name = f"mazes-{sha256[:12]}.npy"
    try:
        folder = os.environ.get("TORCHRL_HMCTS_CACHE")
        if folder:
            return Path(folder).expanduser() / name
        base = os.environ.get("XDG_CACHE_HOME")
        return (Path(base) if base else Path.home() / ".cache") / "torchrl_hmcts" / name
    except RuntimeError:  # no home folder
        return None


def pool_digest(pool: np.ndarray) -> str:
    """SHA-256 of the packed bits of a bool array, in hex."""
    return hashlib.sha256(np.packbits(pool).tobytes()).hexdigest()


def read_pool(path: Path, shape: tuple[int, ...], sha256: str) -> np.ndarray | None:
    """Read a cached pool, bool ``shape``; None if the file is absent or differs from the digest."""
    try:
        array = np.load(path, allow_pickle=False)
        if array.dtype == np.bool_ and array.shape == shape and pool_digest(array) == sha256:
            return array
    except Exception:  # whatever a damaged file makes numpy raise, the pool can be made again
        pass
    return None


def write_pool(path: Path, pool: np.ndarray) -> None:
    """Write the pool in one move, so that no reader meets half a file; failing to write is fine."""
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "wb") as file:
            np.save(file, pool, allow_pickle=False)
        os.replace(temporary, path)
    except OSError:  # read-only or full: the cache is a convenience
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
