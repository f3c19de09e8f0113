"""Subgoals of a manager's plan, and the worker's reward for reaching them.

Letters: *B batch of the tensordict, m its elements in one dimension, G goals of the longest plan, K
goals that the worker is shown, D coordinates of a goal.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from torchrl_hmcts.transforms.goal_plans import GoalPlan, PlansGoals, ask_for_goals


class SubgoalTransform(Transform):
    r"""Leads a worker along the subgoals of a manager's plan and rewards it for reaching them.

    A plan :math:`g_0, \dots, g_n` is made at reset. After each base step, with :math:`g` the goal
    that was current while it was taken, :math:`x` where it led to and
    :math:`d = \lVert x - g \rVert`,

    .. math::

        r = r_\text{tick} + r_\text{met}\,[d < d_\text{met}] + r_\text{div}\,[d > d_\text{div}]

    A goal that is met makes way for the next one. Where :math:`d > d_\text{div}`, and where the
    last goal is met though the episode goes on, a new plan is made from :math:`x` before the next
    action. All elements of a batch that need a plan at the same base step get it in one call.

    Writes, in the root and under ``"next"`` (all of it state: the env stays stateless and goes on
    from any tensordict): ``goals_key`` (float32 ``[*B, K D]``, the next K goals, the last one
    repeated), ``"plan"`` (float32 ``[*B, G, D]``), ``"plan_length"`` and ``"goal_index"`` (int64
    ``[*B, 1]``), and the counters of the episode ``"num_plans"``, ``"num_goals_met"`` and
    ``"num_divergences"`` (int64 ``[*B, 1]``). Under ``"next"`` also the worker's reward, in place
    of the env's own, which moves to ``task_reward_key``.

    A reset plans where it resets. ``reset(td, set_state=True)`` to a state that holds a plan keeps
    that plan, to one without a plan makes one.

    Args:
        planner (PlansGoals or callable): the manager. ``planner(td [m]) -> (goals [m, L, D],
            lengths [m])``, or an object with a method ``plan_goals`` of that form, e.g.
            :class:`~torchrl_hmcts.planners.GoalPlanner`.
        position_key (NestedKey): entry ``[*B, D]`` that is compared with the goals. Default
            ``"position"``.
        goal_met_threshold (float): :math:`d_\text{met}`, in the units of the position. Default 0.5:
            half a tile.
        goal_divergence_threshold (float): :math:`d_\text{div}`; must be larger than the distance of
            one goal to the next. ``math.inf`` never plans again. Default 2 tiles.
        r_tick (float): reward of every base step. The source gives no number. Default -0.025:
            going to and fro around a corner of Waterworld, where a plan pays for the same goals
            again, earns 0.020 per base step before it, so that with a smaller one it would pay not
            to arrive.
        r_goal_met (float): Default 1.
        r_goal_divergence (float): Default -1.
        num_goals (int): K. Default 3.
        max_goals (int): G; a longer plan is cut, and goes on from a new plan when its last goal is
            met. Default 64.
        relative (bool): show goals relative to the position (default), so that what the worker
            learns in one place holds in all, or as they are.
        goals_key (NestedKey): the next K goals, ``[*B, K D]``. Default ``"goals"``.
        plan_key (NestedKey): the whole plan, ``[*B, G, D]``. Default ``"plan"``.
        plan_length_key (NestedKey): goals of the plan, int64 ``[*B, 1]``. Default
            ``"plan_length"``.
        goal_index_key (NestedKey): index of the current goal, int64 ``[*B, 1]``. Default
            ``"goal_index"``.
        num_plans_key, num_goals_met_key, num_divergences_key (NestedKey): counts of the episode,
            int64 ``[*B, 1]``. Defaults ``"num_plans"``, ``"num_goals_met"`` and
            ``"num_divergences"``.
        reward_key (NestedKey): the env's reward, which becomes the worker's. Default ``"reward"``.
        task_reward_key (NestedKey): where the env's reward goes. Default ``"task_reward"``.

    Raises:
        TypeError: if ``planner`` is neither.
        ValueError: if a threshold, reward or number is out of range; when planning, if a plan has
            no goal, the wrong shape or a value that is not finite.
        KeyError: when the specs are made, if the env lacks ``position_key`` or ``reward_key``; when
            stepping, if the tensordict has no plan.

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
        >>> td = env.reset()
        >>> td["goals"].round(decimals=3).tolist()
        [1.0, 0.0, 2.0, 0.0]
        >>> td = env.step(td.set("action", torch.tensor(3)))  # push to the right
        >>> td["next", "goals"]
        tensor([0.9900, 0.0000, 1.9900, 0.0000])
        >>> td["next", "reward"], td["next", "num_plans"]
        (tensor([-0.0250]), tensor([1]))
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
        plan_length_key: NestedKey = "plan_length",
        goal_index_key: NestedKey = "goal_index",
        num_plans_key: NestedKey = "num_plans",
        num_goals_met_key: NestedKey = "num_goals_met",
        num_divergences_key: NestedKey = "num_divergences",
        reward_key: NestedKey = "reward",
        task_reward_key: NestedKey = "task_reward",
    ) -> None:
        plan_goals = getattr(planner, "plan_goals", planner)
        if not callable(plan_goals):
            raise TypeError(
                f"SubgoalTransform needs a planner: a callable planner(td) -> (goals, lengths) or "
                f"an object with such a method plan_goals; got {type(planner).__name__}."
            )
        if not 0.0 < goal_met_threshold < goal_divergence_threshold:
            raise ValueError(
                f"SubgoalTransform needs 0 < goal_met_threshold < goal_divergence_threshold, "
                f"distances in units of {position_key!r}; got {goal_met_threshold} and "
                f"{goal_divergence_threshold}. For no divergence pass math.inf."
            )
        for name, value in (
            ("r_tick", r_tick),
            ("r_goal_met", r_goal_met),
            ("r_goal_divergence", r_goal_divergence),
        ):
            if not math.isfinite(value):
                raise ValueError(f"SubgoalTransform needs a finite {name}; got {value}.")
        if r_goal_divergence > 0.0:
            raise ValueError(
                f"r_goal_divergence is added to the reward, a punishment is negative; got "
                f"{r_goal_divergence}. Pass {-r_goal_divergence}."
            )
        for name, number in (("num_goals", num_goals), ("max_goals", max_goals)):
            if number < 1:
                raise ValueError(f"SubgoalTransform needs {name} >= 1; got {number}.")
        self.position_key = unravel_key(position_key)
        self.goals_key = unravel_key(goals_key)
        self.plan_key = unravel_key(plan_key)
        self.plan_length_key = unravel_key(plan_length_key)
        self.goal_index_key = unravel_key(goal_index_key)
        self.counter_keys = [
            unravel_key(key) for key in (num_plans_key, num_goals_met_key, num_divergences_key)
        ]
        # Entries of one number per element.
        self._numbers = [self.plan_length_key, self.goal_index_key, *self.counter_keys]
        self.reward_key = unravel_key(reward_key)
        self.task_reward_key = unravel_key(task_reward_key)
        super().__init__(
            in_keys=[self.position_key, self.reward_key],
            out_keys=[self.goals_key, self.plan_key, self.task_reward_key, *self._numbers],
        )
        # Past nn.Module.__setattr__: a manager's modules are not to be saved with the env.
        self.__dict__["planner"] = planner
        self.__dict__["_plan_goals"] = plan_goals
        self._read = getattr(planner, "in_keys", None)
        self.goal_met_threshold = float(goal_met_threshold)
        self.goal_divergence_threshold = float(goal_divergence_threshold)
        self.r_tick = float(r_tick)
        self.r_goal_met = float(r_goal_met)
        self.r_goal_divergence = float(r_goal_divergence)
        self.num_goals = int(num_goals)
        self.max_goals = int(max_goals)
        self.relative = bool(relative)
        self._ahead = np.arange(self.num_goals)

    # ------------------------------------------------------------------ planning

    def plan(self, tensordict: TensorDictBase, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ask the manager for plans from the elements ``rows`` of a tensordict.

        Args:
            tensordict (TensorDictBase): states, any batch shape.
            rows (array): int64 ``[m]``, which of its elements, counted in row-major order.

        Returns:
            the goals, float32 ``[m, G, D]`` with the last one repeated to the end, and the lengths,
            int64 ``[m]``.
        """
        return ask_for_goals(
            self._plan_goals,
            tensordict,
            rows,
            in_keys=self._read,
            position_key=self.position_key,
            max_goals=self.max_goals,
        )

    def _shown(
        self, path: np.ndarray, length: np.ndarray, index: np.ndarray, position: np.ndarray
    ) -> np.ndarray:
        """The next K goals, ``[m, K, D]``."""
        ahead = np.minimum(index[:, None] + self._ahead, length[:, None] - 1)
        shown: np.ndarray = path[np.arange(len(path))[:, None], ahead]
        if self.relative:
            shown -= position[:, None]
        return shown

    # ------------------------------------------------------------------ in an env

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shape, device = tensordict_reset.batch_size, tensordict_reset.device
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
            numbers = np.stack([_numbers(tensordict, key, m) for key in self._numbers])
        rows = np.flatnonzero(fresh)
        if len(rows):
            path[rows], numbers[0, rows] = self.plan(tensordict_reset, rows)
            numbers[1:, rows] = 0
            numbers[2, rows] = 1
        entries = {self.plan_key: path.reshape(*shape, self.max_goals, dims)}
        entries.update(
            {k: n.reshape(*shape, 1) for k, n in zip(self._numbers, numbers, strict=True)}
        )
        shown = self._shown(path, numbers[0], numbers[1], position)
        entries[self.goals_key] = shown.reshape(*shape, -1)
        for key, array in entries.items():
            tensordict_reset.set(key, torch.from_numpy(array).to(device or "cpu"))
        return tensordict_reset

    def _needs_plan(self, before: TensorDictBase, after: TensorDictBase) -> np.ndarray:
        """Which elements a reset gives a new plan, bool ``[m]``."""
        shape = after.batch_size
        keys = list(before.keys(True, True))
        masks = [before.get(k) for k in keys if _last(k) == "_reset"]
        if masks:
            return np.logical_or.reduce(
                [mask.numpy(force=True).reshape(shape.numel(), -1).any(-1) for mask in masks]
            )
        mine = {self.plan_key, self.goals_key, *self._numbers}
        state = [unravel_key(k) for k in self.parent.full_state_spec.keys(True, True)]
        state = [k for k in state if k not in mine]
        given = set(map(unravel_key, keys))
        if not state or not {self.plan_key, *self._numbers, *state} <= given:
            return np.ones(shape.numel(), np.bool_)
        # The plan is for the state it was made in: one that the reset did not set needs another.
        changed = np.zeros(shape.numel(), np.bool_)
        for key in state:
            unequal = before.get(key) != after.get(key)
            changed |= unequal.numpy(force=True).reshape(shape.numel(), -1).any(-1)
        return changed

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        plan = tensordict.get(self.plan_key, None)
        if plan is None:
            raise KeyError(
                f"SubgoalTransform carries the plan in the tensordict, but {self.plan_key!r} is "
                f"missing from the one to step. Start from env.reset(), or env.reset(td, "
                f"set_state=True) for a state of your own."
            )
        shape, device = next_tensordict.batch_size, next_tensordict.device
        position = _rows(next_tensordict.get(self.position_key))
        m, dims = position.shape
        # Small arrays: numpy does in one microsecond what torch does in three.
        path = plan.numpy(force=True).reshape(m, self.max_goals, dims)
        length, index, *counters = (_numbers(tensordict, key, m) for key in self._numbers)
        offset = position - path[np.arange(m), index]
        distance = np.sqrt(np.einsum("md,md->m", offset, offset))
        met = distance < self.goal_met_threshold
        diverged = distance > self.goal_divergence_threshold
        reward = self.r_tick + self.r_goal_met * met + self.r_goal_divergence * diverged
        skipped = _skipped(tensordict, m)
        if skipped is not None:  # the env below did not step them: what they hold is no state
            met, diverged = met & ~skipped, diverged & ~skipped
            reward = reward * ~skipped
        index = index + met
        replan = diverged | (index >= length)
        index = np.minimum(index, length - 1)
        if replan.any():
            terminated = next_tensordict.get(self._terminated_key)
            replan &= ~terminated.numpy(force=True).reshape(m)
            rows = np.flatnonzero(replan)
            if len(rows):
                path, length = path.copy(), length.copy()
                path[rows], length[rows] = self.plan(next_tensordict, rows)
                index[rows] = 0
                plan = torch.from_numpy(path.reshape(*shape, *path.shape[1:])).to(plan.device)
        shown = self._shown(path, length, index, position)
        numbers = (
            length,
            index,
            *(count + new for count, new in zip(counters, (replan, met, diverged), strict=True)),
        )
        _put(next_tensordict, self.task_reward_key, next_tensordict.get(self.reward_key))
        _put(next_tensordict, self.plan_key, plan)
        entries: dict[NestedKey, np.ndarray] = {
            self.reward_key: reward.astype(np.float32).reshape(*shape, 1),
            self.goals_key: shown.reshape(*shape, -1),
        }
        entries.update(
            {k: n.reshape(*shape, 1) for k, n in zip(self._numbers, numbers, strict=True)}
        )
        for key, array in entries.items():
            tensor = torch.from_numpy(array)
            _put(next_tensordict, key, tensor if device is None else tensor.to(device))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Not defined: plans follow an env from step to step."""
        raise RuntimeError(
            "SubgoalTransform follows an env from step to step; stored data hold the goals and the "
            "worker's reward already. Append it to a TransformedEnv instead of a replay buffer."
        )

    # ------------------------------------------------------------------ specs

    def _add_specs(self, spec: Composite, position: TensorSpec) -> Composite:
        shape, device, dims = spec.shape, spec.device, position.shape[-1]
        spec[self.plan_key] = Unbounded(
            (*shape, self.max_goals, dims), dtype=torch.float32, device=device
        )
        for key, high in (
            (self.plan_length_key, self.max_goals),
            (self.goal_index_key, self.max_goals - 1),
        ):
            spec[key] = Bounded(0, high, shape=(*shape, 1), dtype=torch.int64, device=device)
        for key in self.counter_keys:
            spec[key] = Unbounded((*shape, 1), dtype=torch.int64, device=device)
        return spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        if self.position_key not in set(map(unravel_key, observation_spec.keys(True, True))):
            raise KeyError(
                f"SubgoalTransform compares {self.position_key!r} with the goals, which the env "
                f"before it does not write; it writes "
                f"{sorted(map(str, observation_spec.keys(True, True)))}. Pass one of them as "
                f"position_key."
            )
        position = observation_spec[self.position_key]
        shape, device = observation_spec.shape, observation_spec.device
        observation_spec[self.goals_key] = Unbounded(
            (*shape, self.num_goals * position.shape[-1]), dtype=torch.float32, device=device
        )
        return self._add_specs(observation_spec, position)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        return self._add_specs(state_spec, self.parent.full_observation_spec[self.position_key])

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        if self.reward_key not in set(map(unravel_key, reward_spec.keys(True, True))):
            raise KeyError(
                f"SubgoalTransform rewards the worker under {self.reward_key!r}; the env before it "
                f"has the rewards {sorted(map(str, reward_spec.keys(True, True)))}. Pass one of "
                f"them as reward_key."
            )
        task = reward_spec[self.reward_key]
        reward_spec[self.task_reward_key] = task.clone()
        reward_spec[self.reward_key] = Unbounded(
            task.shape, dtype=torch.float32, device=task.device
        )
        return reward_spec

    @property
    def _terminated_key(self) -> NestedKey:
        keys = [unravel_key(k) for k in self.parent.done_keys]
        found = [k for k in keys if _last(k) == "terminated"] or keys
        return found[0]

    def __repr__(self) -> str:
        return (
            f"SubgoalTransform(planner={type(self.planner).__name__}, num_goals={self.num_goals}, "
            f"relative={self.relative})"
        )


def _rows(value: Tensor) -> np.ndarray:
    """The vectors of an entry as rows, ``[m, D]``."""
    return value.numpy(force=True).reshape(-1, value.shape[-1])


def _numbers(tensordict: TensorDictBase, key: NestedKey, m: int) -> np.ndarray:
    """An entry of one number per element, ``[m]``; zeros where the tensordict has none."""
    value = tensordict.get(key, None)
    return np.zeros(m, np.int64) if value is None else value.numpy(force=True).reshape(m)


def _put(tensordict: TensorDictBase, key: NestedKey, value: Tensor) -> None:
    """Set an entry of the right shape and device; TensorDict.set checks at five times the cost."""
    if isinstance(key, str):
        tensordict._set_str(key, value, validated=True, inplace=False, non_blocking=False)
    else:
        tensordict.set(key, value)


def _skipped(tensordict: TensorDictBase, m: int) -> np.ndarray | None:
    """Elements that a batched env below was told not to step, bool ``[m]``, or None."""
    stepped: Any = tensordict.get("_step", None)
    return None if stepped is None else ~stepped.numpy(force=True).reshape(m)


def _last(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]
