"""Ctrl-C and SIGTERM: training stops where it can continue from, and no write is cut off.

Three contexts work together. :func:`signals_handled` makes both signals raise :class:`Stopped`.
Inside :func:`patient` the first one only asks: the training looks at :func:`stop_asked` after every
batch, saves, and raises. Inside :func:`unbroken` both wait for the end of the context.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_IMPATIENT_SECONDS = 1.0  # a second Ctrl-C within this time is part of the first
_DEAF_SECONDS = 10.0  # after Stopped was raised; then it is raised again, should it have been lost


class Stopped(KeyboardInterrupt):
    """A run was asked to stop, by Ctrl-C or by SIGTERM as batch systems send it."""

    def __init__(self, signum: int = signal.SIGINT) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}")
        self.signum = int(signum)

    @property
    def status(self) -> int:
        """Exit status of a process that ends by it: 130 after Ctrl-C, 143 after SIGTERM."""
        return 128 + self.signum


@dataclass
class _State:
    """What the signals have asked for; one a process."""

    before: dict[int, Any] = field(default_factory=dict)  # handlers to put back
    signum: int = 0  # of the first signal; 0: none came
    asked_at: float = 0.0
    raised_at: float = 0.0  # 0: Stopped was not raised yet
    patient: int = 0
    unbroken: int = 0
    told: bool = False


_state = _State()


def _handle(signum: int, frame: FrameType | None) -> None:
    now = time.monotonic()
    first = not _state.signum
    if first:
        _state.signum, _state.asked_at = signum, now
    if _state.unbroken or (_state.patient and first):
        _say("saving, one moment" if _state.unbroken else "stopping after this step, one moment")
        return
    if _state.raised_at:
        if now - _state.raised_at < _DEAF_SECONDS:
            _say("saving, one moment")
            return
    elif not first and now - _state.asked_at < _IMPATIENT_SECONDS:
        return
    _state.raised_at = now
    raise Stopped(_state.signum)


def _say(words: str) -> None:
    """Say it once; not by ``print``, whose buffer the signal may have interrupted."""
    if not _state.told and sys.__stderr__ is not None:
        _state.told = True
        with contextlib.suppress(OSError, ValueError):
            os.write(sys.__stderr__.fileno(), f"\n{words} ...\n".encode())


@contextlib.contextmanager
def signals_handled() -> Iterator[None]:
    """Make Ctrl-C and SIGTERM raise :class:`Stopped` while in the context; may be nested.

    Handlers that the program set itself stay, and so does a signal that is ignored. That of
    TorchRL waits, which a ``LazyMemmapStorage`` sets to remove its files: it does so at exit, too.
    Without effect in other threads than the main one, where Python calls no handlers.
    """
    if _state.before or threading.current_thread() is not threading.main_thread():
        yield
        return
    for signum in _SIGNALS:
        handler: Any = signal.getsignal(signum)
        default = handler in (signal.SIG_DFL, signal.default_int_handler)
        if default or getattr(handler, "__module__", "").startswith("torchrl."):
            _state.before[signum] = signal.signal(signum, _handle)
    try:
        yield
    finally:
        _put_back()


def _put_back() -> None:
    """Set the handlers that were there before; in a process that was forked meanwhile as well."""
    for signum, handler in _state.before.items():
        signal.signal(signum, handler)
    _state.__init__()  # type: ignore[misc]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_put_back)


def stop_asked() -> bool:
    """Return whether a signal has asked this process to stop."""
    return bool(_state.signum)


def raise_if_asked() -> None:
    """Raise :class:`Stopped` if a signal has asked for it; call it where a run has been saved."""
    if _state.signum:
        _state.raised_at = time.monotonic()
        raise Stopped(_state.signum)


def patient() -> contextlib.AbstractContextManager[None]:
    """Let the first signal only ask, since the code inside looks at :func:`stop_asked`.

    A second one, a second later or more, raises :class:`Stopped` at once.
    """
    return _counted("patient")


def unbroken() -> contextlib.AbstractContextManager[None]:
    """Let signals wait for the end of the context, e.g. of the writing of a checkpoint."""
    return _counted("unbroken")


@contextlib.contextmanager
def _counted(name: str) -> Iterator[None]:
    """Count a context while it is open; at the end of the outermost, raise what has waited."""
    with signals_handled():
        setattr(_state, name, getattr(_state, name) + 1)
        try:
            yield
        finally:
            setattr(_state, name, max(0, getattr(_state, name) - 1))
        if not (_state.raised_at or _state.patient or _state.unbroken):
            raise_if_asked()
