"""Options that a source has found, as objects and as plain data."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

from tensordict import TensorDictBase

from torchrl_hmcts.envs import (
    ByteGoal,
    FollowGoals,
    JoinedWorkers,
    OccasionalAction,
    OptionWorker,
    RepeatActions,
    SharedMLP,
)
from torchrl_hmcts.objectives import DiscreteSkillSACLoss
from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit


@dataclass
class Training:
    """Training data of a network worker: the live loss, transitions ``[n]`` of its data, the bytes
    whose displacement its objective reads (None if it reads the state), and how many samples it has
    learned from."""

    loss: DiscreteSkillSACLoss
    data: TensorDictBase
    bytes_seen: list[int] | None = None
    samples: int = 0


@dataclass
class Options:
    """The options that a source has found.

    Attributes:
        worker: executes them.
        names: one for each.
        num_frames: frames emulated to find them.
        report: what was found on the way, as plain data.
        teacher: whose options a network has learned; for who trains it further, not saved.
        training: what a network was trained with; the same.

    Example:
        >>> from torchrl_hmcts.envs import RepeatActions
        >>> from torchrl_hmcts.trainers import Options
        >>> found = Options(RepeatActions(2), ["NOOP", "FIRE"], num_frames=0)
        >>> Options.from_plain(found.plain()).worker.num_options
        2
    """

    worker: OptionWorker
    names: list[str]
    num_frames: int
    report: dict[str, Any] = field(default_factory=dict)
    teacher: OptionWorker | None = field(default=None, repr=False, compare=False)
    training: Training | None = field(default=None, repr=False, compare=False)

    def plain(self) -> dict[str, Any]:
        """Return the options as plain data and tensors, without their training data.

        Raises:
            TypeError: if the worker is of a kind of your own.
        """
        plain = {name: getattr(self, name) for name in ("names", "num_frames", "report")}
        return {**plain, "saved": {"parts": [plain_worker(self.worker)]}}

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> Options:
        """Build options from plain data.

        Args:
            plain: as :meth:`plain` returned it, in this version or an older one.

        Raises:
            ValueError: if a part of the worker is of no known kind.
        """
        workers = [load_worker(part) for part in plain["saved"]["parts"]]
        worker = workers[0] if len(workers) == 1 else JoinedWorkers(workers)
        return cls(worker, plain["names"], plain["num_frames"], plain["report"])


class OptionSource(Protocol):
    """Protocol of what gives a game its options, e.g. a :class:`RuleSource` or one of your own."""

    def find(self, kit: AtariKit) -> Options:
        """Return the options of a game."""
        ...


def plain_worker(worker: Any) -> dict[str, Any]:
    """Return a worker as plain data and tensors, or raise ``TypeError`` for an unknown kind."""
    if isinstance(worker, RepeatActions):
        return {"kind": "repeat", "actions": list(worker.actions)}
    if isinstance(worker, FollowGoals):
        return {"kind": "goals", "goals": [asdict(goal) for goal in worker.goals]}
    if isinstance(worker, SharedMLP):
        return {
            "kind": "network",
            "num_options": worker.num_options,
            "num_actions": worker.num_actions,
            "hidden": list(worker.sizes[1:]),
            "weights": worker.weights.clone(),
        }
    if isinstance(worker, OccasionalAction):
        rest = {"action": worker.action, "probability": worker.probability}
        return {"kind": "occasional", **rest, "worker": plain_worker(worker.worker)}
    if isinstance(worker, JoinedWorkers):
        return {"kind": "joined", "parts": [plain_worker(part) for part in worker.workers]}
    raise TypeError(f"{type(worker).__name__} cannot be saved as plain data.")


def load_worker(part: dict[str, Any]) -> OptionWorker:
    """Build a worker from plain data and tensors."""
    kind = part["kind"]
    if kind == "repeat":
        return RepeatActions(part["actions"])
    if kind == "goals":
        goals = FollowGoals([ByteGoal(**goal) for goal in part["goals"]])
        if part.get("fire") is None:
            return goals
        return OccasionalAction(goals, part["fire"], part["fire_probability"])  # an older folder's
    if kind == "network":
        worker = SharedMLP(part["num_options"], part["num_actions"], hidden=part["hidden"])
        worker.weights.copy_(part["weights"])
        return worker
    if kind == "occasional":
        return OccasionalAction(load_worker(part["worker"]), part["action"], part["probability"])
    if kind == "joined":
        return JoinedWorkers([load_worker(p) for p in part["parts"]])
    raise ValueError(f"Unknown kind of options: {kind!r}.")


def has_network(worker: Any) -> bool:
    """Return True if a network executes one of a worker's options, False if rules do all."""
    parts = getattr(worker, "workers", [getattr(worker, "worker", None)])
    return isinstance(worker, SharedMLP) or any(has_network(p) for p in parts if p is not None)


def network_of(worker: OptionWorker) -> SharedMLP:
    """Return the network that executes a worker's options, interrupted or not."""
    inner = worker.worker if isinstance(worker, OccasionalAction) else worker
    if not isinstance(inner, SharedMLP):
        raise TypeError(
            f"Only a network can be trained further; these options are executed by "
            f"{type(inner).__name__}. Wrap their source: TrainedSource('distilled', source)."
        )
    return inner


def goals_of(worker: OptionWorker) -> list[ByteGoal | int]:
    """Return what each option of a rule worker is for: a goal, or the action it repeats."""
    if isinstance(worker, JoinedWorkers):
        return [goal for part in worker.workers for goal in goals_of(part)]
    if isinstance(worker, OccasionalAction):
        return goals_of(worker.worker)
    if isinstance(worker, FollowGoals):
        return list(worker.goals)
    if isinstance(worker, RepeatActions):
        return list(worker.actions)
    raise TypeError(
        f"The purpose of the options of a {type(worker).__name__} is unknown. That of goals and "
        "repeated actions is known: use a RuleSource under TrainedSource('distilled', ...)."
    )
