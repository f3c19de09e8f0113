"""Speed of the hierarchical agent on Waterworld: `pytest benchmarks -m benchmark`.

The worker thrusts in one direction per skill, so that only simulator, options and search are timed.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModuleBase

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_option_env, make_starts

pytestmark = pytest.mark.benchmark


class Thrust(TensorDictModuleBase):
    """Takes the action of the skill's number."""

    in_keys = ["skill"]
    out_keys = ["action"]

    def forward(self, tensordict):
        return tensordict.set("action", tensordict.get("skill"))


@pytest.fixture(scope="module")
def planner():
    planner = MCTSPlanner(
        make_option_env(Thrust(), maze_pool("test")),
        novelty=RadiusNovelty("position", 0.6),
        leaves_per_wave=4,
    )
    planner.plan(make_starts(planner.simulator.env.base_env, 1, seed=0))
    return planner


@pytest.fixture(scope="module")
def starts(planner):
    return make_starts(planner.simulator.env.base_env, 100, seed=0)


def test_planning_one_maze_at_a_time(benchmark, planner, starts):
    order = iter(np.arange(100).repeat(2))
    benchmark.pedantic(
        lambda: planner.plan(starts[next(order) : next(order) + 1]), rounds=40, warmup_rounds=2
    )


def test_planning_100_mazes_in_one_batch(benchmark, planner, starts):
    benchmark.pedantic(lambda: planner.plan(starts), rounds=3, warmup_rounds=1)


@pytest.mark.parametrize("copies", [1, 4, 64, 256])
def test_base_step_of_waterworld(benchmark, copies):
    env = WaterworldMazeEnv(maze_pool("test"), observation=False, seed=0, batch_size=[copies])
    td = env.rand_action(env.reset())
    with torch.no_grad():
        benchmark(env._step, td)


@pytest.mark.parametrize("copies", [4, 64, 256])
def test_option_of_20_base_steps(benchmark, copies):
    env = make_option_env(Thrust(), maze_pool("test"), seed=0)
    td = env.base_env.reset(env.base_env.fake_tensordict().expand(copies).empty())
    td["option"] = torch.arange(copies) % 4
    with torch.no_grad():
        benchmark(env._step, td)
