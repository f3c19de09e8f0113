"""Training examples from finished searches."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from search_parts import expansions
from tensordict import TensorDict

from torchrl_hmcts.planners import (
    MCTSPlanner,
    SearchBudget,
    extract_plans,
    search_examples,
)
from torchrl_hmcts.planners.search_data import best_plans_below
from torchrl_hmcts.planners.tree import TERMINAL
from torchrl_hmcts.testing import ChainEnv, TableEnv

# Two ways from 0 to the goal 3: one option of 5 base steps that pays 1, or two options of 1 base
# step each over state 1. Option 1 leads to the dead end 2, which goes round for ever.
TABLE = {
    (0, 0): (3, 1.0, 5),
    (0, 1): (2, 0.0, 1),
    (0, 2): (1, 0.0, 1),
    (1, 0): (3, 1.0, 1),
    (1, 1): (2, 0.0, 1),
    (2, 1): (2, 0.0, 1),
}


def table_search(**kwargs: object) -> object:
    env = TableEnv(TABLE, terminal=[3])
    budget = expansions(6)
    return MCTSPlanner(env, gamma=0.5, budget=budget, **kwargs).search(env.reset())


def rows_of(examples: TensorDict, state: int) -> TensorDict:
    return examples[examples["state"].reshape(-1) == state]


def test_the_best_plan_below_a_node_takes_the_higher_discounted_return() -> None:
    search = table_search()
    returns, options = best_plans_below(search)
    states = search.tree.states["state"]
    # 0 straight to the goal: 1. Over state 1: gamma * 1 = 0.5.
    assert returns[0, 0] == 1.0
    assert options[0, 0] == 0
    one = int((states[0, : search.tree.num_nodes[0]] == 1).nonzero()[0])
    assert returns[0, one] == 1.0
    assert options[0, one] == 0
    dead = (states[0, : search.tree.num_nodes[0]] == 2).nonzero().reshape(-1).numpy()
    assert len(dead)
    assert np.isneginf(returns[0, dead]).all()
    assert (options[0, dead] == -1).all()


def test_from_the_roots_it_is_the_return_of_the_extracted_plans() -> None:
    env = ChainEnv(length=6)
    starts = env.reset().expand(3).clone()
    starts["state"] = torch.tensor([0, 2, 4])
    search = MCTSPlanner(env, gamma=0.9).search(starts)
    returns, options = best_plans_below(search)
    plans = extract_plans(search)
    np.testing.assert_allclose(returns[:, 0], plans.returns.numpy(), rtol=1e-6)
    assert options[:, 0].tolist() == plans.options[:, 0].tolist()


def test_examples_of_a_plan_hold_its_states_options_and_returns() -> None:
    env = ChainEnv(length=4)
    examples = search_examples(MCTSPlanner(env, gamma=0.5).search(env.reset()), roots=False)
    assert examples["state"].reshape(-1).tolist() == [0, 1, 2]
    assert examples["value_target"].reshape(-1).tolist() == [0.25, 0.5, 1.0]
    assert examples["policy_target"].tolist() == [[0.0, 1.0]] * 3
    assert examples["policy_weight"].tolist() == [1.0] * 3
    assert examples["value_weight"].tolist() == [1.0] * 3


def test_policy_targets_mix_the_plan_with_the_visits() -> None:
    search = table_search()
    visits = search.tree.edges["visits"][0, 0].astype(float)
    shares = visits / visits.sum()
    plan = np.array([1.0, 0.0, 0.0])
    for share in (0.0, 0.25, 1.0):
        examples = search_examples(search, plans=False, plan_share=share)
        expected = share * plan + (1.0 - share) * shares
        np.testing.assert_allclose(examples["policy_target"][0].numpy(), expected, rtol=1e-6)


def test_every_policy_target_sums_to_one_within_the_mask() -> None:
    search = table_search()
    examples = search_examples(search, min_visits=1, plan_share=0.5)
    weighted = examples[examples["policy_weight"] > 0]
    assert len(weighted) >= 3
    torch.testing.assert_close(weighted["policy_target"].sum(-1), torch.ones(len(weighted)))
    assert not weighted["policy_target"][~weighted["action_mask"]].any()
    # State 1 allows options 0 and 1; state 2 only option 1.
    assert rows_of(examples, 1)["action_mask"].tolist() == [[True, True, False]]
    assert rows_of(examples, 2)["action_mask"][0].tolist() == [False, True, False]


def test_only_nodes_with_enough_visits_are_taken() -> None:
    search = table_search()
    visits = search.tree.nodes["visits"][0]
    few = search_examples(search, roots=False, plans=False, min_visits=3)
    many = search_examples(search, roots=False, plans=False, min_visits=1)
    assert 0 < len(few) < len(many)
    assert (visits[few["node"].numpy()] >= 3).all()


def test_terminal_states_are_no_examples() -> None:
    search = table_search()
    examples = search_examples(search, min_visits=1)
    flags = search.tree.nodes["flags"][0, examples["node"].numpy()]
    assert not (flags & TERMINAL).any()
    assert 3 not in examples["state"]


def test_a_search_without_a_plan_teaches_no_value_unless_asked() -> None:
    env = ChainEnv(length=9)
    budget = SearchBudget(expansions=2)
    search = MCTSPlanner(env, budget=budget, leaf_evaluator=lambda td: torch.full((len(td),), 0.5),
                         backup="max", gamma=0.5).search(env.reset())  # fmt: skip
    silent = search_examples(search)
    assert silent["value_weight"].tolist() == [0.0]
    assert silent["policy_weight"].tolist() == [1.0]
    told = search_examples(search, tree_values=True)
    assert told["value_weight"].tolist() == [1.0]
    assert told["value_target"].item() == search.tree.nodes["value"][0, 0]


def test_a_root_that_was_never_expanded_has_no_weight() -> None:
    env = ChainEnv(length=4)
    planner = MCTSPlanner(env)
    examples = search_examples(planner.plant(env.reset()))
    assert examples["policy_weight"].tolist() == [0.0]
    assert examples["value_weight"].tolist() == [0.0]


def test_examples_are_copies_of_the_tree() -> None:
    env = ChainEnv(length=4)
    search = MCTSPlanner(env).search(env.reset())
    examples = search_examples(search, keys=["state"])
    before = examples["state"].clone()
    search.tree.states["state"].fill_(77)
    assert torch.equal(examples["state"], before)


@pytest.mark.parametrize("kwargs", [{"plan_share": 1.5}, {"plan_share": -0.1}, {"min_visits": 0}])
def test_arguments_out_of_range_are_refused(kwargs: dict) -> None:
    env = ChainEnv(length=4)
    search = MCTSPlanner(env).search(env.reset())
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        search_examples(search, **kwargs)
