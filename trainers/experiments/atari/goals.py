"""Options found automatically: what can be controlled, goals on it, and which goals are of use.

Letters: S states, F = 128 bytes of RAM.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_hmcts.arguments import name_arguments
from torchrl_hmcts.envs import (
    AtariOptionPool,
    ByteGoal,
    FollowGoals,
    JoinedWorkers,
    OptionWorker,
    RepeatActions,
)
from torchrl_hmcts.trainers.experiments.atari.agent import AtariSearch
from torchrl_hmcts.trainers.experiments.atari.trials import play_trial
from torchrl_hmcts.trainers.skills.controllability import Controllability, probe_controllability


@dataclass(frozen=True)
class Candidate:
    """An option that may be of use.

    Attributes:
        name: for people.
        worker: carries it out, with this option only.

    Example:
        >>> from torchrl_hmcts.envs import RepeatActions
        >>> Candidate("FIRE", RepeatActions([1])).worker.num_options
        1
    """

    name: str
    worker: OptionWorker


@name_arguments
@dataclass(frozen=True)
class GoalSearch:
    """How options are looked for.

    Attributes:
        probe_states: states S in which every action is tried.
        hold_steps: base steps for which an action is held in a probe.
        offsets: o of the goals "bring c to b + o".
        max_goals: goals that are screened at most, those on the most controllable bytes first.
        screen_steps: base steps for which a rule follows each goal.
        shortlist: candidates that are left after screening.
        min_options, options: options that are chosen at least and at most.
        trial_steps: real base steps of a planner's trial.
        trial_ratio: simulated base steps per real one in a trial.
        option_steps: base steps of an option in a trial.

    Raises:
        ValueError: if a number is out of range.

    Example:
        >>> GoalSearch(offsets=(-6, 0, 6)).shortlist
        6
    """

    probe_states: int = 250
    hold_steps: int = 3
    offsets: tuple[int, ...] = (-12, 0, 12)
    max_goals: int = 150
    screen_steps: int = 400
    shortlist: int = 6
    min_options: int = 3
    options: int = 5
    trial_steps: int = 300
    trial_ratio: float = 5.0
    option_steps: int = 10

    def __post_init__(self) -> None:
        for name in (
            "probe_states", "hold_steps", "max_goals", "screen_steps", "shortlist", "min_options",
            "options", "trial_steps", "option_steps",
        ):  # fmt: skip
            if not getattr(self, name) >= 1:
                raise ValueError(f"GoalSearch needs {name} >= 1; got {getattr(self, name)}.")
        if not 0.0 < self.trial_ratio < float("inf"):
            raise ValueError(f"GoalSearch needs trial_ratio > 0, finite; got {self.trial_ratio}.")


def repeat_candidates(pool: AtariOptionPool) -> list[Candidate]:
    """Return an option for each action of the game: to repeat it."""
    return [
        Candidate(name, RepeatActions([action])) for action, name in enumerate(pool.action_names)
    ]


def goal_candidates(
    found: Controllability, action_names: Sequence[str], settings: GoalSearch
) -> list[Candidate]:
    r"""Return a goal "bring c to b + o" for each controllable c, moving b and offset o.

    Where the game has actions that move and fire at once, there is a goal with these too. The
    family is a person's idea of what is worth doing in a game; which members are of use is found
    out, and :func:`repeat_candidates` need none of it.

    Args:
        found: what a probe has found.
        action_names: the game's.
        settings: offsets, and how many goals at most.

    Example:
        >>> import numpy as np
        >>> from torchrl_hmcts.trainers.experiments.atari.goals import GoalSearch, goal_candidates
        >>> found = Controllability(
        ...     effects=np.array([[0.0, 0.0], [0.0, 0.0], [2.0, 0.0], [-2.0, 0.0]]),
        ...     dependence=np.array([0.9, 0.0]), num_values=np.array([40, 60]),
        ...     motion=np.array([0.0, 0.8]))
        >>> names = ["NOOP", "FIRE", "RIGHT", "LEFT"]
        >>> [c.name for c in goal_candidates(found, names, GoalSearch())]
        ['0 -> 1 - 12', '0 -> 1 + 0', '0 -> 1 + 12']
    """
    fire = action_names.index("FIRE") if "FIRE" in action_names else None
    controllable = found.controllable
    controllable = controllable[np.argsort(-found.dependence[controllable], kind="stable")]
    moving = found.moving
    moving = moving[np.argsort(-found.num_values[moving], kind="stable")]
    candidates: list[Candidate] = []
    for c in controllable.tolist():
        for fires in (False, True):
            up, down = (
                [a for a in found_actions if ("FIRE" in action_names[a]) == fires]
                for found_actions in (found.raising(c).tolist(), found.lowering(c).tolist())
            )
            if not up or not down:
                continue
            for b in moving.tolist():
                for offset in settings.offsets:
                    staying = fire if fires and fire is not None else 0
                    goal = ByteGoal(c, b, offset, up[0], down[0], staying)
                    sign = "-" if offset < 0 else "+"
                    name = f"{c} -> {b} {sign} {abs(offset)}" + (" firing" if fires else "")
                    candidates.append(Candidate(name, FollowGoals([goal], fire=fire)))
    if len(candidates) > settings.max_goals:  # evenly, so that every controllable byte is tried
        rows = np.linspace(0, len(candidates) - 1, settings.max_goals).astype(int)
        candidates = [candidates[i] for i in rows.tolist()]
    return candidates


def random_states(pool: AtariOptionPool, count: int, seed: int) -> TensorDictBase:
    """Return states ``[count]`` on the way of random options, of several episodes.

    Args:
        pool: what to play in.
        count: states.
        seed: of the options.
    """
    generator = torch.Generator().manual_seed(seed)
    states: list[TensorDictBase] = []
    td = pool.reset(TensorDict(batch_size=[1]))
    while len(states) < count:
        option = torch.randint(pool.num_options, (1,), generator=generator)
        td = pool.step(td.select("emulator_state").set("option", option))["next"]
        if td["done"].any():
            td = pool.reset(TensorDict(batch_size=[1]))
        else:
            states.append(td.select("emulator_state", "ram", "observation"))
    return torch.cat(states)  # type: ignore[call-overload,no-any-return]


class GoalFinder:
    r"""Finds options for a game: probe, goals, screening, trials under the planner.

    1. Every action is tried in random states (:func:`probe_controllability`).
    2. A rule follows each goal "bring c to b + o", and each action is repeated, for some steps from
       the same state; the best by the game's score are left.
    3. Options are added one by one to the set with which a planner's short trial scores best, until
       the score falls.

    What is of use is decided by planners, not by a rule's own score: under the planner options that
    score nothing alone, e.g. to go away, are worth something.

    Args:
        make_pool (callable): ``make_pool(worker, max_steps) -> AtariOptionPool``, deterministic.
        settings (GoalSearch): how much to try.
        search (AtariSearch): the planner of the trials; its ratio is that of ``settings``.
        seed (int): of all that is drawn.
        log (callable, optional): ``log(text)``, told what was found.

    Attributes:
        num_frames: frames emulated so far.
        report: what was found, as plain data.

    Reference:
        This project's; the goals are those of chapter 3 on what a probe finds.

    Example:
        >>> from torchrl_hmcts.trainers import GoalFinder, GoalSearch
        >>> from torchrl_hmcts.envs import AtariOptionPool
        >>> def make_pool(worker, max_steps):
        ...     return AtariOptionPool(
        ...         "Breakout", worker, max_steps=max_steps, num_processes=0, seed=0)
        >>> small = GoalSearch(probe_states=8, max_goals=4, screen_steps=5, shortlist=2,
        ...                    min_options=1, options=1, trial_steps=10, trial_ratio=1.0)
        >>> finder = GoalFinder(make_pool, small)
        >>> len(finder.find())
        1
    """

    def __init__(
        self,
        make_pool: Callable[[OptionWorker, int], AtariOptionPool],
        settings: GoalSearch | None = None,
        *,
        search: AtariSearch | None = None,
        seed: int = 0,
        log: Callable[[str], None] | None = None,
    ) -> None:
        self.make_pool = make_pool
        self.settings = GoalSearch() if settings is None else settings
        self.search = AtariSearch() if search is None else search
        self.seed = seed
        self.log = log if log is not None else _silent
        self.num_frames = 0
        self.report: dict[str, Any] = {}

    def find(self) -> list[Candidate]:
        """Return the options, the most useful first."""
        candidates, states = self.probe()
        ranked = self._screen(candidates, states[:1])
        return self.choose(ranked)

    def _spent(self, pool: AtariOptionPool) -> None:
        self.num_frames += pool.num_frames
        pool.close()

    def probe(self) -> tuple[list[Candidate], TensorDictBase]:
        """Return the candidates, and the states ``[S]`` in which the actions were tried."""
        settings = self.settings
        pool = self.make_pool(RepeatActions(1), settings.hold_steps)
        names = list(pool.action_names)
        self._spent(pool)
        pool = self.make_pool(RepeatActions(len(names)), settings.hold_steps)
        states = random_states(pool, settings.probe_states, self.seed)
        found = probe_controllability(pool, states, "ram")
        goals = goal_candidates(found, names, settings)
        repeats = repeat_candidates(pool)
        self._spent(pool)
        self.report["controllable"] = found.controllable.tolist()
        self.report["moving"] = found.moving.tolist()
        self.report["candidates"] = len(goals) + len(repeats)
        self.log(
            f"controllable bytes {found.controllable.tolist()}, moving {len(found.moving)}, "
            f"{len(goals)} goals, {len(repeats)} actions"
        )
        return goals + repeats, states

    def _screen(self, candidates: list[Candidate], state: TensorDictBase) -> list[Candidate]:
        settings = self.settings
        worker = JoinedWorkers([c.worker for c in candidates])
        pool = self.make_pool(worker, settings.screen_steps)
        td = state.select("emulator_state").expand(len(candidates)).clone()
        after = pool.step(td.set("option", torch.arange(len(candidates))))["next"]
        scores = after["score"].flatten().numpy()
        self._spent(pool)
        order = np.argsort(-scores, kind="stable")[: settings.shortlist].tolist()
        # Actions as such are few, and of use whatever they score alone.
        repeats = [i for i, c in enumerate(candidates) if isinstance(c.worker, RepeatActions)]
        order += sorted(set(repeats) - set(order), key=lambda i: -scores[i])[: settings.shortlist]
        self.report["screened"] = {candidates[i].name: float(scores[i]) for i in order}
        self.log(f"screened: {self.report['screened']}")
        return [candidates[i] for i in order]

    def choose(self, ranked: Sequence[Candidate]) -> list[Candidate]:
        """Return the set of candidates with which trials score best, found one by one.

        Args:
            ranked: candidates, the better ones first.
        """
        settings = self.settings
        chosen: list[Candidate] = []
        reached: list[float] = []  # by the first 1, 2, ... options
        trials = self.report.setdefault("trials", [])
        while len(chosen) < min(settings.options, len(ranked)):
            scores = {}
            for candidate in ranked:
                if candidate not in chosen:
                    names = [c.name for c in (*chosen, candidate)]
                    scores[candidate] = self.trial([*chosen, candidate])
                    trials.append({"options": names, "score": scores[candidate]})
            winner = max(scores, key=lambda c: scores[c])
            chosen.append(winner)
            reached.append(scores[winner])
            self.log(f"{[c.name for c in chosen]}: {reached[-1]:g}")
            if len(chosen) > settings.min_options and reached[-1] < max(reached):
                break
        # Where a short trial cannot tell, more options are safer than fewer.
        least = min(settings.min_options, len(chosen)) - 1
        count = max(range(least, len(chosen)), key=lambda i: (round(reached[i], 3), i)) + 1
        self.report["chosen"] = [c.name for c in chosen[:count]]
        return chosen[:count]

    def trial(
        self,
        options: Sequence[Candidate],
        *,
        option_steps: int | None = None,
        real_steps: int | None = None,
        ratio: float | None = None,
        seed: int | None = None,
    ) -> float:
        """Return the score of a planner's short episode with some options.

        Args:
            options: the set to try.
            option_steps, real_steps, ratio: instead of those of the settings.
            seed: of the start and of the search. Default: the start that ``make_pool`` gives, and
                the finder's own seed.
        """
        worker = JoinedWorkers([c.worker for c in options])
        return self.try_worker(
            worker, option_steps=option_steps, real_steps=real_steps, ratio=ratio, seed=seed
        )

    def try_worker(
        self,
        worker: OptionWorker,
        *,
        option_steps: int | None = None,
        real_steps: int | None = None,
        ratio: float | None = None,
        seed: int | None = None,
    ) -> float:
        """Return the score of a planner's short episode with all options of a worker.

        Args:
            worker: of any kind.
            option_steps, real_steps, ratio, seed: as those of :meth:`trial`.
        """
        settings = self.settings
        trial = play_trial(
            self.make_pool,
            worker,
            replace(self.search, ratio=settings.trial_ratio if ratio is None else ratio),
            option_steps=settings.option_steps if option_steps is None else option_steps,
            real_steps=settings.trial_steps if real_steps is None else real_steps,
            seed=self.seed if seed is None else seed,
            start=seed,
        )
        self.num_frames += trial.num_frames
        # An episode that ended early counts by its score alone; ties go to who lived longer.
        return trial.score + 1e-6 * trial.real_steps


def _silent(text: str) -> None:
    """Say nothing."""
