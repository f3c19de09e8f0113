"""Search trees worked out by hand, and SMDPs whose values are known in closed form.

The trees are those of this SMDP under ``gamma = 1/2`` (written ``R, D``: reward and discount):

    state 0: option 0 -> 1 (2, 1/8: three base steps)    option 1 -> 2 (1, 1/2: one base step)
    state 1: option 0 -> 3 (4, 0: terminal)              option 1 -> 4 (0, 1/4: two base steps)
    state 2: option 0 -> 4 (1, 1/2: one base step)       option 1 -> 5 (2, 0: terminal)
    state 4: option 0 -> 3 (8, 0: terminal)              option 1 -> 0 (0, 1/2: one base step)

Nodes are numbered in the order of their creation, node 0 is the root; ``N`` visits, ``V`` values.
"""

from __future__ import annotations

import random
from fractions import Fraction as F
from typing import Any

import numpy as np
import pytest
import torch

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    MCTSPlanner,
    Search,
    SearchBudget,
)
from torchrl_hmcts.testing import TableEnv

SMDP = {
    (0, 0): (1, 2.0, 3),
    (0, 1): (2, 1.0, 1),
    (1, 0): (3, 4.0, 1),
    (1, 1): (4, 0.0, 2),
    (2, 0): (4, 1.0, 1),
    (2, 1): (5, 2.0, 2),
    (4, 0): (3, 8.0, 1),
    (4, 1): (0, 0.0, 1),
}
TERMINAL = [3, 5]


def prior(td: Any) -> torch.Tensor:
    """One quarter for option 0, three quarters for option 1, in every state."""
    return torch.tensor([0.25, 0.75]).expand(len(td), 2)


def search_for(expansions: int, **kwargs: Any) -> Search:
    """Searches the SMDP from state 0 for a number of expansions."""
    kwargs.setdefault("gamma", 0.5)
    budget = SearchBudget(expansions=expansions, until_plan=False)
    env = TableEnv(SMDP, terminal=TERMINAL)
    return MCTSPlanner(env, budget=budget, **kwargs).search(env.reset())


def nodes_of(search: Search) -> np.ndarray:
    return search.tree.nodes[0, : search.tree.num_nodes[0]]


def check_nodes(search: Search, visits: list[int], values: list[float | F]) -> None:
    nodes = nodes_of(search)
    assert nodes["visits"].tolist() == visits
    assert nodes["value"].tolist() == pytest.approx([float(v) for v in values], abs=1e-6)


# UCT, c = 1, one option per simulation, mean backup. Scores are Q + sqrt(ln n / n_j).
UCT_ONE_MEAN = [
    # 1: nothing is visited: option 0 to node 1. The root's mean of 0 (its own) and 2.
    ([2, 1], [1, 0]),
    # 2: option 1 is unvisited: node 2. Mean of 0, 2, 1.
    ([3, 1, 1], [1, 0, 0]),
    # 3: Q = 2, 1 at equal counts: option 0; in node 1 option 0, terminal: node 3.
    #    V1 = (0 + 4)/2; the root gets 2 + 4/8 = 5/2: (0 + 2 + 1 + 5/2)/4.
    ([4, 2, 1, 1], [F(11, 8), 2, 0, 0]),
    # 4: Q0 = 2 + 2/8: 2.25 + sqrt(ln 4 / 2) = 3.083 > 1 + sqrt(ln 4) = 2.177. In node 1 option 0 is
    #    closed (terminal): option 1, node 4. V1 = (0 + 4 + 0)/3; the root gets 2.
    ([5, 3, 1, 1, 1], [F(3, 2), F(4, 3), 0, 0, 0]),
    # 5: Q0 = 2 + 4/24: 2.167 + 0.732 > 1 + 1.269. Node 1, node 4, its option 0, terminal: node 5.
    #    V4 = (0 + 8)/2; node 1 gets 8/4 = 2: (0 + 4 + 0 + 2)/4; the root gets 2 + 2/8.
    ([6, 4, 1, 1, 2, 1], [F(13, 8), F(3, 2), 0, 0, 4, 0]),
    # 6: Q0 = 2 + 3/16: 2.188 + 0.669 > 1 + 1.339. Node 1, node 4, its option 1, back to state 0:
    #    node 6. V4 = 8/3; node 1 gets 0: 6/5; the root gets 2: (39/4 + 2)/7.
    ([7, 5, 1, 1, 3, 1, 1], [F(47, 28), F(6, 5), 0, 0, F(8, 3), 0, 0]),
    # 7: Q0 = 2 + 3/20: 2.15 + 0.624 > 1 + 1.395. Node 1, 4, 6, its option 0 to state 1: node 7.
    #    V6 = 2/2; node 4 gets 2/2 = 1: 9/4; node 1 gets 1/4: (6 + 1/4)/6; the root 2 + 1/32.
    ([8, 6, 1, 1, 4, 1, 2, 1], [F(441, 256), F(25, 24), 0, 0, F(9, 4), 0, 1, 0]),
]


