"""Subtree reuse: what stays of a tree when its root moves along with the env, and what does not."""

from __future__ import annotations

import copy
import pickle
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from search_parts import FOREVER, LEAVES, CountingEnv, at, binary_tree, expansions, simulations
from tensordict import TensorDictBase

from torchrl_hmcts.planners import (
    PUCT,
    DirichletNoise,
    Gumbel,
    MCTSPlanner,
    ProgressiveWidening,
    RadiusNovelty,
    Search,
    SearchBudget,
    Transpositions,
)
from torchrl_hmcts.planners.tree import CLOSED, FORBIDDEN, PRUNED, TERMINAL
from torchrl_hmcts.testing import ChainEnv, TableEnv

BINARY_TREE = binary_tree(slower=1)


@dataclass
class Node:
    """A node and all below it, out of the arrays."""

    state: int
    visits: int
    value: float
    reward: float
    discount: float
    depth: int
    base_steps: int
    flags: int
    priors: list[float]
    edge_visits: list[int]
    edge_values: list[float]
    closed: list[int]
    children: list[list[Node]]  # the outcomes of each option


def walk(search: Search, b: int, n: int = 0) -> Node:
    """A copy of the tree of root ``b`` from node ``n`` on."""
    node, edges = search.tree.nodes[b, n], search.tree.edges[b, n]
    assert search.tree.states is not None
    return Node(
        state=int(search.tree.states["state"][b, n]),
        visits=int(node["visits"]),
        value=float(node["value"]),
        reward=float(node["reward"]),
        discount=float(node["discount"]),
        depth=int(node["depth"]),
        base_steps=int(node["base_steps"]),
        flags=int(node["flags"]),
        priors=edges["prior"].tolist(),
        edge_visits=edges["visits"].tolist(),
        edge_values=edges["value"].tolist(),
        closed=edges["closed"].tolist(),
        children=[
            [walk(search, b, child) for child in search.tree.outcomes(b, option, n)]
            for option in range(len(edges))
        ],
    )


def count(node: Node) -> int:
    return 1 + sum(count(child) for outcomes in node.children for child in outcomes)


def rebased(node: Node, depth: int, base_steps: int, root: bool = True) -> Node:
    """The copy as it should be when its first node has become the root."""
    node.depth -= depth
    node.base_steps -= base_steps
    if root:
        node.reward, node.discount = 0.0, 1.0
    for outcomes in node.children:
        for child in outcomes:
            rebased(child, depth, base_steps, root=False)
    return node


# ---------------------------------------------------------------------- what is kept


def test_the_best_plan_is_that_of_the_kept_subtree() -> None:
    # Option 0 leads to 1, which pays 8 at once; option 1 to 2, which pays 1 in two steps.
    table = {
        (0, 0): (1, 0.0, 1),
        (0, 1): (2, 0.0, 1),
        (1, 0): (4, 8.0, 1),
        (2, 0): (3, 0.0, 1),
        (3, 0): (4, 1.0, 1),
    }
    env = TableEnv(table, terminal=[4])
    planner = MCTSPlanner(env, gamma=0.5, budget=FOREVER)
    for option, state, options, best in ((0, 1, [0], 8.0), (1, 2, [0, 0], 0.5)):
        search = planner.search(at(env, 0))
        assert search.best_return.tolist() == [4.0]
        planner.advance(search, torch.tensor(option), at(env, state))
        assert search.best_return.tolist() == [best]
        assert search.tree.options(0, int(search.best_node[0])) == options


def test_a_search_goes_on_below_the_kept_root_and_comes_to_the_values_of_a_new_one() -> None:
    env = CountingEnv(BINARY_TREE, terminal=LEAVES)
    budget = expansions(2)
    planner = MCTSPlanner(env, gamma=0.9, backup="max", budget=budget, seed=0)
    search = planner.search(at(env, [0]))  # expands 0 and one of its children
    expanded = int(search.tree.nodes["parent"][0, 3])
    option = int(search.tree.nodes["option"][0, expanded])
    child_state = 1 + option
    env.calls.clear()
    planner.advance(search, torch.tensor([option]), at(env, [child_state]))
    assert env.calls == []  # nothing is simulated before resume
    assert search.tree.num_nodes.tolist() == [3]
    planner.resume(search)
    assert sorted(state for state, _ in env.pairs) == sorted(
        [2 * child_state + 1, 2 * child_state + 2] * 2
    )
    assert search.num_expansions.tolist() == [2]  # counted afresh
    new = planner.search(at(env, [child_state]))
    planner.resume(new)
    assert search.tree.nodes["value"][0, 0] == new.tree.nodes["value"][0, 0]


