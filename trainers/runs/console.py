"""Words of a run while it works: bars on a terminal, a line every ten seconds elsewhere, tables.

Everything fits 80 columns.
"""

from __future__ import annotations

import contextlib
import io
import math
import numbers
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from tqdm import tqdm

from torchrl_hmcts.trainers.saving.run_folder import flat

INTERVAL = 9.0  # seconds between two signs of life; looked at every second
WIDTH = 79
_NAME_WIDTH = 46

_BAR = (
    "{desc}: {percentage:3.0f} %|{bar}| {n_fmt}/{total_fmt}{unit} [{elapsed}<{remaining}{postfix}]"
)
_LINE = "{desc}: {percentage:.0f} % ({n_fmt} of {total_fmt}{unit}) in {elapsed}{postfix}"


class _State:
    """The phase and bar of the run of this process."""

    phase = ""
    begun = spoken = 0.0
    bar: Bar | None = None


class Bar(tqdm):
    """A progress bar; where stderr is no terminal, a line every ten seconds."""

    def __init__(
        self, total: int | None = None, *, desc: str = "", unit: str = "steps", scale: int = 1
    ) -> None:
        self.scale, self.shown = scale, True  # before tqdm shows it for the first time
        self.lines = not sys.stderr.isatty()
        options: dict[str, Any] = {"file": io.StringIO(), "mininterval": 1.0} if self.lines else {}
        if total is not None:
            options["bar_format"] = _LINE if self.lines else _BAR
        super().__init__(
            total=None if total is None else total * scale,
            desc=desc,
            unit=f" {unit}",
            unit_scale=total is not None and total * scale >= 1e6,
            ncols=min(WIDTH, shutil.get_terminal_size((WIDTH + 1, 24)).columns - 1),
            disable=_quiet(),
            **options,
        )
        _State.bar, _State.spoken = self, time.monotonic()

    total: float | None

    def update(self, n: float | None = 1) -> bool | None:
        """Move it on by a number of steps."""
        moved = (1 if n is None else n) * self.scale
        if self.total is not None and self.n + moved > self.total:  # the last batch is whole
            self.total = self.n + moved
        return super().update(moved)

    def set_postfix(self, *_: Any, refresh: bool = True, **figures: Any) -> None:
        """Show figures beside it; unknown numbers are left out."""
        shown = {name: value for name, value in figures.items() if _is_known(value)}
        super().set_postfix(refresh=refresh, **shown)

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """Draw the bar, or write a line if the last one is ten seconds old."""
        now = time.monotonic()
        if not self.lines:
            _State.spoken = now
            return bool(super().display(msg, pos))
        if now - _State.spoken >= INTERVAL:
            _State.spoken = now
            print(str(self)[:WIDTH], file=sys.stderr, flush=True)
        return True

    def close(self) -> None:
        """Leave the bar as it is."""
        super().close()
        if _State.bar is self:
            _State.bar = None


def counted(desc: str, unit: str) -> Callable[[Sequence[Any]], Iterator[Any]]:
    """Return what goes through a sequence with a bar."""

    def through(steps: Sequence[Any]) -> Iterator[Any]:
        bar = Bar(len(steps), desc=desc, unit=unit)
        try:
            for step in steps:
                yield step
                bar.update()
        finally:
            bar.close()

    return through


def _quiet() -> bool:
    return os.environ.get("TQDM_DISABLE") == "1"


def _is_known(value: Any) -> bool:
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError):
        return value not in (None, "")


def say(words: str, **_: Any) -> None:
    """Print what begins now; :func:`alive` repeats it while it lasts."""
    _State.phase, _State.begun = words, time.monotonic()
    _State.spoken = _State.begun
    print(words, flush=True)


def note(words: str) -> None:
    """Print what has happened, above a bar."""
    tqdm.write(words, file=sys.stdout)


@contextlib.contextmanager
def alive() -> Iterator[None]:
    """Give a sign of life at least every ten seconds in the context."""
    ended = threading.Event()
    _State.spoken = time.monotonic()

    def watch() -> None:
        while not ended.wait(1.0):
            now = time.monotonic()
            if now - _State.spoken < INTERVAL or _quiet():
                continue
            if _State.bar is not None:
                _State.bar.refresh()
                continue
            _State.spoken = now
            doing = _State.phase.partition(" (")[0].rstrip(" .")[: WIDTH - 20] or "Working"
            print(f"{doing}: {now - _State.begun:.0f} s so far", file=sys.stderr, flush=True)

    _State.phase, _State.begun = "", _State.spoken
    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        _State.bar = None


def table(rows: Sequence[tuple[str, str]]) -> str:
    """Return names and values as lines of two columns; a number of nothing, NaN, is a dash."""
    shown = [
        (name[:_NAME_WIDTH], "-" if value.startswith("nan") else value) for name, value in rows
    ]
    return "\n".join(f"  {name:<{_NAME_WIDTH}}  {value:>10}" for name, value in shown)


def figures_table(figures: Mapping[str, Any]) -> str:
    """Return the numbers of nested figures as a table."""
    rows = []
    for name, value in flat(figures):
        if isinstance(value, numbers.Real) and math.isfinite(value):
            exact = isinstance(value, numbers.Integral) or abs(float(value)) >= 1e4
            value = f"{float(value):,.0f}" if exact else f"{float(value):,.4g}"
        if isinstance(value, str):
            rows.append((name.replace(".", ": ").replace("_", " "), value))
    return table(rows)