@pytest.mark.parametrize("simulations", range(1, 8))
def test_uct_with_mean_backup_grows_the_tree_worked_out_by_hand(simulations: int) -> None:
    search = search_for(simulations, tree_policy=UCT(c=1.0), expand="one")
    check_nodes(search, *UCT_ONE_MEAN[simulations - 1])


def test_nodes_hold_the_reward_and_discount_of_their_option_and_edges_its_value() -> None:
    view = search_for(7, tree_policy=UCT(c=1.0), expand="one").tree.view()
    assert view.num_nodes.tolist() == [8]
    # root, node 1 (state 1), 2 (state 2), 3 (end), 4 (state 4), 5 (end), 6 (state 0), 7 (state 1)
    assert view.children[0, :8].tolist() == [
        [1, 2], [3, 4], [-1, -1], [-1, -1], [5, 6], [-1, -1], [7, -1], [-1, -1],
    ]  # fmt: skip
    assert view.children_visits[0, :8].tolist() == [
        [6, 1], [1, 4], [0, 0], [0, 0], [1, 2], [0, 0], [1, 0], [0, 0],
    ]  # fmt: skip
    assert view.rewards[0, :8].tolist() == [0, 2, 1, 4, 0, 8, 0, 2]
    assert view.discounts[0, :8].tolist() == [1, 1 / 8, 1 / 2, 0, 1 / 4, 0, 1 / 2, 1 / 8]
    # Q = R + D V with the values of simulation 7 above; 0 where nothing was tried
    expected = [
        [2 + F(25, 24) / 8, 1], [4, F(9, 4) / 4], [0, 0], [0, 0],
        [8, F(1, 2)], [0, 0], [2, 0], [0, 0],
    ]  # fmt: skip
    torch.testing.assert_close(
        view.children_values[0, :8], torch.tensor([[float(q) for q in row] for row in expected])
    )
    assert (view.siblings[0, :8] == -1).all()
    assert (view.samples[0, :8] == 1).all()
    assert view.parents[0, :8].tolist() == [-1, 0, 0, 1, 1, 4, 4, 6]
    assert view.parent_options[0, :8].tolist() == [-1, 0, 1, 0, 1, 0, 1, 0]
    assert view.depths[0, :8].tolist() == [0, 1, 1, 2, 2, 3, 3, 4]
    assert view.base_steps[0, :8].tolist() == [0, 3, 1, 4, 5, 6, 6, 9]
    # 2; 1; 2 + 4/8; 2; 2 + 8/32; 2; 2 + 2/64: discounts multiply along the path
    assert view.path_returns[0, :8].tolist() == [0, 2, 1, 2.5, 2, 2.25, 2, 2.03125]
    assert view.states["state"][0, :8].tolist() == [0, 1, 2, 3, 4, 3, 0, 1]
    torch.testing.assert_close(view.children_priors[0, :8], torch.full((8, 2), 0.5))


def test_simulating_all_options_of_a_leaf_backs_up_each_of_them() -> None:
    # Wave 4 expands node 6 (state 0): node 7 as in simulation 7, then node 8 (state 2, R = 1):
    # V6 = (0 + 2 + 1)/3; node 4 gets 1/2: (9 + 1/2)/5; node 1 gets 1/8: (25/4 + 1/8)/7;
    # the root gets 2 + 1/64: (441/32 + 129/64)/9 = (1011/64)/9.
    search = search_for(4, tree_policy=UCT(c=1.0), expand="all")
    check_nodes(
        search,
        [9, 7, 1, 1, 5, 1, 3, 1, 1],
        [F(1011, 576), F(51, 56), 0, 0, F(19, 10), 0, 1, 0, 0],
    )


# The same search with max backup. Node 1 is worth 4 from the moment its terminal option is known.
UCT_ONE_MAX = [
    ([2, 1], [2, 0]),  # 1: max(2)
    ([3, 1, 1], [2, 0, 0]),  # 2: max(2, 1)
    ([4, 2, 1, 1], [F(5, 2), 4, 0, 0]),  # 3: V1 = 4, root max(2 + 4/8, 1)
    ([5, 3, 1, 1, 1], [F(5, 2), 4, 0, 0, 0]),  # 4: V1 = max(4, 0/4)
    ([6, 4, 1, 1, 2, 1], [F(5, 2), 4, 0, 0, 8, 0]),  # 5: V4 = 8, V1 = max(4, 8/4)
    # 6: 2.5 + sqrt(ln 6 / 4) = 3.169 > 1 + sqrt(ln 6) = 2.339; V4 = max(8, 0/2)
    ([7, 5, 1, 1, 3, 1, 1], [F(5, 2), 4, 0, 0, 8, 0, 0]),
]