# ---------------------------------------------------------------------- what is not


def test_an_end_that_the_tree_does_not_know_of_plants_a_tree_that_has_ended() -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(env, budget=FOREVER)
    search = planner.search(at(env, [0]))
    td = at(env, [2]).set("done", torch.ones(1, 1, dtype=torch.bool))  # e.g. a time limit outside
    assert planner.advance(search, torch.tensor([1]), td).tolist() == [False]
    assert search.exhausted(np.array([0])).all()
    assert search.tree.nodes["flags"][0, 0] & TERMINAL


def test_each_root_of_a_batch_keeps_its_tree_or_gets_a_new_one() -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(env, gamma=0.9, budget=FOREVER)
    search = planner.search(at(env, [[0, 0], [0, 0]]))
    before = walk(search, 3, search.tree.outcomes(3, 0)[0])
    options = torch.tensor([[1, -1], [1, 0]])
    kept = planner.advance(search, options, at(env, [[2, 2], [1, 1]]))
    assert kept.tolist() == [[True, False], [False, True]]
    assert search.tree.num_nodes.tolist() == [7, 1, 1, 7]
    assert walk(search, 3) == rebased(before, depth=1, base_steps=1)
    planner.resume(search)
    assert search.num_expansions.tolist() == [0, 3, 3, 0]
    for b, state in enumerate((2, 2, 1, 1)):
        new = planner.search(at(env, [state]))
        assert search.tree.nodes["visits"][b, 0] == new.tree.nodes["visits"][0, 0] == 7


def test_roots_that_are_left_out_stay_as_they_are() -> None:
    env = CountingEnv(BINARY_TREE, terminal=LEAVES)
    budget = expansions(1)
    planner = MCTSPlanner(env, budget=budget)
    search = planner.search(at(env, [0, 0]))
    before = walk(search, 0)
    where = torch.tensor([False, True])
    env.calls.clear()
    kept = planner.advance(search, torch.tensor([0, 0]), at(env, [9, 1]), where=where)
    assert kept.tolist() == [False, True]
    planner.resume(search, where=where)
    assert walk(search, 0) == before
    assert env.pairs == [(1, 0), (1, 1)]


def test_several_options_are_followed_at_once() -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(env, gamma=0.9, budget=FOREVER)
    search = planner.search(at(env, [0, 0, 0]))
    (child,) = search.tree.outcomes(0, 1)
    (grandchild,) = search.tree.outcomes(0, 0, child)
    before = walk(search, 0, grandchild)
    options = torch.tensor([[1, 0], [1, -1], [1, 0]])
    kept = planner.advance(search, options, at(env, [5, 2, 6]))
    assert kept.tolist() == [True, True, False]
    assert walk(search, 0) == rebased(before, depth=2, base_steps=3)
    assert search.tree.num_nodes.tolist() == [3, 7, 1]


@pytest.mark.parametrize(
    ("options", "states", "message"),
    [
        (torch.tensor([1]), [2, 2], r"for the 2 roots .* options \[1\], states \[2\]"),
        (torch.tensor([1, 1]), [2], r"for the 2 roots .* options \[2\], states \[1\]"),
        (torch.zeros(2, 1, 1, dtype=torch.int64), [2, 2], r"got options \[2, 1, 1\]"),
        (torch.tensor([0, 2]), [2, 2], "options below 2; got 2"),
    ],
)
def test_options_and_states_must_fit_the_search(
    options: torch.Tensor, states: list[int], message: str
) -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(env, budget=FOREVER)
    search = planner.search(at(env, [0, 0]))
    with pytest.raises(ValueError, match=message):
        planner.advance(search, options, at(env, states))
    assert search.tree.num_nodes.tolist() == [15, 15]


