"""A memory of the short planned episodes in which options and settings are compared."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_hmcts.trainers.saving.files import read_json, write_json


class Trial(NamedTuple):
    """A trial's score by the game, its base steps (fewer than asked for if the episode ended), and
    the frames emulated for it, real and simulated."""

    score: float
    real_steps: int
    num_frames: int

    @property
    def rank(self) -> float:
        """The score; ties go to who lived longer."""
        return self.score + 1e-6 * self.real_steps


class TrialMemory:
    """Trials in a file, so that a search for options that is stopped plays none twice.

    A trial is a function of its key and of the ``settings`` (plain data). A file of other settings
    is replaced; so is one that is damaged, and a line on stderr tells it.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any]) -> None:
        self._path = Path(path)
        self._settings = dict(settings)
        self._known: dict[str, list[Any]] = {}
        if self._path.is_file():
            try:
                found = read_json(self._path)
                if set(found) != {"settings", "trials"}:
                    raise ValueError(f"{self._path} cannot be read: it holds {sorted(found)}.")
                if found["settings"] == self._settings:
                    self._known = dict(found["trials"])
            except (ValueError, TypeError) as error:  # it saves time only
                print(f"{error} Its trials are played again.", file=sys.stderr)

    def recall(self, key: str) -> Trial | None:
        """Return the trial of a key, or None if there was none."""
        row = self._known.get(key)
        return None if row is None else Trial(*row)

    def remember(self, key: str, trial: Trial) -> None:
        """Add a trial and write the file in one move."""
        self._known[key] = list(trial)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        content = {"settings": self._settings, "trials": self._known}
        write_json(self._path, content, checksum=True)
