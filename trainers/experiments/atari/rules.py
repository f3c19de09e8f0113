"""Options that are rules: candidate sets, and which of them a planner's trials score best with.

Letters: S states, F = 128 bytes of RAM.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.envs import (
    ByteGoal,
    FollowGoals,
    JoinedWorkers,
    OccasionalAction,
    OptionWorker,
    RepeatActions,
)
from torchrl_hmcts.trainers.experiments.atari.agent import AtariSearch
from torchrl_hmcts.trainers.experiments.atari.config import RULES
from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit
from torchrl_hmcts.trainers.experiments.atari.options import Options
from torchrl_hmcts.trainers.experiments.atari.trials import play_trial
from torchrl_hmcts.trainers.skills.controllability import (
    Controllability,
    probe_controllability,
    random_states,
)

_HOLD_STEPS = 3  # for which an action is held in a probe
_OFFSETS = (-12, 0, 12)  # o of the goals "bring c to b + o"
_SHORTLIST = 6  # candidates that are left after screening, and actions beside them
_OPTION_STEPS = 10  # of an option in a trial


class Rule(NamedTuple):
    """An option with a name for people, and the worker of this option alone."""

    name: str
    worker: OptionWorker


def joined(rules: Sequence[Rule]) -> JoinedWorkers:
    """Return the worker of some rules, in their order."""
    return JoinedWorkers([rule.worker for rule in rules])


def _names(rules: Sequence[Rule]) -> list[str]:
    return [rule.name for rule in rules]


@dataclass(frozen=True)
class RuleSource:
    r"""Options that are rules, chosen from candidate sets by a planner's trials.

    ================= ==============================================================================
    ``candidates``    what is tried
    ================= ==============================================================================
    ``"repeat"``      nothing: an option for each of the game's actions, to repeat it
    ``"actions"``     these, added one by one to the set with which a trial scores best, until the
                      score falls: with fewer options a search looks further ahead
    ``"action_sets"`` all of these, those that fire or those that do not. Where an action can move
                      and fire at once, the firing ones lose nothing and are a third of all. The
                      names of the actions are all that is known of the game
    ``"screened"``    nothing: the six goals of the first two steps below that score best alone,
                      and all actions; a manager that practises finds out what they are good for
    ``"goals"``       goals "bring byte c to byte b plus an offset" and repeated actions, see below
    ``"best"``        the three above, and of these the one whose options score best
    ================= ==============================================================================

    Goals are found in three steps. (1) Every action is tried in random states
    (:func:`~torchrl_hmcts.trainers.probe_controllability`). (2) A rule follows each goal on a
    controllable c and a moving b, and each action is repeated, for some steps from the same state;
    the best by the game's score are left. (3) Options are added one by one as above. Planners
    decide what is of use, not a rule's own score: under the planner options that score nothing
    alone, e.g. to go away, are worth something. Between whole sets the mean score decides,

    .. math:: \arg\max_i \frac{1}{n} \sum_{j < n} \mathrm{score}_j(\text{set } i).

    The frames of all trials count.

    Attributes:
        candidates: as above.
        search: the planner of the trials; its ratio is ``trial_ratio``.
        probe_states: states S in which every action is tried.
        max_goals: goals that are screened at most, those on the most controllable bytes first.
        screen_steps: base steps for which a rule follows each goal.
        min_options, options: options that are chosen at least and at most.
        trial_steps: real base steps of a planner's trial.
        trial_ratio: simulated base steps per real one in a trial.
        repetitions: starts and searches over which the score of a whole set is averaged; n.

    Raises:
        TypeError: if a number is none.
        ValueError: if a number is out of range or the candidates are unknown.

    Reference:
        This project's; the goals are those of the dissertation's chapter 3 on what a probe finds.

    Example:
        >>> from torchrl_hmcts.trainers import AtariKit, RuleSource
        >>> kit = AtariKit("Pong", num_processes=0, log=lambda text: None)
        >>> RuleSource("repeat").find(kit).names[:3]
        ['NOOP', 'FIRE', 'RIGHT']
        >>> small = {"trial_steps": 4, "trial_ratio": 1.0, "repetitions": 1}
        >>> found = RuleSource("action_sets", **small).find(kit)
        >>> list(found.report["action_sets"])
        ['all', 'firing', 'not firing']
    """

    candidates: str = "best"
    search: AtariSearch = field(default_factory=AtariSearch)
    probe_states: int = 250
    max_goals: int = 150
    screen_steps: int = 400
    min_options: int = 3
    options: int = 5
    trial_steps: int = 300
    trial_ratio: float = 5.0
    repetitions: int = 2

    def __post_init__(self) -> None:
        if self.candidates not in RULES:
            raise ValueError(
                f"RuleSource: candidates are one of {', '.join(RULES)}; got {self.candidates!r}."
            )
        for name in (
            "probe_states", "max_goals", "screen_steps", "min_options", "options", "trial_steps",
            "repetitions",
        ):  # fmt: skip
            whole_number("RuleSource", name, getattr(self, name), least=1)
        real_number("RuleSource", "trial_ratio", self.trial_ratio, above=0.0)

    def find(self, kit: AtariKit) -> Options:
        """Return the options of a game."""
        search = RuleSearch(self, kit)
        report: dict[str, Any] = {}
        rules = search.choose(self.candidates, report)
        return Options(joined(rules), _names(rules), search.num_frames, report)


class RuleSearch:
    """One search for rules: a :class:`RuleSource` at work on a game."""

    def __init__(self, settings: RuleSource, kit: AtariKit) -> None:
        self.settings, self.kit, self.log = settings, kit, kit.log
        self.num_frames = 0  # emulated so far

    def choose(self, candidates: str, report: dict[str, Any]) -> list[Rule]:
        """Return the rules that are chosen from a candidate set."""
        if candidates == "goals":
            ranked, states = self.probe(report)
            return self.grow(self.screen(ranked, states[:1], report), report)
        if candidates == "best":
            reports: dict[str, dict[str, Any]] = {"action_sets": {}, "actions": {}, "goals": {}}
            sets = {name: self.choose(name, reports[name]) for name in reports}
            best, scores = self.best_set(sets)
            tried = {n: {"score": scores[n], "options": _names(s)} for n, s in sets.items()}
            report.update(reports[best], source=best, sources=tried)
            return sets[best]
        rules = self.repeats()
        if candidates == "screened":
            ranked, states = self.probe(report)
            kept = self.screen(ranked, states[:1], report)
            return [rule for rule in kept if not isinstance(rule.worker, RepeatActions)] + rules
        if candidates == "actions":
            return self.grow(rules, report)
        if candidates == "action_sets":
            firing = [rule for rule in rules if "FIRE" in rule.name]
            others = [rule for rule in rules if rule not in firing]
            sets = {"all": rules}
            if min(len(firing), len(others)) > 0:
                parts = {"firing": firing, "not firing": others}
                sets |= {name: part for name, part in parts.items() if len(part) > 1}
            best, report["action_sets"] = self.best_set(sets)
            return sets[best]
        return rules

    def repeats(self) -> list[Rule]:
        """Return an option for each action of the game: to repeat it."""
        names = self.kit.action_names
        return [Rule(name, RepeatActions([action])) for action, name in enumerate(names)]

    # ---------------------------------------------------------------- goals

    def probe(self, report: dict[str, Any]) -> tuple[list[Rule], TensorDictBase]:
        """Return all goals and actions, and the states ``[S]`` in which the actions were tried."""
        settings, repeats = self.settings, self.repeats()
        pool = self.kit.make_pool(RepeatActions(len(repeats)), _HOLD_STEPS)
        states = random_states(pool, settings.probe_states, self.kit.seed)
        found = probe_controllability(pool, states, "ram")
        goals = make_goals(found, _names(repeats), settings)
        self.num_frames += pool.num_frames
        pool.close()
        report["controllable"] = found.controllable.tolist()
        report["moving"] = found.moving.tolist()
        report["candidates"] = len(goals) + len(repeats)
        self.log(
            f"controllable bytes {report['controllable']}, moving {len(found.moving)}, "
            f"{len(goals)} goals, {len(repeats)} actions"
        )
        return goals + repeats, states

    def screen(
        self, rules: list[Rule], state: TensorDictBase, report: dict[str, Any]
    ) -> list[Rule]:
        """Return the rules that score best alone, then the best of the actions among the others."""
        settings = self.settings
        pool = self.kit.make_pool(joined(rules), settings.screen_steps)
        td = state.select("emulator_state").expand(len(rules)).clone()
        after = pool.step(td.set("option", torch.arange(len(rules))))["next"]
        scores = after["score"].flatten().numpy()
        self.num_frames += pool.num_frames
        pool.close()
        order = np.argsort(-scores, kind="stable")[:_SHORTLIST].tolist()
        # Actions as such are few, and of use although they may score nothing alone.
        repeats = [i for i, rule in enumerate(rules) if isinstance(rule.worker, RepeatActions)]
        order += sorted(set(repeats) - set(order), key=lambda i: -scores[i])[:_SHORTLIST]
        report["screened"] = {rules[i].name: float(scores[i]) for i in order}
        self.log(f"screened: {report['screened']}")
        return [rules[i] for i in order]

    # ---------------------------------------------------------------- trials

    def score(self, rules: Sequence[Rule], seed: int | None = None) -> float:
        """Return how well a planner's short episode with some options went; the seed is also that
        of the start."""
        settings = self.settings
        trial = play_trial(
            self.kit,
            joined(rules),
            replace(settings.search, ratio=settings.trial_ratio),
            option_steps=_OPTION_STEPS,
            real_steps=settings.trial_steps,
            seed=self.kit.seed if seed is None else seed,
            start=seed,
        )
        self.num_frames += trial.num_frames
        return trial.rank

    def best_set(self, sets: Mapping[str, Sequence[Rule]]) -> tuple[str, dict[str, float]]:
        """Return which set has the best mean score over some starts and searches, and the scores of
        all."""
        scores, first, count = {}, self.kit.seed * 10_000, self.settings.repetitions
        for name, rules in sets.items():
            scores[name] = sum(self.score(rules, first + i) for i in range(count)) / count
            self.log(f"{name}, {_names(rules)}: {scores[name]:g}")
        return max(scores, key=lambda name: scores[name]), scores

    def grow(self, ranked: Sequence[Rule], report: dict[str, Any]) -> list[Rule]:
        """Return the set of rules with which trials score best, found one by one."""
        settings = self.settings
        chosen: list[Rule] = []
        reached: list[float] = []  # by the first 1, 2, ... options
        trials = report["trials"] = []
        while len(chosen) < min(settings.options, len(ranked)):
            scores = {}
            for rule in ranked:
                if rule not in chosen:
                    scores[rule] = self.score([*chosen, rule])
                    trials.append({"options": _names([*chosen, rule]), "score": scores[rule]})
            chosen.append(max(scores, key=lambda rule: scores[rule]))
            reached.append(scores[chosen[-1]])
            self.log(f"{_names(chosen)}: {reached[-1]:g}")
            if len(chosen) > settings.min_options and reached[-1] < max(reached):
                break
        # Where a short trial cannot tell, more options are safer than fewer.
        least = min(settings.min_options, len(chosen)) - 1
        count = max(range(least, len(chosen)), key=lambda i: (round(reached[i], 3), i)) + 1
        report["chosen"] = _names(chosen[:count])
        return chosen[:count]


def make_goals(
    found: Controllability, action_names: Sequence[str], settings: RuleSource
) -> list[Rule]:
    """Return a goal "bring c to b + o" for each controllable c, moving b and offset o, and one with
    firing actions where the game has such that move, too."""
    fire = action_names.index("FIRE") if "FIRE" in action_names else None
    controllable = found.controllable
    controllable = controllable[np.argsort(-found.dependence[controllable], kind="stable")]
    moving = found.moving
    moving = moving[np.argsort(-found.num_values[moving], kind="stable")]
    rules: list[Rule] = []
    for c in controllable.tolist():
        for fires in (False, True):
            up, down = (
                [action for action in actions if ("FIRE" in action_names[action]) == fires]
                for actions in (found.raising(c).tolist(), found.lowering(c).tolist())
            )
            if not up or not down:
                continue
            staying = fire if fires and fire is not None else 0
            for b in moving.tolist():
                for offset in _OFFSETS:
                    goal = ByteGoal(c, b, offset, up[0], down[0], staying)
                    sign = "-" if offset < 0 else "+"
                    name = f"{c} -> {b} {sign} {abs(offset)}" + (" firing" if fires else "")
                    worker = FollowGoals([goal])
                    rules.append(
                        Rule(name, worker if fire is None else OccasionalAction(worker, fire))
                    )
    if len(rules) > settings.max_goals:  # evenly, so that every controllable byte is tried
        rows = np.linspace(0, len(rules) - 1, settings.max_goals).astype(int)
        rules = [rules[i] for i in rows.tolist()]
    return rules