# ---------------------------------------------------------------------- with the other parts


def test_noise_is_drawn_anew_for_the_kept_root_only() -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(
        env, tree_policy=PUCT(), root_noise=DirichletNoise(), budget=FOREVER, seed=0
    )
    search = planner.search(at(env, [0]))
    planner.advance(search, torch.tensor([1]), at(env, [2]), seed=7)
    priors = search.tree.edges["prior"][0]
    assert priors[0].sum() == pytest.approx(1.0)
    assert priors[0, 0] != 0.5
    assert (priors[1:7] == 0.5).all()
    noisy = priors[0].copy()
    again = planner.search(at(env, [0]), seed=3)
    planner.advance(again, torch.tensor([1]), at(env, [2]), seed=7)
    assert (again.tree.edges["prior"][0, 0] == noisy).all()


def test_the_memory_of_the_novelty_test_is_that_of_the_kept_subtree() -> None:
    env = ChainEnv(12)
    # Every state is new once; a second node of it is refused.
    novelty = RadiusNovelty("state", radius=0.5, max_relaxations=0)
    budget = expansions(3)
    planner = MCTSPlanner(env, novelty=novelty, budget=budget, tree_policy=PUCT(), seed=0)
    search = planner.search(at(env, [3]))  # expands 3, 2 and 4
    states = search.tree.states
    assert states is not None

    def refused() -> list[int]:
        flags = search.tree.nodes["flags"][0, : search.tree.num_nodes[0]]
        return states["state"][0][np.flatnonzero(flags & PRUNED)].tolist()

    assert refused() == [3, 3]  # both ways back
    assert planner.advance(search, torch.tensor([1]), at(env, [4])).tolist() == [True]
    # The old root is forgotten, so that its state is new below the new one.
    assert states["state"][0, :3].tolist() == [4, 3, 5]
    assert refused() == []
    planner.resume(search)
    assert search.num_expansions.tolist() == [3]
    assert refused().count(4) == 2  # both ways back, from 3 and from 5


def test_a_root_is_never_refused() -> None:
    env = ChainEnv(12)
    novelty = RadiusNovelty("state", radius=1.5, max_relaxations=0)
    planner = MCTSPlanner(env, novelty=novelty, budget=FOREVER)
    search = planner.search(at(env, [3]))
    (right,) = search.tree.outcomes(0, 1)
    assert search.tree.nodes["flags"][0, right] & PRUNED  # 4 lies within 1.5 of 3
    assert search.exhausted(np.array([0])).all()
    assert planner.advance(search, torch.tensor([1]), at(env, [4])).tolist() == [True]
    assert not search.tree.nodes["flags"][0, 0] & (PRUNED | CLOSED)
    planner.resume(search)
    assert search.num_expansions.tolist() == [1]


def with_twins() -> tuple[TableEnv, MCTSPlanner]:
    """0 leads to 1 by option 0 and to 2 by option 1, both lead to 3, and 3 to the end."""
    table = {(0, 0): (1, 0.0, 1), (0, 1): (2, 0.0, 1), (1, 0): (3, 0.0, 1), (2, 0): (3, 0.0, 1)}
    table |= {(3, 0): (4, 0.0, 1), (4, 0): (5, 1.0, 1)}
    env = TableEnv(table, terminal=[5])
    planner = MCTSPlanner(
        env, gamma=0.5, transpositions=Transpositions("state"), backup="max", budget=FOREVER
    )
    return env, planner


def test_a_state_whose_twin_is_searched_elsewhere_keeps_the_twins_subtree() -> None:
    env, planner = with_twins()
    for first in (0, 1):
        search = planner.search(at(env, [0]))
        kept = planner.advance(search, torch.tensor([[first, 0]]), at(env, [3]))
        assert kept.tolist() == [True]
        assert search.tree.num_nodes.tolist() == [3]
        assert search.tree.nodes["value"][0, 0] == 0.5
        assert search.tree.nodes["depth"][0, :3].tolist() == [0, 1, 2]


