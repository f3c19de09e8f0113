"""Options as goals on bytes of the RAM: bring one byte to another plus an offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_hmcts.envs.gym.option_run import OptionWorker


@dataclass(frozen=True)
class ByteGoal:
    r"""Bring byte c to byte b plus an offset o.

    .. math:: a = \begin{cases}
        \text{raise} & x_c - x_b - o < -\delta \\ \text{lower} & x_c - x_b - o > \delta \\
        \text{stay} & \text{otherwise} \end{cases}

    Attributes:
        controlled: c, a byte that actions move.
        target: b, a byte that moves.
        offset: o.
        raising, lowering, staying: index of the action that raises c, lowers it, leaves it.
        dead_zone: :math:`\delta`, within which nothing is to be done.

    Reference:
        This project's; goals of a worker as in chapter 3 of the dissertation.

    Example:
        >>> import numpy as np
        >>> goal = ByteGoal(controlled=72, target=99, offset=-12, raising=2, lowering=3)
        >>> ram = np.zeros(128, np.uint8)
        >>> ram[72], ram[99] = 100, 120
        >>> goal.action(ram)  # 100 is below 120 - 12
        2
    """

    controlled: int
    target: int
    offset: int
    raising: int
    lowering: int
    staying: int = 0
    dead_zone: int = 3

    def action(self, ram: np.ndarray) -> int:
        """Return the index of the action, seeing the RAM, uint8 ``[128]``."""
        missing = int(ram[self.controlled]) - int(ram[self.target]) - self.offset
        if missing < -self.dead_zone:
            return self.raising
        return self.lowering if missing > self.dead_zone else self.staying


class FollowGoals:
    """Options that are goals, executed by rule.

    Args:
        goals (sequence of ByteGoal): one for each option.
        fire (int, optional): index of an action that is taken now and then with any goal, since
            games wait for it, e.g. to serve. Default: none.
        fire_probability (float): how often. Default 0.05.

    Raises:
        ValueError: if there is no goal, a byte is none of the RAM, or the probability is out of
            range.

    Reference:
        This project's; goals of a worker as in chapter 3 of the dissertation.

    Example:
        >>> from torchrl_hmcts.envs import ByteGoal, FollowGoals
        >>> FollowGoals([ByteGoal(72, 99, o, 2, 3) for o in (-12, 0, 12)]).num_options
        3
    """

    def __init__(
        self,
        goals: Sequence[ByteGoal],
        *,
        fire: int | None = None,
        fire_probability: float = 0.05,
    ) -> None:
        self.goals = tuple(goals)
        if not self.goals:
            raise ValueError("FollowGoals needs a goal for each option; got none.")
        for goal in self.goals:
            if not (0 <= goal.controlled < 128 and 0 <= goal.target < 128):
                raise ValueError(f"The RAM has the bytes 0 to 127; got {goal}.")
        if not 0.0 <= fire_probability <= 1.0:
            raise ValueError(
                f"FollowGoals needs fire_probability from 0 to 1; got {fire_probability}."
            )
        self.num_options = len(self.goals)
        self.fire, self.fire_probability = fire, fire_probability

    def act(self, ram: np.ndarray, option: int, generator: np.random.Generator) -> int:
        """Return the action that brings the option's goal nearer."""
        if self.fire is not None and generator.random() < self.fire_probability:
            return self.fire
        return self.goals[option].action(ram)


class OccasionalAction:
    """Another worker's options, with one action taken now and then.

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
        >>> [worker.act(np.zeros(128, np.uint8), 0, draws) for _ in range(6)]
        [3, 1, 1, 1, 3, 3]
    """

    def __init__(self, worker: OptionWorker, action: int, probability: float = 0.05) -> None:
        if not 0.0 <= probability <= 1.0:
            raise ValueError(
                f"OccasionalAction needs a probability from 0 to 1; got {probability}."
            )
        self.worker, self.action, self.probability = worker, int(action), float(probability)
        self.num_options = worker.num_options

    def act(self, ram: np.ndarray, option: int, generator: np.random.Generator) -> int:
        """Return the action, or what the worker does."""
        if generator.random() < self.probability:
            return self.action
        return self.worker.act(ram, option, generator)

    def ends(self, ram: np.ndarray, option: int, steps: int) -> bool:
        """Return whether the worker ends the option; never, if it cannot."""
        ends: Any = getattr(self.worker, "ends", None)
        return False if ends is None else bool(ends(ram, option, steps))


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

    def act(self, ram: np.ndarray, option: int, generator: np.random.Generator) -> int:
        """Return the action of the worker whose option it is."""
        worker, own = self._whose[option]
        return worker.act(ram, own, generator)

    def ends(self, ram: np.ndarray, option: int, steps: int) -> bool:
        """Return whether the worker whose option it is ends it; never, if it cannot."""
        worker, own = self._whose[option]
        ends: Any = getattr(worker, "ends", None)
        return False if ends is None else bool(ends(ram, own, steps))
