"""Short planned episodes in which options are compared, and a memory of those played already."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_hmcts.envs import AtariOptionPool, OptionWorker
from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent, AtariSearch
from torchrl_hmcts.trainers.experiments.atari.options import plain_worker
from torchrl_hmcts.trainers.saving.files import read_json, write_json


@dataclass(frozen=True)
class Trial:
    """What came of a trial.

    Attributes:
        score: the game's.
        real_steps: base steps played; fewer than asked for if the episode ended.
        num_frames: frames emulated, real and simulated.

    Example:
        >>> Trial(score=3.0, real_steps=300, num_frames=7_000).score
        3.0
    """

    score: float
    real_steps: int
    num_frames: int


class RememberedTrials:
    """Makes pools as another does, and remembers the trials in them, in a file.

    A search for options plays many trials, each a function of its settings. Where a run was stopped
    in the middle, those that the file holds are not played again; their frames count as before.

    Args:
        make_pool (callable): ``make_pool(worker, max_steps, ...) -> AtariOptionPool``.
        path (path): JSON file with a checksum. One of other settings is replaced; so is one that
            is damaged, and a line on stderr says so.
        settings (mapping): all else on which trials depend, e.g. the game; plain data.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchrl_hmcts.trainers.experiments.atari.trials import RememberedTrials, Trial
        >>> path = Path(tempfile.mkdtemp(), "trials.json")
        >>> RememberedTrials(None, path, {"game": "Pong"}).remember("key", Trial(1.0, 300, 7_000))
        >>> RememberedTrials(None, path, {"game": "Pong"}).recall("key")
        Trial(score=1.0, real_steps=300, num_frames=7000)
    """

    def __init__(
        self,
        make_pool: Callable[..., AtariOptionPool],
        path: str | Path,
        settings: Mapping[str, Any],
    ) -> None:
        self._make_pool = make_pool
        self._path = Path(path)
        self._settings = dict(settings)
        self._known: dict[str, list[float]] = {}
        if self._path.is_file():
            try:
                found = read_json(self._path)
                if set(found) != {"settings", "trials"}:
                    raise ValueError(f"{self._path} cannot be read: it holds {sorted(found)}.")
                if found["settings"] == self._settings:
                    self._known = dict(found["trials"])
            except (ValueError, TypeError) as error:  # it saves time only
                print(f"{error} Its trials are played again.", file=sys.stderr)

    def __call__(self, *args: Any, **kwargs: Any) -> AtariOptionPool:
        """Make a pool."""
        return self._make_pool(*args, **kwargs)

    def recall(self, key: str) -> Trial | None:
        """Return the trial of a key, or None if there was none."""
        row = self._known.get(key)
        return None if row is None else Trial(float(row[0]), int(row[1]), int(row[2]))

    def remember(self, key: str, trial: Trial) -> None:
        """Add a trial and write the file in one move."""
        self._known[key] = [trial.score, trial.real_steps, trial.num_frames]
        self._path.parent.mkdir(parents=True, exist_ok=True)
        content = {"settings": self._settings, "trials": self._known}
        write_json(self._path, content, checksum=True)


def play_trial(
    make_pool: Callable[..., AtariOptionPool],
    worker: OptionWorker,
    search: AtariSearch,
    *,
    option_steps: int,
    real_steps: int,
    seed: int,
    start: int | None = None,
) -> Trial:
    """Plan and play a short episode.

    Args:
        make_pool: as a source is given it; a :class:`RememberedTrials` plays nothing twice.
        worker: whose options are tried.
        search: how to plan.
        option_steps: base steps of an option.
        real_steps: base steps to play at most.
        seed: of the search.
        start: seed of the start. Default: the start that ``make_pool`` gives.
    """
    key = None
    if isinstance(make_pool, RememberedTrials):
        asked = [dataclasses.asdict(search), option_steps, real_steps, seed, start]
        try:
            key = json.dumps([plain_worker(worker), *asked], sort_keys=True)
        except TypeError:  # a network is known by its weights, which are no key; or it is your own
            key = None
        known = None if key is None else make_pool.recall(key)
        if known is not None:
            return known
    pool = make_pool(worker, option_steps)
    try:
        if start is not None:
            pool.set_seed(start)
        progress = AtariAgent(pool, search, seed=seed).play(max_steps=real_steps)
        trial = Trial(progress.score, progress.real_steps, pool.num_frames)
    finally:
        pool.close()
    if key is not None:
        assert isinstance(make_pool, RememberedTrials)
        make_pool.remember(key, trial)
    return trial
