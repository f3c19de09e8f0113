"""Rollouts whose nodes stay in the tree.

Letters: B roots, N nodes, A options.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from search_parts import assert_nothing_in_flight
from search_parts import simulations as budget_of
from tensordict import TensorDict

from torchrl_hmcts.planners import (
    UCT,
    Gumbel,
    HighestValue,
    MCTSPlanner,
    SearchBudget,
    TreeRollout,
    WidthNovelty,
)
from torchrl_hmcts.planners.tree import PRUNED
from torchrl_hmcts.testing import ChainEnv


def planner(length: int = 30, simulations: int = 12, **kwargs) -> MCTSPlanner:
    kwargs = {"rollout": TreeRollout(max_options=5), **kwargs}
    return MCTSPlanner(
        ChainEnv(length=length),
        expand="one",
        budget=budget_of(simulations),
        seed=0,
        **kwargs,
    )


def roots(length: int, count: int) -> TensorDict:
    return ChainEnv(length=length).reset().expand(count).clone()


def test_a_rollout_adds_its_nodes_below_the_leaf_one_by_one() -> None:
    search = planner().search(roots(30, 1))
    tree = search.tree
    assert tree.num_nodes[0] == 13
    # Two rollouts: a leaf and five options each.
    assert tree.nodes["parent"][0, 2:7].tolist() == [1, 2, 3, 4, 5]
    assert tree.nodes["parent"][0, 8:13].tolist() == [7, 8, 9, 10, 11]
    # Every node counts all that was simulated through it.
    visits = tree.nodes["visits"][0]
    for node in range(1, 13):
        below = [n for n in range(1, 13) if tree.nodes["parent"][0, n] == node]
        assert visits[node] == 1 + sum(visits[n] for n in below)


def test_what_a_rollout_finds_is_a_plan() -> None:
    env = ChainEnv(length=5)
    found = MCTSPlanner(
        env,
        expand="one",
        rollout=TreeRollout(max_options=50),
        budget=SearchBudget(simulations=400),
        seed=1,
    ).plan(env.reset())
    assert bool(found.found)
    td = env.reset()
    for option in found.options[: int(found.lengths)].tolist():
        td = env.step(td.set("action", torch.tensor(option)))["next"]
    assert td["reward"].item() == 1.0


@pytest.mark.parametrize("leaves", [1, 4])
def test_many_roots_have_the_trees_they_have_alone(leaves: int) -> None:
    together = planner(simulations=40, leaves_per_wave=leaves).search(roots(9, 3), seed=5)
    assert_nothing_in_flight(together)
    for b in range(3):
        alone = planner(simulations=40, leaves_per_wave=leaves).search(roots(9, 1), seed=5 + b)
        count = int(alone.tree.num_nodes[0])
        assert together.tree.num_nodes[b] == count
        for name in ("parent", "option", "visits", "value"):
            np.testing.assert_array_equal(
                together.tree.nodes[name][b, :count], alone.tree.nodes[name][0, :count]
            )


@pytest.mark.parametrize("leaves", [1, 3])
def test_the_budget_of_simulations_is_kept_to_the_last_one(leaves: int) -> None:
    search = planner(simulations=10, leaves_per_wave=leaves).search(roots(30, 2))
    assert search.num_simulations.tolist() == [10, 10]
    assert_nothing_in_flight(search)


def test_a_rollout_ends_where_the_novelty_test_refuses_a_state() -> None:
    env = ChainEnv(length=6)
    search = planner(
        length=6, simulations=60, novelty=WidthNovelty("state", max_relaxations=0)
    ).search(env.reset().unsqueeze(0))
    nodes = search.tree.nodes[0, : search.tree.num_nodes[0]]
    refused = np.flatnonzero(nodes["flags"] & PRUNED)
    assert len(refused)
    assert not np.isin(nodes["parent"], refused).any()
    assert (nodes["flags"] & PRUNED == 0).sum() <= 6  # a chain has no more states


@pytest.mark.parametrize(
    "kwargs", [{"expand": "all"}, {"tree_policy": Gumbel(), "expand": "one"}], ids=str
)
def test_what_does_not_go_with_a_rollout_is_refused(kwargs) -> None:
    with pytest.raises(ValueError, match="TreeRollout continues from the one option"):
        MCTSPlanner(
            ChainEnv(length=3),
            rollout=TreeRollout(),
            budget=budget_of(8),
            **kwargs,
        )


def test_random_ties_choose_among_the_best_and_the_same_again_for_the_same_seed() -> None:
    # Nothing is rewarded within reach: all values are 0.
    search = planner(tree_policy=UCT()).search(roots(30, 64), seed=3)
    assert HighestValue().choose(search).tolist() == [0] * 64
    chosen = HighestValue(random_ties=True).choose(search)
    assert 10 < chosen.sum() < 54
    np.testing.assert_array_equal(chosen, HighestValue(random_ties=True).choose(search))
