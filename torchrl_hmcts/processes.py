"""Processes that share memory: what they need of the machine, and signs that they are alive."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import multiprocessing
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Hashable, Iterable, Iterator
from multiprocessing.util import Finalize, get_temp_dir
from pathlib import Path
from typing import Any

from torch import Tensor

try:
    import resource
except ImportError:  # not Unix
    resource = None  # type: ignore[assignment]

_SOCKET_BYTES = 107  # of a socket's path, on Linux; 103 on macOS
_SOCKET_NAME = len("/listener-12345678")
_SOCKET_FOLDERS = ("", "/tmp", "/var/tmp", "/dev/shm")
_LONGEST_LOOK_AWAY = 2.0  # seconds
_PR_SET_PDEATHSIG = 1
_TO_START = 16  # files: the ends of pipes of a process that starts, two servers, what it reads


def start_context(method: str) -> Any:
    """Return multiprocessing's context; ``"spawn"`` where ``"forkserver"`` cannot have its socket.

    The forkserver listens on a socket whose path may have 107 bytes. Where ``TMPDIR`` is longer, is
    full or cannot be written, the socket is put into another temporary folder.
    """
    forked = multiprocessing.parent_process() is not None  # and may have its parent's forkserver
    if method == "forkserver" and (forked or not any(map(_fits_a_socket, _SOCKET_FOLDERS))):
        method = "spawn"
    return multiprocessing.get_context(method)


def _fits_a_socket(place: str) -> bool:
    """Try a folder, the standard one if it is ``""``, for multiprocessing's sockets."""
    limit = _SOCKET_BYTES if sys.platform == "linux" else _SOCKET_BYTES - 4
    config: dict[str, Any] = multiprocessing.current_process()._config  # type: ignore[attr-defined]
    try:
        folder = tempfile.mkdtemp(prefix="pymp-", dir=place) if place else get_temp_dir()
        fits = len(os.fsencode(folder)) + _SOCKET_NAME <= limit
        if place and fits:
            config["tempdir"] = folder
            Finalize(None, shutil.rmtree, args=(folder, True), exitpriority=-100)
        elif place:
            os.rmdir(folder)
        return fits
    except OSError:
        return False


def share(tensors: Iterable[Tensor], owner: str) -> None:
    """Move tensors to shared memory, or raise an OSError that says what ``owner`` lacks."""
    tensors = list(tensors)
    size = sum(tensor.numel() * tensor.element_size() for tensor in tensors)
    with system_errors(f"{owner} cannot have {size:,} bytes of shared memory"):
        for tensor in tensors:
            try:
                tensor.share_memory_()
            except RuntimeError as error:  # torch leaves the file that it could not fill
                if found := re.search(r"</(torch_\w+)>", str(error)):
                    Path("/dev/shm", found[1]).unlink(missing_ok=True)
                raise


@contextlib.contextmanager
def system_errors(what: str) -> Iterator[None]:
    """Raise what the system refuses as an OSError: ``what`` is not possible, why, and the fix."""
    try:
        yield
    except (OSError, EOFError, RuntimeError) as error:
        number = _number_of(error)
        disk = number == errno.ENOSPC and getattr(error, "filename", None) is not None
        if number is None or disk:  # the disk of a file that the error names
            raise
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise OSError(
            number, f"{what}: {why or type(error).__name__}. {_advice(number)}"
        ) from error


def need_descriptors(processes: int, pipes: int) -> None:
    """Raise an OSError at once if this process may not open the files that others take to start.

    Multiprocessing keeps two ends of pipes for each process that it has started; ``pipes`` are
    those that this process keeps besides.
    """
    try:
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        left = limit - len(os.listdir("/proc/self/fd"))
    except (AttributeError, OSError):  # not Linux
        return
    number = 2 * processes + pipes + _TO_START
    if left < number:
        raise OSError(errno.EMFILE, f"it needs {number} more files, and {left} are left")


def _number_of(error: Exception) -> int | None:
    """Return the system's number of an error, or None if the error is not the system's."""
    if isinstance(error, OSError):
        return error.errno
    if isinstance(error, EOFError):  # the process that starts the others has ended
        return errno.ECHILD
    found = re.search(r"\((\d+)\)\W*$", str(error))  # torch spells it so: "... (28)"
    return int(found[1]) if found and "memory" in str(error) else None


def _limit(name: str) -> str:
    """Return a soft limit of this process, in words."""
    with contextlib.suppress(AttributeError):
        soft = resource.getrlimit(getattr(resource, name))[0]
        return "any number of" if soft == resource.RLIM_INFINITY else str(soft)
    return "a limited number of"


def _advice(number: int) -> str:
    if number in (errno.ENOSPC, errno.ENOMEM):
        text = "Make room in it"
        with contextlib.suppress(OSError):
            disk = shutil.disk_usage("/dev/shm")
            text = f"/dev/shm has {disk.total:,} bytes, {disk.free:,} of them free: make room"
        return f"{text}, or start the container with more, e.g. `docker run --shm-size=1g`."
    if number in (errno.EMFILE, errno.ENFILE):
        return (
            f"This process may open {_limit('RLIMIT_NOFILE')} files (`ulimit -n`): raise that, "
            "e.g. `ulimit -n 4096`, or use fewer processes."
        )
    if number in (errno.EAGAIN, errno.ECHILD):
        ended = "The process that starts the others has ended, with the error printed above. "
        return (
            f"{ended if number == errno.ECHILD else ''}This user may have "
            f"{_limit('RLIMIT_NPROC')} processes and threads (`ulimit -u`): raise that, give the "
            "container more memory, or use fewer processes."
        )
    folder = os.environ.get("TMPDIR") or tempfile.tempdir or "not set"
    return (
        f"Look at the temporary folder (TMPDIR: {folder}), the memory and the limits "
        "(`ulimit -a`), or choose another start_method."
    )


class Silence:
    """Measures for how long nothing has moved, as far as this process was awake to see it.

    A look long after the one before counts two seconds: this process was stopped too, or the
    machine slept.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        """Seconds in which the marks were the same."""
        self._marks: Hashable = None
        self._at = time.monotonic()

    def look(self, marks: Hashable) -> float:
        """Return the seconds for which the marks, e.g. a count, have been the same."""
        now = time.monotonic()
        same = marks == self._marks
        passed = min(now - self._at, _LONGEST_LOOK_AWAY)
        self.seconds = self.seconds + passed if same else 0.0
        self._marks, self._at = marks, now
        return self.seconds


def cpu_ticks(pid: int) -> int:
    """Return the processor time that a process has used, in ticks; 0 where it cannot be known."""
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            numbers = file.read().rpartition(b")")[2].split()
        return int(numbers[11]) + int(numbers[12])
    except (OSError, IndexError):  # gone, or not Linux
        return 0


def wake_with_parent() -> None:
    """Have a stopped process woken when its parent dies, so that it notices and ends; on Linux."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT)
