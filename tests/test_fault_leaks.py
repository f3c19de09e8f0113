"""Memory stays flat over thousands of searches and a million base steps.

``python tests/test_fault_leaks.py`` prints by how much it grows, without any limit.
"""

from __future__ import annotations

import gc
import json
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env

MIB = 2**20
MAX_MIB, MAX_OBJECTS = 16.0, 500  # what is allowed over the long runs


def resident() -> int:
    """Bytes of this process that are in memory."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096


def growth(step: Callable[[], Any], number: int, warm_up: int) -> tuple[float, int]:
    """Returns the growth in MiB and in Python objects over ``number`` steps after the first."""
    for _ in range(warm_up):
        step()
    gc.collect()
    memory, objects = resident(), len(gc.get_objects())
    for _ in range(number):
        step()
    gc.collect()
    return (resident() - memory) / MIB, len(gc.get_objects()) - objects


def searches() -> Callable[[], Any]:
    env = ChainEnv(length=6)
    budget = SearchBudget(expansions=8)
    planner = MCTSPlanner(env, novelty=RadiusNovelty("state", 0.5), budget=budget)
    start = env.reset()
    return lambda: planner.plan(start.clone())


def steps(copies: int) -> Callable[[], Any]:
    # So few mazes that all have been visited soon: an env keeps the walls of those that were.
    env = WaterworldMazeEnv(maze_pool("train")[:50], observation=False, batch_size=[copies])
    env.set_seed(0)
    state = [env.reset()]

    def step() -> None:
        state[0]["action"] = env.action_spec.rand()
        _, state[0] = env.step_and_maybe_reset(state[0])

    return step


def many_searches() -> tuple[float, int]:
    return growth(searches(), 10_000, warm_up=200)


def many_base_steps() -> tuple[float, int]:
    """A million: 2,000 steps of 500 copies, in 50 mazes."""
    return growth(steps(500), 2_000, warm_up=200)


@pytest.mark.parametrize(
    ("run", "mib"),
    [
        (lambda: growth(searches(), 300, warm_up=60), 12.0),
        (lambda: growth(steps(64), 300, warm_up=60), 12.0),
        pytest.param(many_searches, MAX_MIB, marks=pytest.mark.slow),
        pytest.param(many_base_steps, MAX_MIB, marks=pytest.mark.slow),
    ],
    ids=["searches", "base_steps", "many_searches", "many_base_steps"],
)
def test_nothing_is_left_behind(run: Callable[[], tuple[float, int]], mib: float) -> None:
    grown, objects = run()
    assert grown < mib, f"{grown:.1f} MiB more"
    assert objects < MAX_OBJECTS, f"{objects} Python objects more"


def test_a_trainer_that_is_gone_frees_its_memory() -> None:
    def build() -> None:
        env = make_training_env(copies=8)
        loss = DIAYNTrainer.make_loss(env, 4, hidden=(4,))
        trainer = DIAYNTrainer(env, loss, total_frames=64, batch_size=8, buffer_size=64)
        trainer.train()

    grown, _ = growth(build, 8, warm_up=3)
    assert grown < 16.0, f"{grown:.1f} MiB more"


def test_the_check_notices_a_leak() -> None:
    kept: list[Any] = []
    # Blocks so large that each is asked of the system, though other tests have given some back.
    grown, _ = growth(lambda: kept.append(torch.ones(2**24)), 6, warm_up=1)
    assert grown > 200.0
    assert growth(lambda: kept.append(TensorDict(a=torch.ones(1))), 400, 2)[1] > 500


if __name__ == "__main__":
    torch.set_num_threads(1)
    runs = {"searches": (10_000, many_searches), "base_steps": (1_000_000, many_base_steps)}
    grown = {name: (number, *run()) for name, (number, run) in runs.items()}
    names = ("number", "growth_mib", "growth_objects")
    table = {
        n: dict(zip(names, (k, round(m, 2), o), strict=True)) for n, (k, m, o) in grown.items()
    }
    print(json.dumps(table))
