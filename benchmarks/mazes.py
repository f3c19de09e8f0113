"""Waterworld's test mazes, solved by the demo's worker and planner: shared by the benchmarks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torchrl.envs import EnvBase, TransformedEnv

from torchrl_hmcts.envs import maze_pool
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.evaluation import Results, plan_and_execute
from torchrl_hmcts.trainers.experiments.kits import make_kit
from torchrl_hmcts.trainers.experiments.kits.waterworld import (
    make_option_env,
    make_starts,
)
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.experiments.skills import learn

RADIUS = 0.7  # of the novelty test, tiles
__all__ = ["RADIUS", "demo_loss", "greedy", "make_option_env", "make_starts", "planner", "solve"]


def demo_loss(seed: int) -> Any:
    """Train the demo's worker."""
    return learn(make_kit(DemoConfig(seed=seed))).loss


def greedy(loss: Any) -> SkillPolicy:
    """Return a worker that takes the most probable actions."""
    return SkillPolicy(loss.actor_network, deterministic=True)


def planner(
    env: EnvBase,
    radius: float = RADIUS,
    *,
    leaves: int = 4,
    budget: SearchBudget | None = None,
    **settings: Any,
) -> MCTSPlanner:
    """Return the reference planner: UCT, 1,000 expansions, shorter paths accepted."""
    novelty = RadiusNovelty("position", radius, shorter_paths=True)
    budget = SearchBudget(expansions=1_000) if budget is None else budget
    return MCTSPlanner(env, novelty=novelty, leaves_per_wave=leaves, budget=budget, **settings)


def solve(
    worker: Any,
    count: int,
    seed: int,
    make_env: Callable[..., TransformedEnv] = make_option_env,
    **options: Any,
) -> Results:
    """Plan in the first test mazes, execute the plans in another instance; one trial each."""
    env, real = (make_env(worker, maze_pool("test"), **options) for _ in range(2))
    return plan_and_execute(planner(env), real, make_starts(real.base_env, count, seed))
