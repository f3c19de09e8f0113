"""What a manager of subgoals is asked, and what it may answer.

Letters: m states to plan from, L goals of the longest plan, G goals kept, D coordinates of a goal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor


@runtime_checkable
class PlansGoals(Protocol):
    """What :class:`SubgoalTransform` asks of a manager; a plain function of the same form will do.

    An attribute ``in_keys`` is optional: the entries the manager reads. With it only those are
    handed over.

    Example:
        >>> import torch
        >>> class ToTheRight:
        ...     def plan_goals(self, tensordict):
        ...         goals = tensordict["position"].unsqueeze(1) + torch.tensor([1.0, 0.0])
        ...         return goals, torch.ones(len(tensordict), dtype=torch.int64)
        >>> from torchrl_hmcts.transforms import PlansGoals
        >>> isinstance(ToTheRight(), PlansGoals)
        True
    """

    def plan_goals(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return goals ``[m, L, D]`` and how many of them each plan has, int64 ``[m]``, at least 1.

        ``tensordict`` (batch ``[m]``) holds the states to plan from. ``L`` is any number, other in
        each call; what stands behind the end of a plan is ignored.
        """


GoalPlan = Callable[[TensorDictBase], tuple[Tensor, Tensor]]


def ask_for_goals(
    plan_goals: GoalPlan,
    tensordict: TensorDictBase,
    rows: np.ndarray,
    *,
    in_keys: Sequence[NestedKey] | None,
    position_key: NestedKey,
    max_goals: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Ask a manager for plans from some elements of a tensordict, and check its answer.

    Args:
        plan_goals (callable): the manager.
        tensordict (TensorDictBase): states, any batch shape.
        rows (array): int64 ``[m]``, which of its elements, counted in row-major order.
        in_keys (sequence of NestedKey, optional): entries to hand over; all by default.
        position_key (NestedKey): entry with as many coordinates as a goal.
        max_goals (int): G.

    Returns:
        the goals, float32 ``[m, G, D]``, cut after G, or with the last one repeated up to G, and
        the lengths, int64 ``[m]``.

    Raises:
        ValueError: if a plan has no goal, the wrong shape or a value that is not finite.
    """
    td = tensordict if in_keys is None else tensordict.select(*in_keys)
    td = td.reshape(-1) if len(td.batch_size) != 1 else td
    if len(rows) != len(td):
        td = td[torch.from_numpy(rows)]
    with torch.no_grad():
        goals, lengths = plan_goals(td)
    path = goals.numpy(force=True).astype(np.float32, copy=False)
    length = lengths.numpy(force=True).astype(np.int64, copy=False)
    dims = tensordict.get(position_key).shape[-1]
    if path.ndim != 3 or path.shape[::2] != (len(rows), dims) or length.shape != (len(rows),):
        raise ValueError(
            f"The planner returned goals {list(path.shape)} and lengths {list(length.shape)} for "
            f"{len(rows)} states with positions of {dims} coordinates; it must return goals "
            f"[{len(rows)}, any, {dims}] and lengths [{len(rows)}]."
        )
    bad = (length < 1) | (length > path.shape[1])
    if bad.any():
        at = tensordict.get(position_key).reshape(-1, dims)[int(rows[bad.argmax()])].tolist()
        raise ValueError(
            f"The planner returned a plan of {length[bad][0]} goals, in an array of "
            f"{path.shape[1]}, from {position_key!r} = {at}; a plan needs at least one. If it "
            f"found none, give the search more budget, or return a goal to explore."
        )
    length = np.minimum(length, max_goals)
    column = np.minimum(np.arange(max_goals), length[:, None] - 1)
    path = path[np.arange(len(rows))[:, None], column]
    if not np.isfinite(path).all():
        raise ValueError(
            f"The planner returned a goal of {path[~np.isfinite(path)][0]}. Goals must be finite, "
            f"in the units of {position_key!r}."
        )
    return path, length
