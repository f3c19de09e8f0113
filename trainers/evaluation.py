"""Executing plans open-loop in a real env, and what it achieved.

Letters: M starts, L options of the longest plan, T base steps of an episode.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_hmcts.planners import MCTSPlanner, Plan, extract_plans
from torchrl_hmcts.planners.simulator import Simulator


@dataclass
class Execution:
    """Results of executing plans, one entry per start ``[M]``."""

    solved: np.ndarray
    """Bool, whether the episode met a terminal state."""
    base_steps: np.ndarray
    """Int64, base steps that were taken."""
    rewards: np.ndarray
    """Float32, sum of the rewards of the options."""
    states: list[TensorDictBase] = field(default_factory=list)
    """With ``keys`` the chosen entries ``[T + 1]`` before the first and after every base step; of
    an env without a ``"trajectory"`` after every option."""
    options: list[Tensor] = field(default_factory=list)
    """With ``keys``, int64 ``[T]``, the option under way between two states."""


@torch.no_grad()
def execute_plans(
    real: EnvBase, starts: TensorDictBase, options: Tensor, *, keys: Sequence[NestedKey] = ()
) -> Execution:
    """Take the options of each plan one after the other, until it or the episode ends.

    It is no :class:`~torchrl_hmcts.planners.HierarchicalPolicy`, which would plan again at a plan's
    end and act without one: one trial is one plan, and its failure is to be seen.
    """
    simulator = Simulator(real, mask_key=None)
    simulator.keep(keys)
    state = simulator.state(simulator.root(starts)).clone()
    taken = options.cpu().numpy()
    count = len(taken)
    out = Execution(
        np.zeros(count, np.bool_), np.zeros(count, np.int64), np.zeros(count, np.float32)
    )
    path: list[tuple[list[TensorDictBase], list[int]]]
    path = [([row.select(*keys)], []) for row in state.clone().split(1)] if keys else []
    running = np.ones(count, np.bool_)
    for i in range(taken.shape[1]):
        running &= taken[:, i] >= 0
        rows = np.flatnonzero(running)
        if not len(rows):
            break
        index = torch.from_numpy(rows)
        after = simulator.step(state[index], taken[rows, i])
        out.solved[rows] = simulator.terminated(after)
        out.base_steps[rows] += simulator.durations(after)
        out.rewards[rows] += simulator.rewards(after)
        running[rows] = ~simulator.done(after)
        state[index] = simulator.state(after)
        if keys:
            for row, step in zip(rows, after.split(1), strict=True):
                _follow(step, int(taken[row, i]), keys, *path[row])
    out.states = [torch.cat(states) for states, _ in path]
    out.options = [torch.tensor(under_way, dtype=torch.int64) for _, under_way in path]
    return out


def _follow(
    after: TensorDictBase,
    option: int,
    keys: Sequence[NestedKey],
    states: list[TensorDictBase],
    options: list[int],
) -> None:
    """Append the states after the base steps of one option, and the option as often."""
    inner = after.get("trajectory", None)
    length = 1
    if inner is not None:
        length = int(inner["mask"].sum())
        states.append(inner[0, 1:length].select(*keys))
    states.append(after.select(*keys))
    options += [option] * length


@dataclass
class Results:
    """Results of planning and executing the plans, one entry per start ``[M]``.

    ``found`` a plan and ``solved`` by executing it (bool); ``simulated_steps`` base steps that
    the search simulated, ``expansions`` of nodes and ``simulations`` of options it took,
    ``plan_options`` in the plan, ``episode_steps`` base steps that were executed (int64). From
    :func:`plan_and_execute` also the ``rewards`` of the episode (float32), ``plan_seconds`` of the
    search (float64, a group's divided among its starts), the ``plans``, and with ``keys`` the
    ``states`` and ``options`` of an :class:`Execution`.
    """

    found: np.ndarray
    solved: np.ndarray
    simulated_steps: np.ndarray
    expansions: np.ndarray
    simulations: np.ndarray
    plan_options: np.ndarray
    episode_steps: np.ndarray
    rewards: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    plan_seconds: np.ndarray = field(default_factory=lambda: np.zeros(0))
    plans: list[Plan] = field(default_factory=list)
    states: list[TensorDictBase] = field(default_factory=list)
    options: list[Tensor] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Return counts, and mean, median and 95th percentile of each cost.

        ``episode_steps`` and ``plan_options`` are those of the solved starts; the costs of search
        are those of all.
        """
        out: dict[str, Any] = {
            "starts": len(self.solved),
            "found": int(self.found.sum()),
            "solved": int(self.solved.sum()),
        }
        for name in ("simulated_steps", "expansions", "simulations"):
            out[name] = spread(getattr(self, name))
        for name in ("plan_options", "episode_steps"):
            out[name] = spread(getattr(self, name)[self.solved])
        return out

    @staticmethod
    def concatenate(parts: Sequence[Results]) -> Results:
        """Join results of several groups of starts."""
        columns: dict[str, Any] = {}
        for name in (column.name for column in fields(Results)):
            values = [getattr(part, name) for part in parts]
            lists = isinstance(values[0], list)
            columns[name] = sum(values, []) if lists else np.concatenate(values)
        return Results(**columns)


def spread(values: Any) -> dict[str, float]:
    """Return mean, median and 95th percentile; NaN of nothing."""
    values = np.asarray(values, dtype=float)
    if not values.size:
        return dict.fromkeys(("mean", "median", "p95"), float("nan"))
    return {
        "mean": round(float(values.mean()), 4),
        "median": round(float(np.median(values)), 4),
        "p95": round(float(np.percentile(values, 95)), 4),
    }


def plan_and_execute(
    planner: MCTSPlanner,
    real: EnvBase,
    starts: TensorDictBase,
    *,
    group: int = 38,
    keys: Sequence[NestedKey] = (),
) -> Results:
    """Plan from every start, execute the plans in another env, and report.

    Trees do not depend on what is searched beside them, so the results are those of one search
    after the other; a group of starts is only faster. ``planner.last_search`` is that of the last
    group. Base steps of an evaluator's rollouts count as simulated, a group's shared evenly.
    """
    parts = []
    for some in starts.split(group):
        begin, rolled = time.perf_counter(), _rolled(planner)
        search = planner.search(some)
        plans = extract_plans(search)
        seconds = (time.perf_counter() - begin) / len(some)
        executed = execute_plans(real, some, plans.options, keys=keys)
        parts.append(
            Results(
                found=plans.found.numpy(),
                solved=executed.solved,
                simulated_steps=search.num_base_steps + (_rolled(planner) - rolled) // len(some),
                expansions=search.num_expansions.copy(),
                simulations=search.num_simulations.copy(),
                plan_options=plans.lengths.numpy(),
                episode_steps=executed.base_steps,
                rewards=executed.rewards,
                plan_seconds=np.full(len(some), seconds),
                plans=list(plans.unbind(0)),
                states=executed.states,
                options=executed.options,
            )
        )
    return Results.concatenate(parts)


def _rolled(planner: MCTSPlanner) -> int:
    """Base steps that a planner's evaluator has simulated, which its searches do not count."""
    return int(getattr(planner.evaluate.leaf_evaluator, "num_base_steps", 0))


@torch.no_grad()
def act_by_policy(
    policy: TensorDictModuleBase, real: EnvBase, start: TensorDictBase, *, limit: int
) -> Results:
    """Act in one episode by a policy over the options, without a search."""
    begin = time.perf_counter()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        episode = real.rollout(limit, policy, auto_reset=False, tensordict=start[0].clone())
    none = np.zeros(1, np.int64)
    return Results(
        found=np.array([True]),
        solved=episode[-1]["next", "terminated"].numpy().reshape(1),
        simulated_steps=none,
        expansions=none,
        simulations=none,
        plan_options=np.array([len(episode)]),
        episode_steps=np.array([int(episode["next", "duration"].sum())]),
        rewards=np.array([float(episode["next", "reward"].sum())], np.float32),
        plan_seconds=np.array([time.perf_counter() - begin]),
    )


@torch.no_grad()
def option_reach(
    simulator: EnvBase,
    starts: TensorDictBase,
    features: Callable[[TensorDictBase], np.ndarray],
    num_options: int,
) -> float:
    """Return how far options move the features of states; a quarter of them move these farther."""
    before = starts.repeat(num_options)
    options = torch.arange(num_options).repeat_interleave(len(starts))
    after = simulator.step(before.clone().set("option", options))["next"]
    moved = np.linalg.norm(features(after) - features(before), axis=-1)
    return float(np.quantile(moved, 0.75))
