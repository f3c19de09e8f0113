"""The journal of a sweep: Optuna's, with a checksum in each line."""

from __future__ import annotations

import io
import json
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from optuna.storages.journal import JournalFileBackend

from torchrl_hmcts.trainers.saving.files import digest

_CHECKSUM = "checksum"


class CheckedJournal(JournalFileBackend):
    """Optuna's journal file, from which a sweep continues, checked when it is opened.

    A last line that a killed process has written half is cut off, and a line on stderr says so; the
    journal as it was is kept beside it, as ``journal.log.damaged``.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(str(path))
        self._lock.acquire()
        try:
            _check(Path(path))
        finally:
            self._lock.release()

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Append lines, each with its checksum."""
        super().append_logs([{**log, _CHECKSUM: digest(log)} for log in logs])

    def read_logs(self, log_number_from: int) -> Iterator[dict[str, Any]]:  # type: ignore[override]
        """Return the lines from a number on."""
        for log in super().read_logs(log_number_from):
            log.pop(_CHECKSUM, None)
            yield log


def _check(path: Path) -> None:
    lines = io.BytesIO(path.read_bytes()).readlines()
    if lines and not (lines[-1].endswith(b"\n") and _is_json(lines[-1])):
        kept = path.with_name(f"{path.name}.damaged")
        shutil.copy2(path, kept)
        print(
            f"{path}: its last line is not whole and is left out; as it was: {kept.name}.",
            file=sys.stderr,
        )
        os.truncate(path, sum(map(len, lines[:-1])))
        lines.pop()
    for number, line in enumerate(lines, 1):
        try:
            log = json.loads(line)
            if log.pop(_CHECKSUM, None) in (None, digest(log)):
                continue
            reason = "differs from its checksum"
        except (ValueError, AttributeError, RecursionError) as error:
            reason = f"cannot be read: {error}"
        raise ValueError(
            f"{path} is damaged: line {number} {reason}. Restore it from a backup, or choose "
            "another folder with out=DIR."
        )


def _is_json(line: bytes) -> bool:
    try:
        json.loads(line)
    except (ValueError, RecursionError):
        return False
    return True
