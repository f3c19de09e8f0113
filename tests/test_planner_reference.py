"""The planner against an independent search in plain Python, on random SMDPs.

The reference keeps objects and recomputes from its definitions whatever the planner keeps up to
date: which subtrees are closed, path returns, the best plan. Double precision, no arrays.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    MaxBackup,
    MCTSPlanner,
    MeanBackup,
    Search,
    SearchBudget,
)
from torchrl_hmcts.testing import TableEnv

# ---------------------------------------------------------------------- random SMDPs


@dataclass
class SMDP:
    """A random SMDP: the table of :class:`TableEnv`, and a value and priors for each state."""

    num_states: int
    num_options: int
    gamma: float
    table: dict[tuple[int, int], tuple[int, float, int]]
    terminal: list[int]
    values: list[float]
    priors: list[list[float]]


def random_smdp(seed: int) -> SMDP:
    rng = random.Random(seed)
    num_states, num_options = rng.randint(2, 8), rng.randint(1, 4)
    terminal = [s for s in range(num_states) if rng.random() < 0.2]
    table = {}
    for state in range(num_states):
        if state in terminal:
            continue
        allowed = [a for a in range(num_options) if rng.random() < 0.7]
        for option in allowed or [rng.randrange(num_options)]:
            next_state, reward = rng.randrange(num_states), rng.uniform(-1.0, 1.0)
            # Elsewhere a reward of 0 makes ties between unlike paths, which rounding would break.
            if next_state in terminal and rng.random() < 0.3:
                reward = 0.0
            table[state, option] = (next_state, reward, rng.randint(1, 5))
    if not table:
        return random_smdp(seed + 1_000_003)
    # The env's action spec has as many options as its table names.
    num_options = 1 + max(a for _, a in table)
    priors = []
    for _ in range(num_states):
        weights = [rng.uniform(0.1, 1.0) for _ in range(num_options)]
        priors.append([w / sum(weights) for w in weights])
    return SMDP(
        num_states=num_states,
        num_options=num_options,
        gamma=rng.choice([0.6, 0.9, 0.99, 1.0]),
        table=table,
        terminal=terminal,
        values=[rng.uniform(-1.0, 1.0) for _ in range(num_states)],
        priors=priors,
    )


# ---------------------------------------------------------------------- the reference


@dataclass
class Node:
    state: int
    terminal: bool
    value: float
    number: int
    parent: Node | None = None
    option: int = -1
    reward: float = 0.0
    discount: float = 0.0
    visits: int = 1
    gains: list[float] = field(default_factory=list)
    children: dict[int, Node] = field(default_factory=dict)

    def q(self) -> float:
        return self.reward + self.discount * self.value


class ReferenceSearch:
    """Textbook Monte Carlo tree search with one descent per simulation."""

    def __init__(
        self,
        smdp: SMDP,
        state: int,
        *,
        policy: str,
        c: float,
        backup: str,
        expand: str,
        evaluate: bool,
        use_priors: bool,
    ) -> None:
        self.smdp, self.policy, self.c = smdp, policy, c
        self.backup, self.expand = backup, expand
        self.evaluate, self.use_priors = evaluate, use_priors
        self.root = Node(state, state in smdp.terminal, self.evaluation(state), 0)
        self.nodes = [self.root]

    def evaluation(self, state: int) -> float:
        return self.smdp.values[state] if self.evaluate and state not in self.smdp.terminal else 0.0

    def options(self, node: Node) -> list[int]:
        if node.terminal:
            return []
        return [a for a in range(self.smdp.num_options) if (node.state, a) in self.smdp.table]

    def closed(self, node: Node) -> bool:
        return all(a in node.children and self.closed(node.children[a]) for a in self.options(node))

    def score(self, node: Node, option: int) -> float:
        child = node.children.get(option)
        tried = child.visits if child else 0
        if self.policy == "uct":
            if child is None:
                return math.inf
            return child.q() + self.c * math.sqrt(math.log(node.visits) / tried)
        total = sum(other.visits for other in node.children.values())
        q = child.q() if child else 0.0
        return q + self.c * self.prior(node, option) * math.sqrt(total) / (1 + tried)

    def prior(self, node: Node, option: int) -> float:
        if not self.use_priors:
            return 1.0 / self.smdp.num_options
        return self.smdp.priors[node.state][option]

    def choose(self, node: Node) -> int:
        open_options = [
            a
            for a in self.options(node)
            if a not in node.children or not self.closed(node.children[a])
        ]
        return max(open_options, key=lambda a: (self.score(node, a), self.prior(node, a), -a))

    def simulate(self) -> None:
        """One expansion."""
        node = self.root
        while True:
            if self.expand == "all" and not node.children:
                for option in self.options(node):
                    self.add(node, option)
                return
            option = self.choose(node)
            if option not in node.children:
                self.add(node, option)
                return
            node = node.children[option]

    def add(self, parent: Node, option: int) -> None:
        state, reward, duration = self.smdp.table[parent.state, option]
        terminal = state in self.smdp.terminal
        discount = 0.0 if terminal else self.smdp.gamma**duration
        child = Node(
            state,
            terminal,
            self.evaluation(state),
            len(self.nodes),
            parent,
            option,
            reward,
            discount,
        )
        self.nodes.append(child)
        parent.children[option] = child
        gain, node = child.value, child
        while node.parent is not None:
            gain = node.reward + node.discount * gain
            node = node.parent
            node.gains.append(gain)
            node.visits = 1 + len(node.gains)
            if self.backup == "max":
                node.value = max(other.q() for other in node.children.values())
            else:
                node.value = (self.evaluation(node.state) + sum(node.gains)) / node.visits

    def path_return(self, node: Node) -> float:
        rewards = []
        while node.parent is not None:
            rewards.append((node.reward, node.discount))
            node = node.parent
        total, discount = 0.0, 1.0
        for reward, d in reversed(rewards):
            total, discount = total + discount * reward, discount * d
        return total

    def run(self, expansions: int) -> int:
        """Simulate until the budget is spent or nothing is left; return what was spent."""
        for done in range(expansions):
            if self.closed(self.root):
                return done
            self.simulate()
        return expansions


# ---------------------------------------------------------------------- comparison

POLICIES = {"uct": UCT, "puct": PUCT}
BACKUPS = {"mean": MeanBackup, "max": MaxBackup}


def roots_at(env: TableEnv, states: list[int]) -> TensorDictBase:
    state = TensorDict({"state": torch.tensor(states)}, [len(states)])
    td = env.reset(state, set_state=True)
    ends = torch.tensor([[bool(env._terminal[s])] for s in states])
    return td.set("terminated", ends).set("done", ends)


def planner_for(smdp: SMDP, config: dict[str, Any], expansions: int) -> MCTSPlanner:
    values, priors = torch.tensor(smdp.values), torch.tensor(smdp.priors)
    return MCTSPlanner(
        TableEnv(smdp.table, terminal=smdp.terminal, start=0),
        gamma=smdp.gamma,
        tree_policy=POLICIES[config["policy"]](c=config["c"]),
        backup=BACKUPS[config["backup"]](),
        expand=config["expand"],
        leaf_evaluator=(lambda td: values[td["state"]]) if config["evaluate"] else None,
        option_prior=(lambda td: priors[td["state"]]) if config["use_priors"] else None,
        budget=SearchBudget(expansions=expansions, until_plan=False),
    )


def check_against(search: Search, b: int, reference: ReferenceSearch, spent: int) -> None:
    nodes, edges = search.tree.nodes[b], search.tree.edges[b]
    expected = reference.nodes
    assert search.tree.num_nodes[b] == len(expected)
    assert search.num_expansions[b] == spent
    assert search.tree.states is not None
    used = slice(0, len(expected))
    assert search.tree.states["state"][b, used].tolist() == [node.state for node in expected]
    assert nodes["visits"][used].tolist() == [node.visits for node in expected]
    np.testing.assert_allclose(
        nodes["value"][used], [node.value for node in expected], rtol=1e-4, atol=1e-5
    )
    returns = [reference.path_return(node) for node in expected]
    np.testing.assert_allclose(nodes["path_return"][used], returns, rtol=1e-4, atol=1e-5)
    closed = [reference.closed(node) for node in expected]
    assert ((nodes["flags"][used] & 16) != 0).tolist() == closed
    for node in expected:
        row = edges[node.number]
        for option in range(search.num_options):
            child = node.children.get(option)
            assert row["child"][option] == (child.number if child else -1)
            assert row["visits"][option] == (child.visits if child else 0)
            if child is not None:
                assert row["value"][option] == pytest.approx(child.value, rel=1e-4, abs=1e-5)
                assert row["discount"][option] == pytest.approx(child.discount, rel=1e-6)
    rewarded = [r for r, node in zip(returns, expected, strict=True) if node.reward > 0]
    assert (search.best_node[b] >= 0) == bool(rewarded)
    if rewarded:
        assert search.best_return[b] == pytest.approx(max(rewarded), rel=1e-4, abs=1e-5)
    assert not nodes["in_flight"].any()
    assert not edges["in_flight"].any()


configs = st.fixed_dictionaries(
    {
        "policy": st.sampled_from(["uct", "puct"]),
        "c": st.sampled_from([0.1, 0.7, 1.4, 5.0]),
        "backup": st.sampled_from(["mean", "max"]),
        "expand": st.sampled_from(["one", "all"]),
        "evaluate": st.booleans(),
        "use_priors": st.booleans(),
    }
)


@settings(max_examples=120)
@given(
    seed=st.integers(0, 2**31),
    config=configs,
    num_roots=st.integers(1, 4),
    expansions=st.integers(1, 40),
)
def test_every_tree_equals_that_of_the_reference(
    seed: int, config: dict[str, Any], num_roots: int, expansions: int
) -> None:
    smdp = random_smdp(seed)
    planner = planner_for(smdp, config, expansions)
    rng = random.Random(seed)
    states = [rng.randrange(smdp.num_states) for _ in range(num_roots)]
    env = planner.simulator.env
    assert isinstance(env, TableEnv)
    search = planner.search(roots_at(env, states))
    for b, state in enumerate(states):
        reference = ReferenceSearch(smdp, state, **config)
        check_against(search, b, reference, reference.run(expansions))


def tree_of(search: Search, b: int) -> tuple[bytes, bytes]:
    used = search.tree.num_nodes[b]
    return search.tree.nodes[b, :used].tobytes(), search.tree.edges[b, :used].tobytes()


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), config=configs, leaves_per_wave=st.sampled_from([1, 3]))
def test_a_root_searched_beside_others_has_the_tree_it_has_alone(
    seed: int, config: dict[str, Any], leaves_per_wave: int
) -> None:
    smdp = random_smdp(seed)
    planner = planner_for(smdp, config, 30)
    planner.leaves_per_wave = leaves_per_wave
    rng = random.Random(seed)
    states = [rng.randrange(smdp.num_states) for _ in range(5)]
    env = planner.simulator.env
    assert isinstance(env, TableEnv)
    together = planner.search(roots_at(env, states))
    for b, state in enumerate(states):
        alone = planner.search(roots_at(env, [state]))
        assert tree_of(together, b) == tree_of(alone, 0)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), config=configs, leaves_per_wave=st.sampled_from([2, 5]))
def test_several_leaves_per_wave_leave_a_consistent_tree_and_nothing_in_flight(
    seed: int, config: dict[str, Any], leaves_per_wave: int
) -> None:
    smdp = random_smdp(seed)
    planner = planner_for(smdp, config, 60)
    planner.leaves_per_wave = leaves_per_wave
    env = planner.simulator.env
    assert isinstance(env, TableEnv)
    start = next(s for s in range(smdp.num_states) if s not in smdp.terminal)
    search = planner.search(roots_at(env, [start]))
    nodes, edges = search.tree.nodes[0], search.tree.edges[0]
    used = int(search.tree.num_nodes[0])
    assert not nodes["in_flight"].any()
    assert not edges["in_flight"].any()
    assert not (nodes["flags"] & 2).any()  # PENDING
    links = [(int(n["parent"]), int(n["option"])) for n in nodes[1:used]]
    assert len(set(links)) == used - 1, "an option was simulated twice in one node"
    for number, (parent, option) in enumerate(links, start=1):
        edge = edges[parent, option]
        assert edge["child"] == number
        assert edge["visits"] == nodes[number]["visits"]
        assert edge["value"] == nodes[number]["value"]
    assert (nodes["visits"][:used] == 1 + edges["visits"][:used].sum(-1)).all()
    assert nodes["visits"][0] == used


def test_the_reference_knows_the_hand_made_bandit() -> None:
    # Guards the comparison itself: one state, two terminal options of reward 0.25 and 0.75.
    smdp = SMDP(
        num_states=2,
        num_options=2,
        gamma=0.9,
        table={(0, 0): (1, 0.25, 1), (0, 1): (1, 0.75, 1)},
        terminal=[1],
        values=[0.0, 0.0],
        priors=[[0.5, 0.5]] * 2,
    )
    make: Callable[..., ReferenceSearch] = lambda backup: ReferenceSearch(  # noqa: E731
        smdp,
        0,
        policy="uct",
        c=1.0,
        backup=backup,
        expand="one",
        evaluate=False,
        use_priors=False,
    )
    mean, best = make("mean"), make("max")
    assert (mean.run(10), best.run(10)) == (2, 2)
    assert mean.root.value == pytest.approx(1 / 3)
    assert best.root.value == 0.75