def test_a_subtree_that_leant_on_a_twin_outside_is_opened_again() -> None:
    env, planner = with_twins()
    search = planner.search(at(env, [0]))
    leaning = int(np.flatnonzero(search.tree.nodes["twin"][0, : search.tree.num_nodes[0]] >= 0)[0])
    parent = int(search.tree.nodes["parent"][0, leaning])
    assert search.tree.states is not None
    option, state = search.tree.nodes["option"][0, parent], search.tree.states["state"][0, parent]
    planner.advance(search, torch.tensor([int(option)]), at(env, [int(state)]))
    assert not search.exhausted(np.array([0])).any()
    planner.resume(search)
    assert search.tree.nodes["value"][0, 0] == 0.25
    assert search.best_return.tolist() == [0.25]


class Coin(ChainEnv):
    """A chain on which going right fails every other time it is simulated."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        fails = torch.rand(tensordict.batch_size) < 0.5
        td = tensordict.clone().set("action", tensordict["action"] * ~fails)
        return super()._step(td)


def test_the_outcome_that_came_about_is_kept_out_of_several() -> None:
    env = Coin(8)
    planner = MCTSPlanner(
        env,
        chance=ProgressiveWidening(k=4.0),
        expand="one",
        budget=simulations(60),
    )
    for state in (1, 3):
        search = planner.search(at(env, [2]))
        outcomes = search.tree.outcomes(0, 1)
        assert len(outcomes) == 2
        assert search.tree.states is not None
        (node,) = (n for n in outcomes if search.tree.states["state"][0, n] == state)
        before = walk(search, 0, node)
        kept = planner.advance(search, torch.tensor([1]), at(env, [state]))
        assert kept.tolist() == [True]
        assert walk(search, 0) == rebased(before, depth=1, base_steps=1)
        assert search.tree.nodes["sibling"][0, 0] == -1
        planner.resume(search)
        assert search.num_simulations.tolist() == [60]


def test_halving_starts_anew_since_it_counts_from_zero_visits() -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(env, tree_policy=Gumbel(), expand="one", budget=simulations(8), seed=0)
    search = planner.search(at(env, [0]))
    assert planner.advance(search, torch.tensor([1]), at(env, [2])).tolist() == [False]
    planner.resume(search)
    assert search.tree.edges["visits"][0, 0].sum() == 8


@pytest.mark.parametrize("send", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_search_that_was_copied_or_sent_goes_on_like_the_original(send: Any) -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(env, budget=expansions(2), seed=0)
    planner.search(at(env, [0]))
    again = send(planner)  # as a collector does with its policy
    searches = [planner.last_search, again.last_search]
    assert all(search is not None for search in searches)
    original, copied = (p.resume(s) for p, s in zip((planner, again), searches, strict=True))
    assert walk(copied, 0) == walk(original, 0)
    assert original.tree.num_nodes.tolist() == [9]


# ---------------------------------------------------------------------- random SMDPs


def random_table(rng: np.random.Generator) -> tuple[TableEnv, int]:
    num_states, num_options = int(rng.integers(3, 9)), int(rng.integers(1, 4))
    terminal = [s for s in range(1, num_states) if rng.random() < 0.2]
    table = {}
    for state in range(num_states):
        if state in terminal:
            continue
        allowed = np.flatnonzero(rng.random(num_options) < 0.7).tolist()
        for option in allowed or [0]:
            next_state = int(rng.integers(num_states))
            table[state, option] = (next_state, float(rng.normal()), int(rng.integers(1, 4)))
    return TableEnv(table, terminal=terminal), num_options


def test_the_range_of_values_is_that_of_the_kept_tree() -> None:
    # Option 0 earns 1 and leads to a state whose options earn 3 and 4; option 1 earns 100.
    table = {(0, 0): (1, 1.0, 1), (0, 1): (2, 100.0, 1), (1, 0): (2, 3.0, 1), (1, 1): (2, 4.0, 1)}
    env = TableEnv(table, terminal=[2])
    planner = MCTSPlanner(env, gamma=1.0, tree_policy=PUCT(normalize="tree"), budget=FOREVER)
    td = env.reset()
    search = planner.search(td)
    assert search.roots["highest"][0] == 100.0
    td = env.step(td.set("action", torch.tensor(0)))["next"]
    assert planner.advance(search, torch.tensor(0), td)
    assert (search.roots["lowest"][0], search.roots["highest"][0]) == (3.0, 4.0)


def check_invariants(search: Search, b: int, revisits: bool) -> None:
    """``revisits``: whether known leaves were backed up more than once."""
    tree = search.tree
    n = int(tree.num_nodes[b])
    nodes, edges = tree.nodes[b, :n], tree.edges[b, :n]
    assert nodes["parent"][0] == -1
    assert (nodes["parent"][1:] >= 0).all()
    assert (nodes["parent"] < np.arange(n)).all()
    for i in range(1, n):
        parent, option = nodes["parent"][i], nodes["option"][i]
        assert edges["child"][parent, option] == i
        assert nodes["depth"][i] == nodes["depth"][parent] + 1
        assert nodes["path_return"][i] == pytest.approx(
            nodes["path_return"][parent] + nodes["path_discount"][parent] * nodes["reward"][i],
            abs=1e-4,
        )
    children = edges["child"][edges["child"] >= 0]
    assert sorted(children.tolist()) == list(range(1, n))
    for i in reversed(range(n)):
        leaf = bool(nodes["flags"][i] & (TERMINAL | PRUNED))
        visits = 1 + int(edges["visits"][i].sum())
        if revisits:
            assert nodes["visits"][i] >= visits
        else:
            assert nodes["visits"][i] == visits
        closed = leaf
        if not leaf:
            closed = all(
                edge["closed"] == FORBIDDEN
                or (edge["child"] >= 0 and bool(nodes["flags"][edge["child"]] & CLOSED))
                for edge in edges[i]
            )
            still_open = sum(int(edge["closed"] == 0) for edge in edges[i])
            assert nodes["open_options"][i] == still_open
        assert bool(nodes["flags"][i] & CLOSED) == closed
    rewarded = [float(nodes["path_return"][i]) for i in range(1, n) if nodes["reward"][i] > 0.0]
    if rewarded:
        assert search.best_return[b] == pytest.approx(max(rewarded), abs=1e-5)
    else:
        assert search.best_node[b] == -1
    assert not edges["in_flight"].any()


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_a_tree_stays_consistent_however_often_its_root_moves(seed: int) -> None:
    rng = np.random.default_rng(seed)
    env, num_options = random_table(rng)
    novelty = RadiusNovelty("state", 1.5) if rng.random() < 0.3 else None
    exhausted = str(rng.choice(["skip", "revisit"]))
    planner = MCTSPlanner(
        env,
        gamma=0.9,
        expand=str(rng.choice(["all", "one"])),
        exhausted=exhausted,
        novelty=novelty,
        backup="max" if rng.random() < 0.5 else "mean",
        leaves_per_wave=int(rng.integers(1, 4)),
        budget=SearchBudget(simulations=int(rng.integers(4, 40)), until_plan=False),
        seed=int(seed),
    )
    td = at(env, [env.start, env.start])
    search = planner.search(td)
    for _ in range(3):
        mask = td["action_mask"].float() + 1e-9
        options = torch.multinomial(mask, 1, generator=torch.Generator().manual_seed(seed))[:, 0]
        td = env.step(td.set("action", options))["next"]
        known = [
            any(int(search.tree.states["state"][b, n]) == int(td["state"][b])
                for n in search.tree.outcomes(b, int(options[b])))
            for b in range(2)
        ]  # fmt: skip
        subtrees = [
            walk(search, b, search.tree.outcomes(b, int(options[b]))[0]) if known[b] else None
            for b in range(2)
        ]
        kept = planner.advance(search, options, td)
        assert kept.tolist() == known
        for b, subtree in enumerate(subtrees):
            if subtree is not None:
                assert search.tree.num_nodes[b] == count(subtree)
                assert search.tree.nodes["visits"][b, 0] == subtree.visits
            check_invariants(search, b, exhausted == "revisit")
        planner.resume(search)
        for b in range(2):
            check_invariants(search, b, exhausted == "revisit")
        if td["done"].any():
            break
