"""A folder that one process at a time writes to."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # no POSIX system
    fcntl = None  # type: ignore[assignment]

LOCK_NAME = ".lock"
_held: set[int] = set()  # open files of locks that this process holds


class FolderInUse(RuntimeError):
    """Another run writes to a folder.

    Args:
        folder: that is in use.
        holder: what its lock says about the other process.

    Example:
        >>> print(str(FolderInUse("runs/one", "process 7")).partition(". ")[0])
        runs/one is in use: process 7 writes to it
    """

    def __init__(self, folder: str | Path, holder: str) -> None:
        super().__init__(
            f"{folder} is in use: {holder} writes to it. Wait for its end, stop it, or choose "
            "another folder."
        )
        self.folder = Path(folder)


@contextlib.contextmanager
def folder_locked(
    folder: str | Path, *, name: str = LOCK_NAME, wait: bool = False
) -> Iterator[None]:
    """Keep other processes, and other threads of this one, from writing to a folder.

    The lock is the operating system's (``flock``): it vanishes with the process, however that ends,
    and children do not inherit it. Where a file system has no such locks, a line on stderr says so.
    """
    path = Path(folder, name)
    handle = _take(path, wait)
    try:
        yield
    finally:
        if handle is not None:
            _held.discard(handle)
            with contextlib.suppress(OSError):
                path.unlink()  # while it is ours
            with contextlib.suppress(OSError):  # closed by a fork
                os.close(handle)


def is_locked(folder: str | Path) -> bool:
    """Return whether a process holds the lock of a folder, which may not exist."""
    if fcntl is None or not Path(folder, LOCK_NAME).exists():
        return False
    try:
        with folder_locked(folder):
            return False
    except FolderInUse:
        return True
    except OSError:
        return False


def _take(path: Path, wait: bool) -> int | None:
    """The open file of the lock; None where there are no locks."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if fcntl is None:
                raise OSError("this system has no flock")
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            holder = os.read(handle, 200).decode(errors="replace").strip() or "another process"
            os.close(handle)
            raise FolderInUse(path.parent, holder) from None
        except OSError as error:
            os.close(handle)
            words = "see to it yourself that no other run writes to it"
            print(f"{path.parent} cannot be locked ({error}): {words}.", file=sys.stderr)
            return None
        with contextlib.suppress(OSError):  # whoever held it may have removed the file meanwhile
            if os.fstat(handle).st_ino == os.stat(path).st_ino:
                os.truncate(handle, 0)
                since = time.strftime("%Y-%m-%d %H:%M:%S")
                os.write(handle, f"process {os.getpid()}, since {since},".encode())
                _held.add(handle)
                return handle
        os.close(handle)


def _forget() -> None:
    """In a forked child: the lock is the parent's alone."""
    for handle in _held:
        with contextlib.suppress(OSError):
            os.close(handle)
    _held.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
