"""Subgoals of a manager's plan, and the worker's reward for reaching them.

Letters: *B batch of the tensordict, m its elements in one dimension, L goals of a manager's longest
plan, G goals kept, K goals that the worker is shown, D coordinates of a goal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from torchrl_hmcts.checks import nested_key, real_number, whole_number
from torchrl_hmcts.direct_calls import put
from torchrl_hmcts.nesting import parts
from torchrl_hmcts.transforms.env_transform import EnvTransform, count_spec

# Entries of one number per element: of the plan, and the counters of the episode.
_NUMBERS = ("plan_length", "goal_index", "num_plans", "num_goals_met", "num_divergences")


@runtime_checkable
class PlansGoals(Protocol):
    """Protocol of a manager for :class:`SubgoalTransform`; a plain function will do, too.

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

        ``tensordict`` (batch ``[m]``) holds the states to plan from. ``L`` may differ from call to
        call; goals behind the end of a plan are ignored.
        """


GoalPlan = Callable[[TensorDictBase], tuple[Tensor, Tensor]]


class SubgoalTransform(EnvTransform):
    r"""Leads a worker along the subgoals of a manager's plan and rewards it for reaching them.

    A plan :math:`g_0, \dots, g_n` is made at reset. After each base step, with :math:`g` the goal
    that was current while it was taken, :math:`x` where it led to and
    :math:`d = \lVert x - g \rVert`,

    .. math::

        r = r_\text{tick} + r_\text{met}\,[d < d_\text{met}] + r_\text{div}\,[d > d_\text{div}]

    A goal that is met makes way for the next one. Where :math:`d > d_\text{div}`, and where the
    last goal is met though the episode continues, a new plan is made from :math:`x`. All elements
    of a batch that need a plan at the same base step get it in one call.

    It writes, in the root and under ``"next"``, ``goals_key`` (float32 ``[*B, K D]``, the next K
    goals, the last one repeated), ``plan_key`` (float32 ``[*B, G, D]``), ``"plan_length"``,
    ``"goal_index"`` and the counters of the episode ``"num_plans"``, ``"num_goals_met"`` and
    ``"num_divergences"`` (int64 ``[*B, 1]``). They are part of the state: ``reset(td,
    set_state=True)`` to a state that holds a plan keeps it. Under ``"next"`` the worker's reward
    takes the place of the env's own, which moves to ``task_reward_key``.

    Args:
        planner (PlansGoals or callable): the manager. ``planner(td [m]) -> (goals [m, L, D],
            lengths [m])``, or an object with a method ``plan_goals`` of that form, e.g.
            :class:`~torchrl_hmcts.planners.GoalPlanner`.
        position_key (NestedKey): entry ``[*B, D]`` that is compared with the goals.
        goal_met_threshold (float): :math:`d_\text{met}`, in the units of the position. Default 0.5:
            half a tile.
        goal_divergence_threshold (float): :math:`d_\text{div}`; larger than the distance of one
            goal to the next. ``math.inf`` never plans again. Default 2 tiles.
        r_tick (float): reward of every base step. Default -0.025: a worker that moves around a
            corner of Waterworld and meets the same goals again earns 0.020 per base step, so with a
            smaller cost it would pay not to arrive.
        r_goal_met, r_goal_divergence (float): the other rewards. Default 1 and -1.
        num_goals (int): K. Default 3.
        max_goals (int): G; a longer plan is cut, and a new plan follows when its last goal is met.
        relative (bool): show goals relative to the position (default), so that what the worker
            learns in one place holds in all, or as they are.
        goals_key, plan_key (NestedKey): what is shown, and the whole plan.
        reward_key (NestedKey): the env's reward, which becomes the worker's.
        task_reward_key (NestedKey): where the env's reward goes.

    Raises:
        TypeError: if ``planner`` is neither.
        ValueError: when planning, if a plan has no goal, the wrong shape or a value that is not
            finite.
        KeyError: when the specs are made, if the env lacks ``position_key`` or ``reward_key``.

    Reference:
        Dissertation, section 3.2.1 and algorithm 1. That goals are popped when met, and r_tick,
        are this project's reading.

    Examples:
        >>> import torch
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_hmcts.testing import PointMassEnv
        >>> from torchrl_hmcts.transforms import SubgoalTransform
        >>> def to_the_right(td):  # two goals, 1 and 2 away
        ...     away = torch.tensor([[1.0, 0.0], [2.0, 0.0]])
        ...     return td["position"].unsqueeze(1) + away, torch.full((len(td),), 2)
        >>> env = TransformedEnv(PointMassEnv(), SubgoalTransform(to_the_right, num_goals=2))
        >>> td = env.step(env.reset().set("action", torch.tensor(3)))  # push to the right
        >>> td["next", "goals"], td["next", "reward"]
        (tensor([0.9900, 0.0000, 1.9900, 0.0000]), tensor([-0.0250]))
    """

    def __init__(
        self,
        planner: PlansGoals | GoalPlan,
        *,
        position_key: NestedKey = "position",
        goal_met_threshold: float = 0.5,
        goal_divergence_threshold: float = 2.0,
        r_tick: float = -0.025,
        r_goal_met: float = 1.0,
        r_goal_divergence: float = -1.0,
        num_goals: int = 3,
        max_goals: int = 64,
        relative: bool = True,
        goals_key: NestedKey = "goals",
        plan_key: NestedKey = "plan",
        reward_key: NestedKey = "reward",
        task_reward_key: NestedKey = "task_reward",
    ) -> None:
        def key(name: str, value: NestedKey) -> NestedKey:
            return nested_key("SubgoalTransform", name, value)

        def number(name: str, value: float, **bounds: Any) -> float:
            return real_number("SubgoalTransform", name, value, **bounds)

        plan_goals = getattr(planner, "plan_goals", planner)
        if not callable(plan_goals):
            raise TypeError(
                "SubgoalTransform needs a planner: a callable planner(td) -> (goals, lengths) or "
                f"an object with a method plan_goals(td) like it; got {type(planner).__name__}."
            )
        self.position_key = key("position_key", position_key)
        self.goals_key = key("goals_key", goals_key)
        self.plan_key = key("plan_key", plan_key)
        self.reward_key = key("reward_key", reward_key)
        self.task_reward_key = key("task_reward_key", task_reward_key)
        super().__init__(
            in_keys=[self.position_key, self.reward_key],
            out_keys=[self.goals_key, self.plan_key, self.task_reward_key, *_NUMBERS],
        )
        # Past nn.Module.__setattr__: a manager's modules are not to be saved with the env.
        self.__dict__["planner"] = planner
        self.__dict__["_ask"] = plan_goals
        self._read = getattr(planner, "in_keys", None)
        self.goal_met_threshold = met = number("goal_met_threshold", goal_met_threshold, above=0.0)
        self.goal_divergence_threshold = number(
            "goal_divergence_threshold > goal_met_threshold",
            goal_divergence_threshold,
            above=met,
            finite=False,
        )
        self.r_tick = number("r_tick", r_tick)
        self.r_goal_met = number("r_goal_met", r_goal_met)
        self.r_goal_divergence = number("r_goal_divergence", r_goal_divergence, most=0.0)
        self.num_goals = whole_number("SubgoalTransform", "num_goals", num_goals, least=1)
        self.max_goals = whole_number("SubgoalTransform", "max_goals", max_goals, least=1)
        self.relative = relative
        self._ahead = np.arange(self.num_goals)

    def _plan(self, tensordict: TensorDictBase, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ask the manager for plans from some elements, counted in row-major order.

        Return the goals ``[m, G, D]``, the last one repeated to the end, and the lengths ``[m]``.
        """
        td = tensordict if self._read is None else tensordict.select(*self._read)
        td = td.reshape(-1) if len(td.batch_size) != 1 else td
        if len(rows) != len(td):
            td = td[torch.from_numpy(rows)]
        with torch.no_grad():
            goals, lengths = self.__dict__["_ask"](td)
        path = goals.numpy(force=True).astype(np.float32, copy=False)
        length = lengths.numpy(force=True).astype(np.int64, copy=False)
        m, dims = len(rows), tensordict.get(self.position_key).shape[-1]
        if path.ndim != 3 or path.shape[::2] != (m, dims) or length.shape != (m,):
            raise ValueError(
                f"The planner returned goals {list(path.shape)} and lengths {list(length.shape)} "
                f"for {m} states with positions of {dims} coordinates; it must return goals "
                f"[{m}, any, {dims}] and lengths [{m}]."
            )
        bad = (length < 1) | (length > path.shape[1])
        if bad.any():
            at = _rows(tensordict.get(self.position_key))[rows[bad.argmax()]].tolist()
            raise ValueError(
                f"The planner returned a plan of {length[bad][0]} goals, in an array of "
                f"{path.shape[1]}, from {self.position_key!r} = {at}; a plan needs at least one. "
                "If it found none, give the search more budget, or return a goal to explore."
            )
        length = np.minimum(length, self.max_goals)
        path = path[np.arange(m)[:, None], _within(np.arange(self.max_goals), length)]
        if not np.isfinite(path).all():
            raise ValueError(
                f"The planner returned a goal of {path[~np.isfinite(path)][0]}. Goals must be "
                f"finite, in the units of {self.position_key!r}."
            )
        return path, length

    def _shown(
        self, path: np.ndarray, length: np.ndarray, index: np.ndarray, position: np.ndarray
    ) -> np.ndarray:
        """Return the next K goals, ``[m, K, D]``."""
        ahead = _within(index[:, None] + self._ahead, length)
        shown: np.ndarray = path[np.arange(len(path))[:, None], ahead]
        if self.relative:
            shown -= position[:, None]
        return shown

    def _write(
        self,
        td: TensorDictBase,
        entries: dict[NestedKey, np.ndarray],
        numbers: Iterable[np.ndarray],
    ) -> TensorDictBase:
        """Write arrays of ``[m, ...]`` and the numbers ``[m]``, in the shape of a tensordict."""
        for key, array in (*entries.items(), *zip(_NUMBERS, numbers, strict=True)):
            array = array.reshape(*td.batch_size, *(array.shape[1:] or (1,)))
            tensor = torch.from_numpy(array)
            put(td, key, tensor if td.device is None else tensor.to(td.device))
        return td

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        position = _rows(tensordict_reset.get(self.position_key))
        m, dims = position.shape
        fresh = self._needs_plan(tensordict, tensordict_reset)
        old = tensordict.get(self.plan_key, None)
        if old is None or fresh.all():
            path = np.zeros((m, self.max_goals, dims), np.float32)
            numbers = np.zeros((5, m), np.int64)
            numbers[0] = 1
        else:
            path = old.numpy(force=True).reshape(m, self.max_goals, dims).copy()
            numbers = np.stack([_numbers(tensordict, key, m) for key in _NUMBERS])
        rows = np.flatnonzero(fresh)
        if len(rows):
            path[rows], numbers[0, rows] = self._plan(tensordict_reset, rows)
            numbers[1:, rows] = 0
            numbers[2, rows] = 1
        shown = self._shown(path, numbers[0], numbers[1], position).reshape(m, -1)
        return self._write(tensordict_reset, {self.plan_key: path, self.goals_key: shown}, numbers)

    def _needs_plan(self, before: TensorDictBase, after: TensorDictBase) -> np.ndarray:
        """Return which elements a reset gives a new plan, bool ``[m]``."""
        m = after.numel()
        given = set(map(unravel_key, before.keys(True, True)))
        masks = [before.get(key) for key in given if parts(key)[-1] == "_reset"]
        if masks:
            return np.logical_or.reduce([_any(mask, m) for mask in masks])
        mine = {self.plan_key, self.goals_key, *_NUMBERS}
        state = set(map(unravel_key, self.parent.full_state_spec.keys(True, True))) - mine
        if not state or not {self.plan_key, *_NUMBERS, *state} <= given:
            return np.ones(m, np.bool_)
        # The plan is for the state it was made in: one that the reset did not set needs another.
        return np.logical_or.reduce([_any(before.get(k) != after.get(k), m) for k in state])

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        plan = tensordict[self.plan_key]
        position = _rows(next_tensordict.get(self.position_key))
        m, dims = position.shape
        # Small arrays: numpy does in one microsecond what torch does in three.
        path = plan.numpy(force=True).reshape(m, self.max_goals, dims)
        length, index, *counters = (_numbers(tensordict, key, m) for key in _NUMBERS)
        offset = position - path[np.arange(m), index]
        distance = np.sqrt(np.einsum("md,md->m", offset, offset))
        met = distance < self.goal_met_threshold
        diverged = distance > self.goal_divergence_threshold
        reward = self.r_tick + self.r_goal_met * met + self.r_goal_divergence * diverged
        stepped = tensordict.get("_step", None)
        if stepped is not None:  # the env below did not step all: what others hold is no state
            moved = _any(stepped, m)
            met, diverged, reward = met & moved, diverged & moved, reward * moved
        index = index + met
        replan = diverged | (index >= length)
        index = np.minimum(index, length - 1)
        if replan.any():
            replan &= ~_any(next_tensordict.get(self._terminated_key), m)
            rows = np.flatnonzero(replan)
            if len(rows):
                path, length = path.copy(), length.copy()
                path[rows], length[rows] = self._plan(next_tensordict, rows)
                index[rows] = 0
                plan = torch.from_numpy(path.reshape(plan.shape)).to(plan.device)
        shown = self._shown(path, length, index, position).reshape(m, -1)
        put(next_tensordict, self.task_reward_key, next_tensordict.get(self.reward_key))
        put(next_tensordict, self.plan_key, plan)
        counted = [
            count + new for count, new in zip(counters, (replan, met, diverged), strict=True)
        ]
        entries = {self.reward_key: reward.astype(np.float32), self.goals_key: shown}
        return self._write(next_tensordict, entries, (length, index, *counted))

    def _add_specs(self, spec: Composite, position: TensorSpec) -> Composite:
        shape, device, dims = spec.shape, spec.device, position.shape[-1]
        spec[self.plan_key] = Unbounded(
            (*shape, self.max_goals, dims), dtype=torch.float32, device=device
        )
        for key in _NUMBERS:
            spec[key] = count_spec(spec)
        for key, high in (("plan_length", 0), ("goal_index", -1)):
            high += self.max_goals
            spec[key] = Bounded(0, high, shape=(*shape, 1), dtype=torch.int64, device=device)
        return spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        self._require(observation_spec.keys(True, True), self.position_key)
        position = observation_spec[self.position_key]
        observation_spec[self.goals_key] = Unbounded(
            (*observation_spec.shape, self.num_goals * position.shape[-1]),
            dtype=torch.float32,
            device=observation_spec.device,
        )
        return self._add_specs(observation_spec, position)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        return self._add_specs(state_spec, self.parent.full_observation_spec[self.position_key])

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        self._require(reward_spec.keys(True, True), self.reward_key)
        task = reward_spec[self.reward_key]
        reward_spec[self.task_reward_key] = task.clone()
        reward_spec[self.reward_key] = Unbounded(
            task.shape, dtype=torch.float32, device=task.device
        )
        return reward_spec

    @property
    def _terminated_key(self) -> NestedKey:
        keys = list(map(unravel_key, self.parent.done_keys))
        return next((key for key in keys if parts(key)[-1] == "terminated"), keys[0])


def _rows(value: Tensor) -> np.ndarray:
    """The vectors of an entry as rows, ``[m, D]``."""
    return value.numpy(force=True).reshape(-1, value.shape[-1])


def _numbers(tensordict: TensorDictBase, key: NestedKey, m: int) -> np.ndarray:
    """An entry of one number per element, ``[m]``; zeros where the tensordict has none."""
    value = tensordict.get(key, None)
    return np.zeros(m, np.int64) if value is None else value.numpy(force=True).reshape(m)


def _any(value: Tensor, m: int) -> np.ndarray:
    """Return in which elements an entry is true anywhere, bool ``[m]``."""
    return np.asarray(value.numpy(force=True).reshape(m, -1).any(-1))


def _within(index: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return indices ``[m, K]`` into plans, at most the last goal of each."""
    return np.minimum(index, length[:, None] - 1)
