"""Transpositions: equal states are searched once, and their values are exact in the end."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_hmcts.planners import (
    MCTSPlanner,
    RadiusNovelty,
    Search,
    SearchBudget,
    SearchTree,
    Transpositions,
)
from torchrl_hmcts.testing import ChainEnv, TableEnv

PRUNED = 8
ENOUGH = SearchBudget(expansions=10_000, until_plan=False)
Table = dict[tuple[int, int], tuple[int, float, int]]


# ---------------------------------------------------------------------- by itself


def test_states_are_the_bytes_of_their_entries_side_by_side() -> None:
    td = TensorDict(
        {
            "tile": torch.tensor([[1, 2], [1, 3]], dtype=torch.int16),
            ("agent", "alive"): torch.tensor([True, False]),
            "x": torch.tensor([0.5, 0.5]),
        },
        [2],
    )
    got = Transpositions(["tile", ("agent", "alive"), "x"]).codes(td)
    half = np.array([0.5], np.float32).tobytes()
    assert [row.tobytes() for row in got] == [
        np.array([1, 2], np.int16).tobytes() + b"\x01" + half,
        np.array([1, 3], np.int16).tobytes() + b"\x00" + half,
    ]


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), num_bytes=st.sampled_from([1, 2, 8, 33]))
def test_states_are_found_as_in_a_dictionary(seed: int, num_bytes: int) -> None:
    rng = np.random.default_rng(seed)
    known, held = Transpositions("state"), [{}, {}, {}]  # type: ignore[var-annotated]
    known.start(3)
    for wave in range(6):
        size = int(rng.choice([0, 1, 200]))
        roots = rng.integers(3, size=size)
        states = np.zeros((size, num_bytes), np.uint8)
        states[:, [0, -1]] = rng.integers(rng.choice([4, 256]), size=(size, 2))
        nodes = 200 * wave + np.arange(size)
        expected = []
        for root, state, node in zip(roots, states, nodes.tolist(), strict=True):
            twin = held[root].setdefault(state.tobytes(), node)
            expected.append(-1 if twin == node else twin)
        assert known.find(roots, states, nodes).tolist() == expected
        if rng.random() < 0.3:
            known.restart(1)
            held[1].clear()


# ---------------------------------------------------------------------- random processes


def random_table(seed: int) -> tuple[Table, list[int], float]:
    """Transitions with cycles, self-loops, dead ends by mask, durations and terminal states."""
    rng = random.Random(seed)
    num_states, num_options = rng.randint(3, 12), rng.randint(1, 4)
    terminal = [s for s in range(1, num_states) if rng.random() < 0.15]
    table: Table = {}
    for state in set(range(num_states)) - set(terminal):
        allowed = [a for a in range(num_options) if rng.random() < 0.7]
        for option in allowed or [rng.randrange(num_options)]:
            reward = rng.choice([0.0, 1.0, rng.uniform(-1.0, 1.0)])
            table[state, option] = (rng.randrange(num_states), reward, rng.randint(1, 4))
    return table, terminal, rng.choice([0.5, 0.9, 0.97])


def value_iteration(table: Table, terminal: list[int], gamma: float) -> dict[int, float]:
    values = dict.fromkeys([*terminal, *(s for s, _ in table)], 0.0)
    change = 1.0
    while change > 1e-12:
        found = dict.fromkeys(values, -math.inf) | dict.fromkeys(terminal, 0.0)
        for (state, _), (next_state, reward, k) in table.items():
            found[state] = max(found[state], reward + gamma**k * values[next_state])
        change = max(abs(found[state] - values[state]) for state in values)
        values = found
    return values


def reachable(table: Table, start: int) -> set[int]:
    found, edge = {start}, [start]
    while edge:
        state = edge.pop()
        for (s, _), (next_state, _, _) in table.items():
            if s == state and next_state not in found:
                found.add(next_state)
                edge.append(next_state)
    return found


def states_of(search: Search, b: int) -> list[int]:
    assert search.tree.states is not None
    states: list[int] = search.tree.states["state"][b, : search.tree.num_nodes[b]].tolist()
    return states


def check_exact(search: Search, exact: dict[int, float]) -> None:
    """Every value of an exhausted search is that of value iteration."""
    tree = search.tree
    for b in range(search.num_roots):
        assert search.exhausted(np.array([b]))[0]
        wanted = [exact[state] for state in states_of(search, b)]
        used = len(wanted)
        assert tree.nodes["value"][b, :used].tolist() == pytest.approx(wanted, rel=1e-5, abs=1e-5)


def check_twins(search: Search) -> None:
    """A twin is a node of the same state that is itself searched."""
    tree = search.tree
    for b in range(search.num_roots):
        states = states_of(search, b)
        twins = tree.nodes["twin"][b, : len(states)]
        for node in np.flatnonzero(twins >= 0).tolist():
            assert twins[node] < len(states)
            assert states[twins[node]] == states[node]
            assert twins[twins[node]] < 0
            assert tree.nodes["flags"][b, node] & PRUNED
            assert (tree.edges["child"][b, node] < 0).all()


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    expand=st.sampled_from(["all", "one"]),
    leaves=st.sampled_from([1, 3]),
)
def test_an_exhausted_search_has_the_values_of_value_iteration(
    seed: int, expand: str, leaves: int
) -> None:
    table, terminal, gamma = random_table(seed)
    if not table:
        return
    env = TableEnv(table, terminal=terminal)
    starts = sorted({s for s, _ in table})[:4]
    planner = MCTSPlanner(
        env,
        gamma=gamma,
        backup="max",
        transpositions=Transpositions("state"),
        expand=expand,
        leaves_per_wave=leaves,
        budget=ENOUGH,
    )
    roots = TensorDict({"state": torch.tensor(starts)}, [len(starts)])
    search = planner.search(env.reset(roots, set_state=True))
    check_twins(search)
    check_exact(search, value_iteration(table, terminal, gamma))
    for b, start in enumerate(starts):
        tree = search.tree
        expanded = (tree.edges["child"][b, : tree.num_nodes[b]] >= 0).any(-1)
        searched = np.array(states_of(search, b))[expanded]
        # Each reachable state once: that it is at most their number would also hold for none.
        assert sorted(searched.tolist()) == sorted(reachable(table, start) - set(terminal))
    found = search.statistics()
    assert found["transpositions_found"] == found["transposed"]


def led_to(tree: SearchTree, b: int, option: int) -> int:
    """The node an option of the root led to, or the one that is searched in its place."""
    child = int(tree.edges["child"][b, 0, option])
    twin = int(tree.nodes["twin"][b, child])
    return twin if twin >= 0 else child


def subtree(tree: SearchTree, b: int, first: int) -> dict[tuple[int, ...], tuple[float, int]]:
    """Values and visits of a node and all below it, by the options that lead there."""
    nodes, paths = tree.nodes[b], {first: ()}
    for n in range(first + 1, int(tree.num_nodes[b])):
        if int(nodes["parent"][n]) in paths:
            paths[n] = (*paths[int(nodes["parent"][n])], int(nodes["option"][n]))
    return {path: (float(nodes["value"][n]), int(nodes["visits"][n])) for n, path in paths.items()}


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), expansions=st.integers(1, 30))
def test_after_the_roots_move_the_kept_values_stay_and_the_search_ends_exact(
    seed: int, expansions: int
) -> None:
    table, terminal, gamma = random_table(seed)
    if not table:
        return
    env = TableEnv(table, terminal=terminal)
    planner = MCTSPlanner(
        env,
        gamma=gamma,
        backup="max",
        transpositions=Transpositions("state"),
        budget=SearchBudget(expansions=expansions, until_plan=False),
    )
    starts = [s for s, _ in table][:3]
    td = env.reset(TensorDict({"state": torch.tensor(starts)}, [len(starts)]), set_state=True)
    search = planner.search(td)
    for _ in range(3):
        tree = search.tree
        options = planner.choose(search)
        before = [subtree(tree, b, led_to(tree, b, int(options[b]))) for b in range(len(starts))]
        over = td["done"].squeeze(-1) if "done" in td.keys() else torch.zeros(len(starts)).bool()
        if over.any():
            return
        td = env.step(td.set("action", torch.from_numpy(options)))["next"]
        kept = planner.advance(search, torch.from_numpy(options), td)
        check_twins(search)
        for b in np.flatnonzero(kept.numpy()):
            after = subtree(tree, b, 0)
            assert after == before[b]
        planner.resume(search)
        check_twins(search)
    planner.budget = ENOUGH
    planner.resume(search)
    check_twins(search)
    check_exact(search, value_iteration(table, terminal, gamma))


def test_a_twin_whose_searched_node_is_dropped_is_searched_itself() -> None:
    # 0 leads to 1 and 2, 1 to 3, and 2 to 3 by both options; 3 is searched below 1. After a move to
    # 2 that is gone: the first 3 below 2 is searched, and the second takes its value from it.
    table = {(0, 0): (1, 0.0, 1), (0, 1): (2, 0.0, 1), (1, 0): (3, 0.0, 1), (2, 0): (3, 0.0, 1)}
    table |= {(2, 1): (3, 0.0, 2), (3, 0): (4, 1.0, 1)}
    env = TableEnv(table, terminal=[4])
    planner = MCTSPlanner(
        env,
        gamma=0.5,
        backup="max",
        transpositions=Transpositions("state"),
        budget=ENOUGH,
    )
    td = env.reset()
    search = planner.search(td)
    assert states_of(search, 0) == [0, 1, 2, 3, 3, 3, 4]
    assert search.tree.nodes["twin"][0, :7].tolist() == [-1, -1, -1, -1, 3, 3, -1]
    assert search.tree.nodes["value"][0, :7].tolist() == [0.25, 0.5, 0.5, 1.0, 1.0, 1.0, 0.0]
    td = env.step(td.set("action", torch.tensor(1)))["next"]
    assert planner.advance(search, torch.tensor(1), td).item()
    assert states_of(search, 0) == [2, 3, 3]
    assert search.tree.nodes["twin"][0, :3].tolist() == [-1, -1, 1]
    assert search.tree.nodes["value"][0, :3].tolist() == [0.5, 1.0, 1.0]
    assert not search.exhausted(np.array([0]))[0]
    planner.resume(search)
    assert states_of(search, 0) == [2, 3, 3, 4]
    assert search.tree.nodes["value"][0, :4].tolist() == [0.5, 1.0, 1.0, 0.0]


def test_a_search_that_is_resumed_after_another_remembers_its_own_states() -> None:
    env = ChainEnv(40)
    planner = MCTSPlanner(
        env,
        transpositions=Transpositions("state"),
        budget=SearchBudget(expansions=10, until_plan=False),
    )
    first = planner.search(TensorDict({"state": torch.tensor([0, 20, 30])}, [3]))
    planner.search(env.reset().set("state", torch.tensor(12)))
    planner.resume(first)
    check_twins(first)


def test_a_known_state_is_not_put_to_the_novelty_test() -> None:
    # Of 0 ... 8, one radius apart, each is accepted once; stepping left comes back to a twin.
    planner = MCTSPlanner(
        ChainEnv(10), novelty=RadiusNovelty("state", 1.0), transpositions=Transpositions("state")
    )
    counts = planner.search(ChainEnv(10).reset()).statistics()
    assert counts["novelty_tested"] == 9  # the root, and 1 ... 8; 9 is terminal
    assert counts["novelty_refused"] == 0
    assert counts["transpositions_found"] == counts["transposed"] == counts["pruned"] == 9


# ---------------------------------------------------------------------- mazes
