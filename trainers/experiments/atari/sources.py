"""Where the agent's options come from, where nothing is learned; each an object that swaps in."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torchrl_hmcts.envs import JoinedWorkers, RepeatActions
from torchrl_hmcts.trainers.experiments.atari.agent import AtariSearch
from torchrl_hmcts.trainers.experiments.atari.goals import (
    Candidate,
    GoalFinder,
    GoalSearch,
    repeat_candidates,
)
from torchrl_hmcts.trainers.experiments.atari.options import (
    MakePool,
    Options,
    WorkerSource,
    plain_worker,
)


@dataclass(frozen=True)
class RepeatSource:
    """An option for each of the game's actions: to repeat it. Nothing is learned.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool
        >>> from torchrl_hmcts.trainers import RepeatSource
        >>> def make_pool(worker, max_steps):
        ...     return AtariOptionPool("Pong", worker, max_steps=max_steps, num_processes=0)
        >>> RepeatSource().find("Pong", make_pool, seed=0, log=print).names[:3]
        ['NOOP', 'FIRE', 'RIGHT']
    """

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        pool = make_pool(RepeatActions(1), 1)
        names, frames = list(pool.action_names), pool.num_frames
        pool.close()
        worker = RepeatActions(len(names))
        return Options(worker, names, frames, saved={"parts": [plain_worker(worker)]})


@dataclass(frozen=True)
class ActionSource:
    """Actions to repeat, chosen by trials: with fewer options a search looks further ahead.

    Attributes:
        settings: how much to try; what it says of goals and screening is not used.
        search: the planner of the trials.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool
        >>> from torchrl_hmcts.trainers import ActionSource, GoalSearch
        >>> def make_pool(worker, max_steps):
        ...     return AtariOptionPool("Pong", worker, max_steps=max_steps, num_processes=0)
        >>> small = GoalSearch(min_options=1, options=1, trial_steps=4, trial_ratio=1.0)
        >>> len(ActionSource(small).find("Pong", make_pool, seed=0, log=lambda text: None).names)
        1
    """

    settings: GoalSearch = field(default_factory=GoalSearch)
    search: AtariSearch = field(default_factory=AtariSearch)

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        finder = GoalFinder(make_pool, self.settings, search=self.search, seed=seed, log=log)
        pool = make_pool(RepeatActions(1), 1)
        candidates = repeat_candidates(pool)
        finder.num_frames += pool.num_frames
        pool.close()
        return _joined(finder.choose(candidates), finder.num_frames, finder.report)


@dataclass(frozen=True)
class ActionSetSource:
    """Actions to repeat: all, those that fire, or those that do not, whichever trials score best.

    In games where an action can move and fire at once, the firing ones lose nothing and are a third
    of all, so that a search looks further ahead; where fire is lost or costs, the others may be
    better. The names of the actions are all that is known of the game.

    Attributes:
        settings: how much to try; what it says of goals and screening is not used.
        search: the planner of the trials.
        trials: starts and searches over which the score of a set is averaged.

    Raises:
        ValueError: if ``trials`` is below 1.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool
        >>> from torchrl_hmcts.trainers import ActionSetSource, GoalSearch
        >>> def make_pool(worker, max_steps):
        ...     return AtariOptionPool("Pong", worker, max_steps=max_steps, num_processes=0)
        >>> small = GoalSearch(trial_steps=4, trial_ratio=1.0)
        >>> source = ActionSetSource(small, trials=1)
        >>> found = source.find("Pong", make_pool, seed=0, log=lambda text: None)
        >>> list(found.report["action_sets"])
        ['all', 'firing', 'not firing']
    """

    settings: GoalSearch = field(default_factory=GoalSearch)
    search: AtariSearch = field(default_factory=AtariSearch)
    trials: int = 2

    def __post_init__(self) -> None:
        if self.trials < 1:
            raise ValueError(f"ActionSetSource needs trials >= 1; got {self.trials}.")

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        finder = GoalFinder(make_pool, self.settings, search=self.search, seed=seed, log=log)
        pool = make_pool(RepeatActions(1), 1)
        every = repeat_candidates(pool)
        finder.num_frames += pool.num_frames
        pool.close()
        sets = {
            "all": every,
            "firing": [c for c in every if "FIRE" in c.name],
            "not firing": [c for c in every if "FIRE" not in c.name],
        }
        scores: dict[str, float] = {}
        for name, options in sets.items():
            if len(options) < 2 or (name != "all" and len(options) == len(every)):
                continue
            seeds = [seed * 10_000 + i for i in range(self.trials)]
            scores[name] = sum(finder.trial(options, seed=s) for s in seeds) / self.trials
            log(f"{name}, {[c.name for c in options]}: {scores[name]:g}")
        finder.report["action_sets"] = scores
        best = max(scores, key=lambda name: scores[name])
        return _joined(sets[best], finder.num_frames, finder.report)


@dataclass(frozen=True)
class GoalSource:
    """Goals on controllable bytes and actions to repeat, chosen by trials: :class:`GoalFinder`.

    Attributes:
        settings: how much to try.
        search: the planner of the trials.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool
        >>> from torchrl_hmcts.trainers import GoalSearch, GoalSource
        >>> def make_pool(worker, max_steps):
        ...     return AtariOptionPool("Breakout", worker, max_steps=max_steps, num_processes=0)
        >>> small = GoalSearch(probe_states=8, max_goals=4, screen_steps=5, shortlist=2,
        ...                    min_options=1, options=1, trial_steps=10, trial_ratio=1.0)
        >>> found = GoalSource(small).find("Breakout", make_pool, seed=0, log=lambda text: None)
        >>> found.worker.num_options
        1
    """

    settings: GoalSearch = field(default_factory=GoalSearch)
    search: AtariSearch = field(default_factory=AtariSearch)

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        finder = GoalFinder(make_pool, self.settings, search=self.search, seed=seed, log=log)
        chosen = finder.find()
        return _joined(chosen, finder.num_frames, finder.report)


@dataclass(frozen=True)
class BestSource:
    r"""The options of whichever source a planner's trials score best with.

    .. math:: \arg\max_i \frac{1}{n} \sum_{j < n} \mathrm{score}_j(\text{options of source } i)

    Every source looks for its options first; the frames of all of them count.

    Attributes:
        sources: by name.
        settings: real steps, ratio and length of options of the trials.
        search: the planner of the trials.
        trials: starts and searches over which the score of a source is averaged; n.

    Raises:
        ValueError: if there is no source, or ``trials`` is below 1.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool
        >>> from torchrl_hmcts.trainers import ActionSource, BestSource, GoalSearch, RepeatSource
        >>> def make_pool(worker, max_steps):
        ...     return AtariOptionPool("Pong", worker, max_steps=max_steps, num_processes=0)
        >>> small = GoalSearch(min_options=1, options=1, trial_steps=4, trial_ratio=1.0)
        >>> best = BestSource({"all": RepeatSource(), "some": ActionSource(small)}, small, trials=1)
        >>> found = best.find("Pong", make_pool, seed=0, log=lambda text: None)
        >>> list(found.report["sources"])
        ['all', 'some']
    """

    sources: Mapping[str, WorkerSource]
    settings: GoalSearch = field(default_factory=GoalSearch)
    search: AtariSearch = field(default_factory=AtariSearch)
    trials: int = 2

    def __post_init__(self) -> None:
        if not self.sources:
            raise ValueError("BestSource chooses among sources; got none.")
        if self.trials < 1:
            raise ValueError(f"BestSource needs trials >= 1; got {self.trials}.")

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        finder = GoalFinder(make_pool, self.settings, search=self.search, seed=seed, log=log)
        seeds = [seed * 10_000 + i for i in range(self.trials)]
        found: dict[str, Options] = {}
        scores: dict[str, float] = {}
        for name, source in self.sources.items():
            options = source.find(game, make_pool, seed=seed, log=log)
            found[name] = options
            scores[name] = sum(finder.try_worker(options.worker, seed=s) for s in seeds) / len(
                seeds
            )
            log(f"source {name}, {options.names}: {scores[name]:g}")
        best = max(scores, key=lambda name: scores[name])
        chosen = found[best]
        report = {
            **chosen.report,
            "source": best,
            "sources": {n: {"score": scores[n], "options": o.names} for n, o in found.items()},
        }
        frames = finder.num_frames + sum(options.num_frames for options in found.values())
        return dataclasses.replace(chosen, num_frames=frames, report=report)


def _joined(chosen: Sequence[Candidate], frames: int, report: dict[str, Any]) -> Options:
    workers = [c.worker for c in chosen]
    saved = {"parts": [plain_worker(w) for w in workers]}
    return Options(JoinedWorkers(workers), [c.name for c in chosen], frames, report, saved)
