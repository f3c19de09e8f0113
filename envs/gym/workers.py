"""Workers of a pool that follow rules: repeated actions, goals, and combinations of workers."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.envs.gym.option_run import OptionWorker


class RepeatActions:
    """Options that repeat one action.

    Args:
        actions (int or sequence): the action of each option, an index or an array; a number means
            all indices below it.

    Raises:
        TypeError: if it is neither a number nor a sequence.
        ValueError: if there is no action.

    Reference:
        Braylan et al., "Frame skip is a powerful parameter for learning to play Atari", 2015.

    Example:
        >>> from torchrl_hmcts.envs import RepeatActions
        >>> RepeatActions(4).num_options, RepeatActions([0, 2]).act(None, 1, None)
        (4, 2)
    """

    def __init__(self, actions: int | Sequence[Any]) -> None:
        if isinstance(actions, numbers.Real):
            actions = range(whole_number("RepeatActions", "actions", actions, least=1))
        if not isinstance(actions, Sequence):
            raise TypeError(
                f"RepeatActions needs a number or a sequence for actions; got {actions!r}."
            )
        self.actions = tuple(actions)
        if not self.actions:
            raise ValueError("RepeatActions needs at least one action; got actions=().")
        self.num_options = len(self.actions)

    def __repr__(self) -> str:
        return f"RepeatActions({list(self.actions)})"

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> Any:
        """Return the option's action."""
        return self.actions[option]


class Goal(Protocol):
    """Protocol of the goal of an option of :class:`FollowGoals`, e.g. a :class:`FeatureGoal`.

    It may have ``reached(observation) -> bool`` too: whether the option ends.
    """

    def action(self, observation: Any) -> Any:
        """Return the action that brings the goal nearer."""
        ...


@dataclass(frozen=True)
class FeatureGoal:
    r"""Bring one feature x_c of the observation to a value v; the option ends there.

    .. math:: a = \begin{cases} \text{raise} & x_c < v \\ \text{lower} & x_c \ge v \end{cases}

    Attributes:
        features: ``features(None, observation)`` gives an array ``[F]``.
        controlled: c, a feature that actions move.
        value: v.
        raising, lowering: actions that raise the feature and lower it.
        dead_zone: the goal is reached where :math:`|x_c - v|` is at most this.

    Reference:
        This project's; goals of a worker as in chapter 3 of the dissertation.

    Example:
        >>> import numpy as np
        >>> from torchrl_hmcts.envs import FeatureGoal
        >>> goal = FeatureGoal(lambda env, observation: observation, 1, 0.5, raising=2, lowering=0)
        >>> goal.action(np.array([9.0, 0.0])), goal.reached(np.array([9.0, 0.45]))
        (2, True)
    """

    features: Callable[[Any, Any], np.ndarray]
    controlled: int
    value: float
    raising: Any
    lowering: Any
    dead_zone: float = 0.1

    def action(self, observation: Any) -> Any:
        """Return the action that brings the goal nearer."""
        lower = self.features(None, observation)[self.controlled] >= self.value
        return self.lowering if lower else self.raising

    def reached(self, observation: Any) -> bool:
        """Return whether the feature has the value."""
        missing = self.features(None, observation)[self.controlled] - self.value
        return bool(abs(missing) <= self.dead_zone)


class FollowGoals:
    """Options that are goals, executed by rule.

    Args:
        goals (sequence of Goal): one for each option.

    Raises:
        ValueError: if there is no goal.

    Reference:
        This project's; goals of a worker as in chapter 3 of the dissertation.

    Example:
        >>> from torchrl_hmcts.envs import ByteGoal, FollowGoals
        >>> FollowGoals([ByteGoal(72, 99, o, 2, 3) for o in (-12, 0, 12)]).num_options
        3
    """

    def __init__(self, goals: Sequence[Goal]) -> None:
        self.goals: tuple[Any, ...] = tuple(goals)
        if not self.goals:
            raise ValueError("FollowGoals needs a goal for each option; got none.")
        self.num_options = len(self.goals)

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> Any:
        """Return the action that brings the option's goal nearer."""
        return self.goals[option].action(observation)

    def ends(self, observation: Any, option: int, steps: int) -> bool:
        """Return whether the option's goal is reached; never, if it does not say."""
        reached: Any = getattr(self.goals[option], "reached", None)
        return False if reached is None else bool(reached(observation))


def _begin(worker: Any, observation: Any, option: int) -> None:
    if hasattr(worker, "begin"):
        worker.begin(observation, option)


def _ends(worker: Any, observation: Any, option: int, steps: int) -> bool:
    return hasattr(worker, "ends") and bool(worker.ends(observation, option, steps))


class OccasionalAction:
    """Another worker's options, sometimes interrupted by one action.

    Games wait for FIRE, e.g. to serve; a learned worker that has forgotten it never starts.

    Args:
        worker (OptionWorker): whose options they are.
        action (int): index of the action.
        probability (float): how often it is taken. Default 0.05.

    Raises:
        ValueError: if the probability is not from 0 to 1.

    Reference:
        This project's.

    Example:
        >>> import numpy as np
        >>> from torchrl_hmcts.envs import OccasionalAction, RepeatActions
        >>> worker = OccasionalAction(RepeatActions([3]), action=1, probability=0.5)
        >>> draws = np.random.default_rng(0)
        >>> [worker.act(None, 0, draws) for _ in range(6)]
        [3, 1, 1, 1, 3, 3]
    """

    def __init__(self, worker: OptionWorker, action: int, probability: float = 0.05) -> None:
        if not 0.0 <= probability <= 1.0:
            raise ValueError(
                f"OccasionalAction needs a probability from 0 to 1; got {probability}."
            )
        self.worker, self.action, self.probability = worker, int(action), float(probability)
        self.num_options = worker.num_options

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> int:
        """Return the action, or the worker's."""
        if generator.random() < self.probability:
            return self.action
        return self.worker.act(observation, option, generator)

    def begin(self, observation: Any, option: int) -> None:
        """Tell the worker that an option begins."""
        _begin(self.worker, observation, option)

    def ends(self, observation: Any, option: int, steps: int) -> bool:
        """Return whether the worker ends the option; never, if it cannot."""
        return _ends(self.worker, observation, option, steps)


class JoinedWorkers:
    """The options of several workers, one after the other.

    Args:
        workers (sequence of OptionWorker): e.g. goals and actions to repeat.

    Raises:
        ValueError: if there is no worker.

    Reference:
        This project's.

    Example:
        >>> from torchrl_hmcts.envs import JoinedWorkers, RepeatActions
        >>> joined = JoinedWorkers([RepeatActions([3]), RepeatActions([0, 5])])
        >>> joined.num_options, joined.act(None, 2, None)
        (3, 5)
    """

    def __init__(self, workers: Sequence[OptionWorker]) -> None:
        if not workers:
            raise ValueError("JoinedWorkers needs at least one worker; got none.")
        self.workers = tuple(workers)
        self._whose = [(w, option) for w in self.workers for option in range(w.num_options)]
        self.num_options = len(self._whose)

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> int:
        """Return the action of the worker whose option it is."""
        worker, own = self._whose[option]
        return worker.act(observation, own, generator)

    def begin(self, observation: Any, option: int) -> None:
        """Tell the worker whose option it is that it begins."""
        worker, own = self._whose[option]
        _begin(worker, observation, own)

    def ends(self, observation: Any, option: int, steps: int) -> bool:
        """Return whether the worker whose option it is ends it; never, if it cannot."""
        worker, own = self._whose[option]
        return _ends(worker, observation, own, steps)
