"""Plans executed open-loop: what they led to, base step by base step."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from torchrl_hmcts.envs import SettableGymEnv
from torchrl_hmcts.planners import MCTSPlanner
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers.evaluation import execute_plans, plan_and_execute
from torchrl_hmcts.transforms import OptionTransform


def chain_of_options(length: int = 7, **kwargs: object) -> TransformedEnv:
    """A chain whose option o takes the base action o for up to three base steps."""
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    return TransformedEnv(ChainEnv(length=length), OptionTransform(worker, 2, 3, **kwargs))


def test_every_base_step_of_an_option_is_reported_with_its_option() -> None:
    real = chain_of_options(trajectory_keys=["state"])
    starts = real.reset().expand(2).clone()
    plans = torch.tensor([[1, 0, 1], [1, 1, -1]])  # right, left, right; right, right
    done = execute_plans(real, starts, plans, keys=["state"])
    assert [s["state"].flatten().tolist() for s in done.states] == [
        [0, 1, 2, 3, 2, 1, 0, 1, 2, 3],
        [0, 1, 2, 3, 4, 5, 6],
    ]
    assert [o.tolist() for o in done.options] == [[1] * 3 + [0] * 3 + [1] * 3, [1] * 6]
    assert done.base_steps.tolist() == [9, 6]
    assert done.solved.tolist() == [False, True]
    assert done.rewards.tolist() == pytest.approx([0.0, 0.99**2])  # at the option's third step


def test_without_a_trajectory_there_is_a_state_per_option() -> None:
    real = chain_of_options()
    done = execute_plans(real, real.reset()[None], torch.tensor([[1, 1]]), keys=["state"])
    assert done.states[0]["state"].flatten().tolist() == [0, 3, 6]
    assert done.options[0].tolist() == [1, 1]


def test_a_plan_ends_with_the_episode() -> None:
    env = ChainEnv(length=3)
    done = execute_plans(env, env.reset()[None], torch.ones(1, 9, dtype=torch.int64))
    assert (done.base_steps.tolist(), done.rewards.tolist()) == ([2], [1.0])
    assert done.states == done.options == []


def test_a_plan_is_executed_in_an_env_that_holds_its_own_state() -> None:
    pytest.importorskip("gymnasium")
    model, real = (SettableGymEnv("FrozenLake-v1", is_slippery=False) for _ in range(2))
    start = model.reset()
    results = plan_and_execute(MCTSPlanner(model), real, start[None], keys=["observation"])
    assert results.solved.tolist() == [True]
    assert results.rewards.tolist() == [1.0]
    assert len(results.states[0]) == results.episode_steps[0] + 1 == results.plan_options[0] + 1


def test_starts_in_groups_give_the_same_plans_as_one_by_one() -> None:
    env, starts = ChainEnv(length=5), ChainEnv(length=5).reset().expand(3).clone()
    one, all_at_once = (
        plan_and_execute(MCTSPlanner(env), ChainEnv(length=5), starts, group=group, keys=["state"])
        for group in (1, 3)
    )
    for name in ("solved", "simulated_steps", "episode_steps"):
        assert np.array_equal(getattr(one, name), getattr(all_at_once, name))
    assert [p.options.tolist() for p in one.plans] == [[1] * 4] * 3
    assert len(one.plan_seconds) == len(one.states) == 3
