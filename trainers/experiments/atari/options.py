"""Options that a source has found, as objects and as plain data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

from tensordict import TensorDictBase

from torchrl_hmcts.envs import (
    AtariOptionPool,
    ByteGoal,
    FollowGoals,
    JoinedWorkers,
    OccasionalAction,
    OptionWorker,
    RepeatActions,
    SharedMLP,
)
from torchrl_hmcts.objectives import DiscreteSkillSACLoss

MakePool = Callable[..., AtariOptionPool]
"""``make_pool(worker, max_steps)``; sources that record what is simulated add ``record=True``."""


@dataclass
class Training:
    """What a network worker was trained with.

    Attributes:
        loss: with the live parameters of actor, critics and objective.
        data: transitions ``[n]`` it was trained on.
        bytes_seen: bytes of RAM whose displacement the objective reads; None if it reads the state.
    """

    loss: DiscreteSkillSACLoss
    data: TensorDictBase
    bytes_seen: list[int] | None = None


@dataclass
class Options:
    """The options a source has found.

    Attributes:
        worker: carries them out.
        names: one for each.
        num_frames: frames emulated to find them.
        report: what was found on the way, as plain data.
        saved: from which :func:`load_options` builds the worker again: plain data and tensors.
        training: what a learned worker was trained with, for who trains it further; not saved.

    Example:
        >>> from torchrl_hmcts.envs import RepeatActions
        >>> Options(RepeatActions(2), ["NOOP", "FIRE"], num_frames=0).report
        {}
    """

    worker: OptionWorker
    names: list[str]
    num_frames: int
    report: dict[str, Any] = field(default_factory=dict)
    saved: dict[str, Any] = field(default_factory=dict)
    training: Training | None = field(default=None, repr=False, compare=False)


class WorkerSource(Protocol):
    """What gives a game its options: ``find(game, make_pool, seed=..., log=...)``.

    Example:
        >>> from torchrl_hmcts.envs import RepeatActions
        >>> from torchrl_hmcts.trainers import DistilledSource, Options
        >>> class LeftAndRight:
        ...     def find(self, game, make_pool, *, seed, log):
        ...         return Options(RepeatActions([2, 3]), ["right", "left"], num_frames=0)
        >>> DistilledSource(LeftAndRight()).samples
        20000
    """

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        ...


def plain_worker(worker: Any) -> dict[str, Any]:
    """Return a worker as plain data and tensors, which :func:`load_options` reads.

    Args:
        worker: repeated actions, goals or a network.

    Raises:
        TypeError: if it is of another kind.
    """
    if isinstance(worker, RepeatActions):
        return {"kind": "repeat", "actions": list(worker.actions)}
    if isinstance(worker, FollowGoals):
        goals = [asdict(goal) for goal in worker.goals]
        return {
            "kind": "goals",
            "goals": goals,
            "fire": worker.fire,
            "fire_probability": worker.fire_probability,
        }
    if isinstance(worker, SharedMLP):
        return {
            "kind": "network",
            "num_options": worker.num_options,
            "num_actions": worker.num_actions,
            "hidden": list(worker.sizes[1:]),
            "weights": worker.weights.clone(),
        }
    if isinstance(worker, OccasionalAction):
        return {
            "kind": "occasional",
            "action": worker.action,
            "probability": worker.probability,
            "worker": plain_worker(worker.worker),
        }
    if isinstance(worker, JoinedWorkers):
        return {"kind": "joined", "parts": [plain_worker(w) for w in worker.workers]}
    raise TypeError(f"{type(worker).__name__} cannot be saved as plain data.")


def load_options(saved: dict[str, Any]) -> OptionWorker:
    """Build a worker from what an :class:`Options` keeps in ``saved``.

    Args:
        saved: plain data and tensors.

    Raises:
        ValueError: if a part is of no known kind.

    Example:
        >>> from torchrl_hmcts.trainers import load_options
        >>> load_options({"parts": [{"kind": "repeat", "actions": [0, 3]}]}).num_options
        2
    """
    workers = [_load(part) for part in saved["parts"]]
    return workers[0] if len(workers) == 1 else JoinedWorkers(workers)


def _load(part: dict[str, Any]) -> OptionWorker:
    kind = part["kind"]
    if kind == "repeat":
        return RepeatActions(part["actions"])
    if kind == "goals":
        goals = [ByteGoal(**goal) for goal in part["goals"]]
        return FollowGoals(goals, fire=part["fire"], fire_probability=part["fire_probability"])
    if kind == "network":
        worker = SharedMLP(part["num_options"], part["num_actions"], hidden=part["hidden"])
        worker.weights.copy_(part["weights"])
        return worker
    if kind == "occasional":
        return OccasionalAction(_load(part["worker"]), part["action"], part["probability"])
    if kind == "joined":
        return JoinedWorkers([_load(p) for p in part["parts"]])
    raise ValueError(f"Options of the kind {kind!r} are not known.")