@pytest.mark.parametrize("simulations", range(1, 7))
def test_uct_with_max_backup_grows_the_tree_worked_out_by_hand(simulations: int) -> None:
    search = search_for(simulations, tree_policy=UCT(c=1.0), backup="max", expand="one")
    check_nodes(search, *UCT_ONE_MAX[simulations - 1])


# PUCT, c = 8, priors 1/4 and 3/4: scores are Q + 2 sqrt(sum)/(1 + n_0), Q + 6 sqrt(sum)/(1 + n_1).
PUCT_ONE_MEAN = [
    # 1: the sum is 0, both score 0, the higher prior wins: option 1 to node 1 (state 2).
    ([2, 1], [F(1, 2), 0]),
    # 2: 2 < 1 + 6/2. In node 1 the prior again: option 1, terminal, R = 2: node 2.
    #    V1 = (0 + 2)/2; the root gets 1 + 2/2: (0 + 1 + 2)/3.
    ([3, 2, 1], [1, 1, 0]),
    # 3: Q1 = 3/2: 2.828 < 1.5 + 2.828. In node 1 option 1 is closed: option 0 to node 3 (state 4).
    #    V1 = (0 + 2 + 1)/3; the root gets 1 + 1/2.
    ([4, 3, 1, 1], [F(9, 8), 1, 0, 0]),
    # 4: 3.464 < 1.5 + 2.598. Node 1, node 3, by its prior option 1: node 4 (state 0), R = 0.
    #    V3 = 0; node 1 gets 1 + 0: 4/4; the root gets 1 + 1/2: (9/2 + 3/2)/5.
    ([5, 4, 1, 2, 1], [F(6, 5), 1, 0, 0, 0]),
    # 5: 4 > 1.5 + 2.4: option 0 at last: node 5 (state 1). The root gets 2: (6 + 2)/6.
    ([6, 4, 1, 2, 1, 1], [F(4, 3), 1, 0, 0, 0, 0]),
    # 6: 2 + sqrt(5) = 4.236 > 1.5 + 6 sqrt(5)/5 = 4.183. In node 5 by the prior option 1:
    #    node 6 (state 4), R = 0. V5 = 0; the root gets 2 + 0/8: (8 + 2)/7.
    ([7, 4, 1, 2, 1, 2, 1], [F(10, 7), 1, 0, 0, 0, 0, 0]),
]


@pytest.mark.parametrize("simulations", range(1, 7))
def test_puct_with_mean_backup_grows_the_tree_worked_out_by_hand(simulations: int) -> None:
    search = search_for(simulations, tree_policy=PUCT(c=8.0), option_prior=prior, expand="one")
    check_nodes(search, *PUCT_ONE_MEAN[simulations - 1])


PUCT_ALL_MAX = [
    # 1: node 1 (state 1), node 2 (state 2): max(2, 1).
    ([3, 1, 1], [2, 0, 0]),
    # 2: 2 + sqrt(2) = 3.414 < 1 + 3 sqrt(2) = 5.243: node 2. Node 3 (state 4): 1; node 4 (end): 2.
    #    V2 = max(1, 2); root max(2, 1 + 2/2).
    ([5, 1, 3, 1, 1], [2, 0, 2, 0, 0]),
    # 3: 2 + 2 = 4 < 2 + 3: node 2, its open option 0: node 3. Node 5 (end): 8; node 6 (state 0): 0.
    #    V3 = 8; V2 = max(1 + 8/2, 2); root max(2, 1 + 5/2).
    ([7, 1, 5, 3, 1, 1, 1], [F(7, 2), 0, 5, 8, 0, 0, 0]),
    # 4: 2 + sqrt(6) = 4.449 < 3.5 + sqrt(6): node 2, node 3, node 6 (state 0): as in 1, V6 = 2.
    #    V3 = max(8, 2/2).
    ([9, 1, 7, 5, 1, 1, 3, 1, 1], [F(7, 2), 0, 5, 8, 0, 0, 2, 0, 0]),
]


@pytest.mark.parametrize("waves", range(1, 5))
def test_puct_with_max_backup_and_all_options_grows_the_tree_worked_out_by_hand(waves: int) -> None:
    search = search_for(waves, tree_policy=PUCT(c=8.0), option_prior=prior, backup="max")
    check_nodes(search, *PUCT_ALL_MAX[waves - 1])


