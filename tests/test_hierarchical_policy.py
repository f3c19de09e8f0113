"""Carrying plans out: at a plan's end, every k options, on divergence, with trees that are kept."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from search_parts import BINARY_TREE, FOREVER, LEAVES, ROAD, SLIPPERY_ROAD, CountingEnv, at
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import StepCounter, TransformedEnv

from torchrl_hmcts.planners import (
    HierarchicalPolicy,
    MCTSPlanner,
    Search,
    SearchBudget,
)
from torchrl_hmcts.testing import ChainEnv, TableEnv


class CountingPlanner(MCTSPlanner):
    """A planner that records the states it is asked to search from."""

    def search(self, td: TensorDictBase) -> Search:
        self.__dict__.setdefault("asked", []).append(td["state"].flatten().tolist())
        return super().search(td)


def test_the_hierarchical_policy_plans_once_and_follows_its_plan() -> None:
    env = ChainEnv(6)
    planner = CountingPlanner(env)
    rollout = env.rollout(20, policy=HierarchicalPolicy(planner))
    assert planner.asked == [[0]]
    assert rollout["action"].tolist() == [1] * 5
    assert rollout["plan_step"].flatten().tolist() == [1, 2, 3, 4, 5]
    assert rollout["plan_length"].flatten().tolist() == [5] * 5


def test_the_hierarchical_policy_takes_the_planners_choice_where_it_finds_no_plan() -> None:
    env = ChainEnv(30)
    planner = CountingPlanner(env, budget=SearchBudget(expansions=2))
    rollout = env.rollout(4, policy=HierarchicalPolicy(planner))
    assert len(planner.asked) == 4
    assert rollout["plan_length"].flatten().tolist() == [1] * 4


def test_each_element_of_a_batch_plans_at_its_own_time() -> None:
    env = ChainEnv(6)
    planner = CountingPlanner(env)
    td = env.reset(TensorDict({"state": torch.tensor([0, 3, 4])}, [3]), set_state=True)
    rollout = env.rollout(
        20,
        policy=HierarchicalPolicy(planner, max_plan_length=2),
        tensordict=td,
        auto_reset=False,
        break_when_all_done=True,
    )
    # Plans of 5, 2 and 1 options, cut to 2: only the first element ever plans again.
    assert planner.asked == [[0, 3, 4], [2], [4]]
    assert rollout["next", "done"].squeeze(-1).sum(-1).tolist() == [1, 4, 5]


def test_a_new_episode_is_planned_for_although_the_old_plan_is_not_at_its_end() -> None:
    env = ChainEnv(6)
    planner = CountingPlanner(env)
    policy = HierarchicalPolicy(planner)
    td = policy(at(env, 1))
    assert td["plan_step"].item() == 1
    td.update(at(env, 0)).set("is_init", torch.ones(1, dtype=torch.bool))
    td = policy(td)
    assert planner.asked == [[1], [0]]
    assert (td["plan_length"].item(), td["plan_step"].item()) == (5, 1)


# ---------------------------------------------------------------------- starts of episodes

EPISODES = {"plan_step": [1, 2, 3] * 3, "num_plans": [1] * 3 + [2] * 3 + [3] * 3}


@pytest.mark.parametrize("reuse", [False, True])
@pytest.mark.parametrize("shape", [(), (2,)])
@pytest.mark.parametrize("mapped", [False, True])
def test_every_episode_begins_with_a_new_plan_without_an_init_tracker(
    mapped: bool, shape: tuple[int, ...], reuse: bool
) -> None:
    # A plan of 8 options, of which an episode of 3 takes the first three.
    env = TransformedEnv(ChainEnv(length=9, batch_size=shape), TimeLimit(3))
    state_map = (lambda td: td.select("state")) if mapped else None
    policy = HierarchicalPolicy(MCTSPlanner(ChainEnv(length=9)), reuse=reuse, state_map=state_map)
    run = env.rollout(9, policy, break_when_any_done=False)
    for key, values in EPISODES.items():
        assert run[key].reshape(-1, 9).tolist() == [values] * torch.Size(shape).numel()


class TimeLimit(StepCounter):
    """Truncates episodes, by a count that goes by a name that no policy knows."""

    def __init__(self, max_steps: int) -> None:
        super().__init__(max_steps, step_count_key="clock")


def test_a_collector_gives_every_episode_a_new_plan() -> None:
    env = TransformedEnv(ChainEnv(length=9), TimeLimit(3))
    policy = HierarchicalPolicy(MCTSPlanner(ChainEnv(length=9)))
    size = {"frames_per_batch": 9, "total_frames": 9}
    collector = Collector(env, policy, auto_register_policy_transforms=False, **size)
    batch = next(iter(collector))
    assert {key: batch[key].flatten().tolist() for key in EPISODES} == EPISODES
    collector.shutdown()


def test_only_the_elements_that_begin_again_plan_again() -> None:
    env, planner = ChainEnv(9), CountingPlanner(ChainEnv(9))
    policy = HierarchicalPolicy(planner)
    td = at(env, [0, 2, 4])
    for _ in range(4):  # the last one reaches the end, and is reset to 0
        _, td = env.step_and_maybe_reset(policy(td))
    policy(td)
    assert planner.asked == [[0, 2, 4], [0]]
    assert td["plan_step"].flatten().tolist() == [5, 5, 1]


def test_a_state_that_was_set_in_between_is_planned_for() -> None:
    env, planner = ChainEnv(9), CountingPlanner(ChainEnv(9))
    policy = HierarchicalPolicy(planner)
    _, td = env.step_and_maybe_reset(policy(at(env, [0, 0])))
    td["state"] = torch.tensor([1, 5])  # the first is where its step led
    policy(td)
    assert planner.asked == [[0, 0], [5]]


def test_a_count_of_zero_begins_an_episode_in_a_copy_that_shows_no_step() -> None:
    env, planner = TransformedEnv(ChainEnv(9), StepCounter()), CountingPlanner(ChainEnv(9))
    policy = HierarchicalPolicy(planner)
    td = policy(env.reset()).clone()
    td = policy(td.update(env.reset()))
    assert planner.asked == [[0], [0]]
    td = td.clone().set("step_count", torch.tensor([4]))
    policy(td)
    assert len(planner.asked) == 2


def test_a_policy_that_was_pickled_goes_on_with_the_plan_in_the_tensordict() -> None:
    env = ChainEnv(9)
    policy = HierarchicalPolicy(MCTSPlanner(ChainEnv(9)))
    _, td = env.step_and_maybe_reset(policy(env.reset()))
    td = copy.deepcopy(policy)(td.clone())
    assert (td["plan_step"].item(), td["num_plans"].item()) == (2, 1)


# ---------------------------------------------------------------------- closed loop


def test_a_plan_is_made_anew_after_every_k_options() -> None:
    env = ChainEnv(6)
    planner = CountingPlanner(env)
    rollout = env.rollout(20, policy=HierarchicalPolicy(planner, replan_every=2))
    assert planner.asked == [[0], [2], [4]]
    assert rollout["action"].tolist() == [1] * 5
    assert rollout["plan_step"].flatten().tolist() == [1, 2, 1, 2, 1]
    assert rollout["plan_length"].flatten().tolist() == [5, 5, 3, 3, 1]
    assert rollout["num_plans"].flatten().tolist() == [1, 1, 2, 2, 3]


@pytest.mark.parametrize("reuse", [False, True])
def test_only_closed_loop_control_reaches_the_goal_where_the_real_env_differs(reuse: bool) -> None:
    real = TableEnv(SLIPPERY_ROAD, terminal=[5])
    model = TableEnv(ROAD, terminal=[5])

    def states(**kwargs: Any) -> list[int]:
        policy = HierarchicalPolicy(MCTSPlanner(model), reuse=reuse, **kwargs)
        return real.rollout(6, policy=policy)["next", "state"].tolist()

    # The plan of five times option 1 goes on in state 6, where it leads nowhere.
    assert states() == [1, 2, 6, 6, 6, 3]
    assert states(divergence=0.5, divergence_key="state") == [1, 2, 6, 3, 4, 5]
    assert states(replan_every=1) == [1, 2, 6, 3, 4, 5]


def test_a_plan_is_kept_up_to_the_divergence_that_is_allowed() -> None:
    real = TableEnv(SLIPPERY_ROAD, terminal=[5])
    planner = MCTSPlanner(TableEnv(ROAD, terminal=[5]))
    # State 6 instead of 3, then 6 instead of 4 and of 5: distances of 3, 2 and 1.
    for divergence, num_plans in ((2.5, [1, 1, 1, 2]), (3.0, [1, 1, 1, 1])):
        policy = HierarchicalPolicy(planner, divergence=divergence, divergence_key="state")
        rollout = real.rollout(4, policy=policy)
        assert rollout["num_plans"].flatten().tolist() == num_plans
    predicted = rollout["plan_states"][0]
    assert predicted.shape == (65, 1)
    assert predicted[:6].flatten().tolist() == [0, 1, 2, 3, 4, 5]


def test_only_the_element_that_diverged_plans_again() -> None:
    real = TableEnv(SLIPPERY_ROAD, terminal=[5])
    planner = CountingPlanner(TableEnv(ROAD, terminal=[5]))
    policy = HierarchicalPolicy(planner, divergence=0.5, divergence_key="state")
    rollout = real.rollout(
        6, policy, tensordict=at(real, [0, 3]), auto_reset=False, break_when_all_done=True
    )
    assert planner.asked == [[0, 3], [6]]
    assert rollout["num_plans"][..., 0].tolist() == [[1, 1, 1, 2, 2, 2], [1, 1, 1, 1, 1, 1]]
    assert rollout["next", "done"].squeeze(-1).sum(-1).tolist() == [1, 5]


# ---------------------------------------------------------------------- trees that are kept


@pytest.mark.parametrize("shape", [(), (2,), (2, 1)])
def test_kept_trees_give_the_options_of_new_ones_with_less_simulation(
    shape: tuple[int, ...],
) -> None:
    actions, calls = {}, {}
    for reuse in (False, True):
        real = TableEnv(BINARY_TREE, terminal=LEAVES)
        model = CountingEnv(BINARY_TREE, terminal=LEAVES)
        policy = HierarchicalPolicy(MCTSPlanner(model, budget=FOREVER), replan_every=1, reuse=reuse)
        rollout = real.rollout(
            5, policy, tensordict=at(real, torch.zeros(shape, dtype=torch.int64)), auto_reset=False
        )
        actions[reuse], calls[reuse] = rollout["action"].flatten().tolist(), len(model.calls)
        assert rollout["num_plans"].flatten()[:3].tolist() == [1, 2, 3]
    assert actions[True] == actions[False] == [1] * 3 * torch.Size(shape).numel()
    # All 7 inner states, then the 3 and the 1 of the subtree that was entered, which are known.
    assert calls == {False: 7 + 3 + 1, True: 7}


def test_each_element_keeps_its_own_tree_and_plans_at_its_own_time() -> None:
    real, model = TableEnv(ROAD, terminal=[5]), CountingEnv(ROAD, terminal=[5])
    policy = HierarchicalPolicy(MCTSPlanner(model), max_plan_length=2, reuse=True)
    rollout = real.rollout(
        20, policy, tensordict=at(real, [0, 3, 4]), auto_reset=False, break_when_all_done=True
    )
    assert rollout["next", "done"].squeeze(-1).sum(-1).tolist() == [1, 4, 5]
    assert rollout["num_plans"][0].flatten().tolist() == [1, 1, 2, 2, 3]
    assert rollout["action"][0].tolist() == [1] * 5
    # Every tree holds the way to its end after the first search: nothing is simulated again.
    num_calls = len(model.calls)
    policy.reset()
    policy(at(real, [0, 3, 4]))
    assert len(model.calls) == 2 * num_calls


def test_kept_trees_do_not_outlive_a_reset_another_shape_or_an_error() -> None:
    model = CountingEnv(ROAD, terminal=[5])
    policy = HierarchicalPolicy(MCTSPlanner(model), reuse=True, replan_every=1)

    def simulates(td: TensorDictBase) -> bool:
        model.calls.clear()
        policy(td)
        return len(model.calls) > 0

    def stepped(td: TensorDictBase) -> TensorDictBase:
        return td.update(model.step(td.clone())["next"].select("state", "action_mask"))

    td = at(model, [0])
    assert simulates(td)
    assert not simulates(stepped(td))
    policy.reset()
    assert simulates(stepped(td))
    assert simulates(at(model, [0, 0]))
    td = at(model, [0])
    assert simulates(td)
    broken = stepped(td).clone()
    with pytest.raises(ValueError, match="lacks"):
        policy(broken.exclude("action_mask"))
    assert simulates(td)


def test_a_rollout_with_another_state_than_the_trees_gets_plans_of_its_own() -> None:
    env = ChainEnv(6)
    policy = HierarchicalPolicy(MCTSPlanner(env), reuse=True, replan_every=1)
    td = policy(at(env, [2]))
    td["state"] = torch.tensor([1])  # not where option 1 leads
    td = policy(td)
    assert td["plan"][0, :4].tolist() == [1, 1, 1, 1]
    assert td["plan_length"].item() == 4


# ---------------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"max_plan_length": 0}, "max_plan_length >= 1; got 0"),
        ({"replan_every": 0}, "replan_every >= 1; got 0"),
        ({"divergence": 0.5}, "divergence=0.5 and divergence_key=None"),
        ({"divergence_key": "state"}, "divergence=None and divergence_key='state'"),
        ({"divergence": -1.0, "divergence_key": "state"}, "divergence >= 0.0.*got -1.0"),
        ({"divergence": 1.0, "divergence_key": "place"}, "reads 'place', which ChainEnv does not"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HierarchicalPolicy(MCTSPlanner(ChainEnv(3)), **kwargs)
