"""Textbook searches with a queue instead of a tree policy: what UCT and PUCT must beat.

Letters: F nodes in the queue, A options.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_hmcts.planners import MCTSPlanner
from torchrl_hmcts.trainers.evaluation import Results, execute_plans

Order = Callable[[int, float, np.random.Generator], float]
ORDERS: dict[str, Order] = {
    "breadth first": lambda depth, reward, random: depth,
    "best first": lambda depth, reward, random: -reward,
    "random node": lambda depth, reward, random: random.random(),
}
"""Which node is expanded next: that of the lowest number; of several the oldest."""


def search(
    planner: MCTSPlanner, start: TensorDictBase, order: Order, seed: int = 0
) -> dict[str, Any]:
    """Expand node after node, all options of each, with the novelty test and budget of a planner.

    Args:
        planner: whose simulator, discount, novelty test and budget are used; not its tree policy.
        start: state ``[1]``.
        order: one of ``ORDERS``.
        seed: of its random numbers.

    Returns:
        ``options`` of the best plan (int64), ``found``, ``simulated_steps``, ``expansions``.
    """
    simulator, novelty, budget = planner.simulator, planner.novelty, planner.budget
    random, options = np.random.default_rng(seed), np.arange(planner.num_options)
    root = simulator.root(start)
    if novelty is not None:
        novelty.start(1)
        novelty.accept(np.zeros(1, np.int64), novelty.features(root), np.zeros(1, np.int64))
    queue: list[Any] = [(0.0, 0, simulator.state(root), [], 0.0, 0)]
    refused: list[Any] = []
    best: tuple[float, list[int]] = (0.0, [])
    steps = expansions = count = 0
    while steps < (budget.base_steps or np.inf) and expansions < (budget.expansions or np.inf):
        if not queue:  # as the planner does: be less strict, and look again at what was refused
            if novelty is None or not refused or not novelty.relax(0):
                break
            again, refused = refused, []
            for features, entry in again:
                if novelty.accept(np.zeros(1, np.int64), features, np.array([entry[5]]))[0]:
                    heapq.heappush(queue, entry)
                else:
                    refused.append((features, entry))
            continue
        _, _, state, path, earned, far = heapq.heappop(queue)
        after = simulator.step(state.repeat(len(options)), options)
        expansions += 1
        durations, rewards = simulator.durations(after), simulator.rewards(after)
        done, states = simulator.done(after), simulator.state(after)
        features = None if novelty is None else novelty.features(after)
        for i in options:
            steps += int(durations[i])
            total = earned + planner.gamma**far * float(rewards[i])
            way = [*path, int(i)]
            if total > best[0]:
                best = (total, way)
            if done[i]:
                continue
            count += 1
            at = far + int(durations[i])
            number = order(len(way), total, random)
            entry = (number, count, states[int(i) : int(i) + 1], way, total, at)
            if novelty is None:
                heapq.heappush(queue, entry)
                continue
            one = features[i : i + 1]  # type: ignore[index]
            if novelty.accept(np.zeros(1, np.int64), one, np.array([at]))[0]:
                heapq.heappush(queue, entry)
            else:
                refused.append((one, entry))
        if best[1] and budget.until_plan:
            break
    return {
        "options": best[1],
        "found": bool(best[1]),
        "simulated_steps": steps,
        "expansions": expansions,
    }


@torch.no_grad()
def plan_by_queue(
    planner: MCTSPlanner, real: EnvBase, starts: TensorDictBase, order: str, seed: int
) -> Results:
    """Plan from each start by a queue and execute the plan, as ``plan_and_execute`` does.

    Args:
        planner: see :func:`search`.
        real: the macro env to act in.
        starts: states ``[M]``.
        order: name of one of ``ORDERS``.
        seed: of the random numbers, with the number of the start.
    """
    found = [
        search(planner, start, ORDERS[order], seed + i) for i, start in enumerate(starts.split(1))
    ]
    longest = max(1, *(len(row["options"]) for row in found))
    options = torch.full((len(found), longest), -1)
    for row, plan in zip(options, found, strict=True):
        row[: len(plan["options"])] = torch.tensor(plan["options"], dtype=torch.int64)
    executed = execute_plans(real, starts, options)

    def column(name: str) -> np.ndarray:
        return np.array([row[name] for row in found])

    return Results(
        found=column("found"),
        solved=executed.solved,
        simulated_steps=column("simulated_steps"),
        expansions=column("expansions"),
        simulations=column("expansions") * planner.num_options,
        plan_options=np.array([len(row["options"]) for row in found]),
        episode_steps=executed.base_steps,
        rewards=executed.rewards,
    )
