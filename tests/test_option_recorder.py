"""OptionRecorder, on a chain whose base transitions can be counted on the fingers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.planners import MCTSPlanner, SearchBudget
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.transforms import OptionRecorder, OptionTransform

KEYS = ["state", "skill", "action", ("next", "state"), ("next", "terminated"), ("next", "skill")]
MOVED = ["displacement", ("next", "displacement")]


class LockedChain(ChainEnv):
    """A chain of fixed batch size, whose elements may be told not to step."""

    batch_locked = True


def make_worker() -> TensorDictModule:
    return TensorDictModule(lambda skill: skill, ["skill"], ["action"])  # 0: left, 1: right


def make_env(
    recorder: OptionRecorder | None, base: ChainEnv | None = None, **options: Any
) -> TransformedEnv:
    keys = None if recorder is None else recorder.trajectory_keys
    transform = OptionTransform(make_worker(), 2, 3, 0.5, trajectory_keys=keys, **options)
    base = ChainEnv(length=6) if base is None else base
    return TransformedEnv(base, transform if recorder is None else Compose(transform, recorder))


def step(env: TransformedEnv, states: list[int], options: list[int]) -> TensorDictBase:
    td = env.reset(TensorDict(batch_size=[len(states)]))
    td["state"] = torch.tensor(states)
    return env.step(td.set("option", torch.tensor(options)))["next"]


def test_exactly_the_base_steps_that_were_taken_are_stored() -> None:
    recorder = OptionRecorder(KEYS)
    # From 3 it takes two steps to the end at 5; the third of the three is never taken.
    step(make_env(recorder), [3, 4, 1], [1, 0, 1])
    data = recorder.take()
    assert data["state"].tolist() == [3, 4, 4, 3, 2, 1, 2, 3]
    assert data["next", "state"].tolist() == [4, 5, 3, 2, 1, 2, 3, 4]
    assert data["action"].tolist() == [1, 1, 0, 0, 0, 1, 1, 1]
    assert data["skill"].tolist() == data["next", "skill"].tolist() == [1, 1, 0, 0, 0, 1, 1, 1]
    assert data["next", "terminated"].flatten().tolist() == [False, True] + 6 * [False]
    assert set(data.keys(True, True)) == set(KEYS)
    assert recorder.num_base_steps == 8


def test_displacement_is_measured_from_where_each_option_began() -> None:
    recorder = OptionRecorder(MOVED, position_key="state")
    env = make_env(recorder)
    after = step(env, [2, 4], [1, 0])
    env.step(after.select("state", "done", "terminated").set("option", torch.tensor([0, 0])))
    data = recorder.take()
    # To the right from 2 to the end at 5, to the left from 4 to 1; then 5 is over, and 1 to 0.
    first = [0, 1, 2, 0, -1, -2]
    assert data["displacement"][:6].tolist() == first
    assert data["next", "displacement"][:6].tolist() == [1, 2, 3, -1, -2, -3]
    assert data["displacement"][-3:].tolist() == [0, -1, -1]
    assert data["next", "displacement"][-3:].tolist() == [-1, -1, -1]
    assert set(data.keys(True, True)) == set(MOVED)


@pytest.mark.parametrize("nested", [False, True])
def test_the_keys_may_be_nested(nested: bool) -> None:
    def key(name: str) -> Any:
        return ("agent", name) if nested else name

    def after(name: str) -> Any:
        return ("next", "agent", name) if nested else ("next", name)

    recorder = OptionRecorder(
        [key("skill"), key("moved"), after("moved")],
        position_key=key("x"),
        displacement_key=key("moved"),
        skill_key=key("skill"),
    )
    assert recorder.trajectory_keys == [key("x"), after("x")]
    block = TensorDict(batch_size=[1, 3])
    block[key("x")] = torch.tensor([[[5.0], [6.0], [0.0]]])
    block[after("x")] = torch.tensor([[[6.0], [8.0], [0.0]]])
    block["mask"] = torch.tensor([[True, True, False]])
    root = TensorDict(batch_size=[1])
    root[key("skill")] = torch.tensor([3])
    following = recorder._step(root, TensorDict(trajectory=block, batch_size=[1]))
    assert list(following.keys()) == []
    data = recorder.take()
    assert data[key("moved")].tolist() == [[0.0], [1.0]]
    assert data[after("moved")].tolist() == [[1.0], [3.0]]
    assert data[key("skill")].tolist() == [3, 3]


def test_the_env_gives_what_it_gives_without_the_recorder() -> None:
    recorder = OptionRecorder([*KEYS, *MOVED], position_key="state")
    with_it, without = make_env(recorder), make_env(None)
    check_env_specs(with_it)
    assert with_it.observation_spec == without.observation_spec
    runs = []
    for env in (with_it, without):
        runs.append(env.rollout(4, lambda td: td.set("option", torch.tensor(1))))
    assert (runs[0] == runs[1]).all()
    assert "trajectory" not in runs[0].keys()
    assert "trajectory" not in runs[0]["next"].keys()


def test_a_search_is_the_same_with_the_recorder_and_every_simulated_step_is_recorded() -> None:
    recorder = OptionRecorder(KEYS)
    found = []
    for env in (make_env(recorder, ChainEnv(length=20)), make_env(None, ChainEnv(length=20))):
        planner = MCTSPlanner(env, budget=SearchBudget(expansions=40, until_plan=False), seed=0)
        search = planner.search(env.reset())
        found.append((search.tree.nodes.copy(), search.tree.edges.copy(), search.num_base_steps))
    for with_it, without in zip(*found, strict=True):
        for name in with_it.dtype.names or [None]:
            a, b = (with_it, without) if name is None else (with_it[name], without[name])
            np.testing.assert_array_equal(a, b)
    data = recorder.take()
    assert len(data) == recorder.num_base_steps == found[0][2].sum() > 100
    right = 2 * data["action"] - 1
    assert torch.equal(data["next", "state"], (data["state"] + right).clamp_min(0))


def test_the_skills_of_a_search_outlive_the_memory_of_its_options() -> None:
    recorder = OptionRecorder(KEYS)
    env = make_env(recorder)
    options = torch.tensor([0, 1])
    td = env.reset(TensorDict(batch_size=[2])).set("option", options)
    env._step(td)
    options.fill_(7)
    assert set(recorder.take()["skill"].tolist()) == {0, 1}


def test_elements_that_do_not_step_leave_nothing() -> None:
    recorder = OptionRecorder(["state", "skill"])
    env = make_env(recorder, LockedChain(length=9, batch_size=[3]))
    td = env.reset().set("option", torch.tensor([1, 1, 0]))
    env.step(td.set("_step", torch.tensor([True, False, True])))
    data = recorder.take()
    assert data["state"].tolist() == [0, 1, 2, 0, 0, 0]
    assert data["skill"].tolist() == [1, 1, 1, 0, 0, 0]


def test_what_was_taken_is_forgotten() -> None:
    recorder = OptionRecorder(KEYS)
    step(make_env(recorder), [0], [1])
    assert len(recorder.take()) == 3
    assert recorder.take().batch_size == torch.Size([0])
    assert recorder.num_base_steps == 3


def test_a_gradient_does_not_reach_into_the_record() -> None:
    def act(skill: Tensor) -> Tensor:
        return (weight * skill).round().to(torch.int64)

    weight = torch.ones((), requires_grad=True)
    recorder = OptionRecorder(["state", "action"])
    options = OptionTransform(
        TensorDictModule(act, ["skill"], ["action"]),
        2,
        3,
        trajectory_keys=recorder.trajectory_keys,
    )
    env = TransformedEnv(ChainEnv(), Compose(options, recorder))
    env.step(env.reset().set("option", torch.tensor(1)))
    assert not any(value.requires_grad for value in recorder.take().values(True, True))


def test_an_env_that_hands_nothing_out_is_refused() -> None:
    recorder = OptionRecorder(["state", ("next", "state")])
    options = OptionTransform(make_worker(), 2, 3, trajectory_keys=["state"])
    env = TransformedEnv(ChainEnv(), Compose(options, recorder))
    with pytest.raises(KeyError, match=r"\('next', 'state'\).*the env before it does not write"):
        env.observation_spec  # noqa: B018
    with pytest.raises(KeyError, match="trajectory_keys=recorder.trajectory_keys"):
        TransformedEnv(ChainEnv(), OptionRecorder(["state"])).observation_spec  # noqa: B018