def test_the_leaf_evaluator_counts_at_live_states_and_not_at_terminal_ones() -> None:
    # V = 16 at every state. The root starts at 16; simulation 1 brings 2 + 16/8 = 4, simulation 2
    # brings 1 + 16/2 = 9: (16 + 4 + 9)/3. Then Q = 4, 9: node 2 (state 2), option 0 to node 3:
    # 1 + 16/2 = 9 there: V2 = (16 + 9)/2, and 1 + 9/2 at the root: (29 + 5.5)/4. Then Q1 = 7.25,
    # node 2 again, option 1, terminal: 2, not 2 + 16/4: V2 = 27/3; 1 + 2/2 at the root: 36.5/5.
    values = lambda td: torch.full((len(td),), 16.0)  # noqa: E731
    search = search_for(4, tree_policy=UCT(c=1.0), expand="one", leaf_evaluator=values)
    check_nodes(search, [5, 1, 3, 1, 1], [7.3, 16, 9, 16, 0])
    assert nodes_of(search)["raw_value"].tolist() == [16, 16, 16, 16, 0]


# ---------------------------------------------------------------------- three states


@pytest.mark.parametrize("expand", ["one", "all"])
@pytest.mark.parametrize("backup", ["mean", "max"])
@pytest.mark.parametrize(("gamma", "best"), [(0.9, 1), (0.99, 0), (1.0, 0)])
def test_the_planner_trades_the_length_of_an_option_for_its_reward(
    gamma: float, best: int, backup: Any, expand: Any
) -> None:
    # From 0 to 1: 8 base steps that earn 1, or 1 base step that earns 1/2; then 4 at the end.
    #   long: 1 + 4 gamma^8 = 2.722 (0.9), 4.691 (0.99), 5 (1);
    #   short: 1/2 + 4 gamma = 4.1 (0.9), 4.46 (0.99), 4.5 (1).
    # Were each edge discounted once, the long option would look better under every gamma.
    env = TableEnv({(0, 0): (1, 1.0, 8), (0, 1): (1, 0.5, 1), (1, 0): (2, 4.0, 1)}, terminal=[2])
    closed_form = [1 + 4 * gamma**8, 0.5 + 4 * gamma]
    planner = MCTSPlanner(
        env, gamma=gamma, backup=backup, expand=expand, budget=SearchBudget(until_plan=False)
    )
    td = env.reset()
    plan = planner.plan(td)
    assert plan.options.tolist() == [best, 0]
    assert plan.returns.item() == pytest.approx(closed_form[best], rel=1e-6)
    assert plan.durations.item() == (9, 2)[best]
    assert planner(td)["action"].item() == best
    if backup == "max":
        assert td["root_value"].item() == pytest.approx(max(closed_form), rel=1e-6)


# ---------------------------------------------------------------------- value iteration

Table = dict[tuple[int, int], tuple[int, float, int]]


def optimal_values(table: Table, terminal: list[int], gamma: float) -> list[float]:
    num_states = 1 + max(max(s, row[0]) for (s, _), row in table.items())
    values = [0.0] * num_states
    for _ in range(2000):
        new = [
            max(
                (r + gamma**k * values[s2] for (s1, _), (s2, r, k) in table.items() if s1 == s),
                default=0.0,
            )
            * (s not in terminal)
            for s in range(num_states)
        ]
        if max(abs(a - b) for a, b in zip(new, values, strict=True)) < 1e-12:
            break
        values = new
    return values


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("expand", ["one", "all"])
def test_max_backup_over_an_exhausted_tree_is_the_optimal_value(seed: int, expand: Any) -> None:
    rng = random.Random(seed)
    num_states, gamma = 7, rng.choice([0.7, 0.95, 1.0])
    table: Table = {  # every option leads to a later state, so that the tree is finite
        (s, a): (rng.randint(s + 1, num_states - 1), rng.uniform(-1, 1), rng.randint(1, 6))
        for s in range(num_states - 1)
        for a in range(rng.randint(1, 3))
    }
    env = TableEnv(table, terminal=[num_states - 1])
    planner = MCTSPlanner(
        env,
        gamma=gamma,
        backup="max",
        expand=expand,
        budget=SearchBudget(expansions=10_000, until_plan=False),
    )
    td = planner(env.reset())
    assert planner.last_search is not None
    assert planner.last_search.exhausted(np.array([0])).all()
    best = optimal_values(table, [num_states - 1], gamma)[0]
    assert td["root_value"].item() == pytest.approx(best, abs=1e-5)
