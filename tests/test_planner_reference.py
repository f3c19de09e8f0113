"""The planner against an independent search in plain Python, on random SMDPs.

The reference keeps objects and recomputes from its definitions whatever the planner keeps up to
date: which subtrees are closed, path returns, the best plan. Double precision, no arrays. Its
formulas are those of the docstrings of the tree policies.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from search_parts import uct_in_python
from tensordict import TensorDict, TensorDictBase

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    Gumbel,
    MCTSPlanner,
    Search,
    SearchBudget,
)
from torchrl_hmcts.planners.reference import Node, ReferenceSearch
from torchrl_hmcts.planners.tree import CLOSED, FORBIDDEN, PENDING
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


class GumbelReference(ReferenceSearch):
    """Gumbel search with a scale of 0, by the equations of its paper."""

    gumbel: Gumbel
    schedule: list[int]

    def run(self, num_simulations: int | None = None, num_expansions: int | None = None) -> None:
        assert num_simulations is not None
        self.schedule = self.halving(num_simulations)
        super().run(num_simulations, num_expansions)

    def improved_logits(self, node: Node) -> dict[int, float]:
        """ln P + sigma(Q), where Q is completed and scaled to [0, 1]."""
        tried, policy = node.children, self.gumbel
        total = sum(child.visits for child in tried.values())
        mixed = node.evaluation
        if tried:
            weights = {a: node.priors[a] for a in tried}
            mean = sum(weights[a] * tried[a].q for a in tried) / sum(weights.values())
            mixed = (mixed + total * mean) / (1 + total)
        q = {a: tried[a].q if a in tried else mixed for a in node.priors}
        # The kernels scale by all options, forbidden ones, which count as not tried, among them.
        every = [*q.values(), *([mixed] if len(q) < self.num_options else [])]
        low, high = min(every), max(every)
        most = max((child.visits for child in tried.values()), default=0)
        scale = (policy.c_visit + most) * policy.c_scale / max(high - low, 1e-8)
        return {a: math.log(node.priors[a]) + scale * (q[a] - low) for a in q}

    def halving(self, simulations: int) -> list[int]:
        """Visits of the options in the race, before each simulation."""
        racing = min(self.gumbel.max_considered, len(self.root.priors))
        if racing <= 1:
            return list(range(simulations))
        rounds, visits, schedule = math.ceil(math.log2(racing)), 0, []
        while len(schedule) < simulations:
            for _ in range(max(1, simulations // (rounds * racing))):
                schedule += [visits] * racing
                visits += 1
            racing = max(2, racing // 2)
        return schedule

    def choose(self, node: Node) -> int:
        logits = self.improved_logits(node)
        visits = {a: node.children[a].visits if a in node.children else 0 for a in logits}
        total = sum(visits.values())
        if node is self.root:
            racing = [a for a in logits if visits[a] == self.schedule[total]]
            return max(racing, key=lambda a: logits[a])
        top = max(logits.values())
        norm = math.log(sum(math.exp(x - top) for x in logits.values())) + top
        return max(logits, key=lambda a: math.exp(logits[a] - norm) - visits[a] / (1 + total))

    def final_choice(self) -> int:
        """Of the options with the most visits the one with the largest logit."""
        logits, children = self.improved_logits(self.root), self.root.children
        visits = {a: children[a].visits if a in children else 0 for a in logits}
        most = max(visits.values())
        return max((a for a in logits if visits[a] == most), key=lambda a: logits[a])


def reference_for(smdp: SMDP, state: int, config: dict[str, Any]) -> ReferenceSearch:
    def model(state: int, option: int) -> tuple[int, float, int, bool]:
        after, reward, duration = smdp.table[state, option]
        return after, reward, duration, after in smdp.terminal

    def options(state: int) -> list[int]:
        return [a for a in range(smdp.num_options) if (state, a) in smdp.table]

    def evaluate(state: int) -> tuple[list[float] | None, float]:
        priors = smdp.priors[state] if config["use_priors"] else None
        return priors, smdp.values[state] if config["evaluate"] else 0.0

    policy, is_gumbel = tree_policy_of(config), config["policy"] == "gumbel"
    search = (GumbelReference if is_gumbel else ReferenceSearch)(
        state,
        model,
        options,
        gamma=smdp.gamma,
        evaluate=evaluate,
        tree_policy=None if is_gumbel else policy,
        backup=config["backup"],
        expand=config["expand"],
        exhausted="revisit" if is_gumbel else config["exhausted"],
    )
    search.num_options = smdp.num_options  # type: ignore[attr-defined]
    if isinstance(search, GumbelReference):
        search.gumbel = policy
    return search


# ---------------------------------------------------------------------- comparison


def tree_policy_of(config: dict[str, Any]) -> Any:
    c = config["c"]
    return {
        "uct": UCT(c),
        "puct": PUCT(c, unvisited_value=0.25),
        "siblings": PUCT(c, normalize="siblings"),
        "tree": PUCT(c, normalize="tree"),
        "base": PUCT(c, unvisited_value=0.25, c_base=7.0),
        "mctx": PUCT(c, normalize="siblings", c_base=19652.0),
        "gumbel": Gumbel(config.get("max_considered", 16), c_scale=c, scale=0.0),
    }[config["policy"]]


def roots_at(env: TableEnv, states: list[int]) -> TensorDictBase:
    state = TensorDict({"state": torch.tensor(states)}, [len(states)])
    td = env.reset(state, set_state=True)
    ends = torch.tensor([[bool(env._terminal[s])] for s in states])
    return td.set("terminated", ends).set("done", ends)


def planner_for(smdp: SMDP, config: dict[str, Any], **budget: int) -> MCTSPlanner:
    values, priors = torch.tensor(smdp.values), torch.tensor(smdp.priors)
    return MCTSPlanner(
        TableEnv(smdp.table, terminal=smdp.terminal, start=0),
        gamma=smdp.gamma,
        tree_policy=tree_policy_of(config),
        backup=config["backup"],
        expand=config["expand"],
        exhausted=config["exhausted"],
        leaf_evaluator=(lambda td: values[td["state"]]) if config["evaluate"] else None,
        option_prior=(lambda td: priors[td["state"]]) if config["use_priors"] else None,
        budget=SearchBudget(**budget, until_plan=False),
    )


def check_against(search: Search, b: int, reference: ReferenceSearch) -> None:
    nodes, edges = search.tree.nodes[b], search.tree.edges[b]
    expected = reference.nodes
    assert search.num_expansions[b] == reference.expansions
    assert search.num_simulations[b] == reference.simulations
    assert search.roots["revisits"][b] == reference.revisits
    assert search.tree.num_nodes[b] == len(expected)
    assert search.tree.states is not None
    used = slice(0, len(expected))
    assert search.tree.states["state"][b, used].tolist() == [node.state for node in expected]
    assert nodes["visits"][used].tolist() == [node.visits for node in expected]
    for name in ("value", "reward", "discount"):
        np.testing.assert_allclose(
            nodes[name][used], [getattr(node, name) for node in expected], rtol=1e-4, atol=1e-5
        )
    returns = [node.path_return for node in expected]
    np.testing.assert_allclose(nodes["path_return"][used], returns, rtol=1e-4, atol=1e-5)
    closed = [node.closed for node in expected]
    assert ((nodes["flags"][used] & CLOSED) != 0).tolist() == closed
    for node in expected:
        row = edges[node.number]
        allowed = [not node.priors or a in node.priors for a in range(len(row))]
        assert (row["closed"] != FORBIDDEN).tolist() == allowed
        for option in range(search.num_options):
            child = node.children.get(option)
            assert row["child"][option] == (child.number if child else -1)
            assert row["visits"][option] == (child.visits if child else 0)
            if child is not None:
                assert row["value"][option] == pytest.approx(child.q, rel=1e-4, abs=1e-5)
    rewarded = [r for r, node in zip(returns, expected, strict=True) if node.reward > 0]
    assert (search.best_node[b] >= 0) == bool(rewarded) == (reference.best is not None)
    if reference.best is not None:
        assert reference.best.path_return == max(rewarded)
        assert search.best_return[b] == pytest.approx(max(rewarded), rel=1e-4, abs=1e-5)
    assert not edges["in_flight"].any()
    assert not (nodes["flags"] & PENDING).any()


CONFIG = {
    "policy": st.sampled_from(["uct", "puct", "siblings", "tree", "base", "mctx"]),
    "c": st.sampled_from([0.1, 0.7, 1.4, 5.0]),
    "backup": st.sampled_from(["mean", "max"]),
    "expand": st.sampled_from(["one", "all"]),
    "exhausted": st.sampled_from(["skip", "revisit"]),
    "evaluate": st.booleans(),
    "use_priors": st.booleans(),
}
configs = st.fixed_dictionaries(CONFIG)
seeds = st.integers(0, 2**31)


def search_and_check(
    seed: int, config: dict[str, Any], num_roots: int, **budget: int
) -> tuple[MCTSPlanner, Search, list[ReferenceSearch]]:
    smdp = random_smdp(seed)
    planner = planner_for(smdp, config, **budget)
    rng = random.Random(seed)
    states = [rng.randrange(smdp.num_states) for _ in range(num_roots)]
    env = planner.simulator.env
    assert isinstance(env, TableEnv)
    search = planner.search(roots_at(env, states))
    references = [reference_for(smdp, state, config) for state in states]
    for b, reference in enumerate(references):
        reference.run(**{f"num_{name}": number for name, number in budget.items()})
        check_against(search, b, reference)
    return planner, search, references


@settings(max_examples=80)
@given(seed=seeds, config=configs, num_roots=st.integers(1, 4), expansions=st.integers(1, 40))
def test_every_tree_equals_that_of_the_reference(
    seed: int, config: dict[str, Any], num_roots: int, expansions: int
) -> None:
    # Revisiting would go on for ever at a root of reward 0 where one option never ends.
    search_and_check(seed, config | {"exhausted": "skip"}, num_roots, expansions=expansions)


@settings(max_examples=100)
@given(seed=seeds, config=configs, num_roots=st.integers(1, 4), simulations=st.integers(1, 90))
def test_every_tree_equals_that_of_the_reference_after_a_number_of_simulations(
    seed: int, config: dict[str, Any], num_roots: int, simulations: int
) -> None:
    _, _, references = search_and_check(seed, config, num_roots, simulations=simulations)
    for reference in references:
        if config["exhausted"] == "revisit":
            assert reference.simulations >= simulations


@settings(max_examples=80)
@given(
    seed=seeds,
    config=st.fixed_dictionaries(
        CONFIG
        | {
            "policy": st.just("gumbel"),
            "expand": st.just("one"),
            "c": st.sampled_from([0.02, 0.1, 0.5]),
            "max_considered": st.sampled_from([1, 2, 3, 16]),
        }
    ),
    num_roots=st.integers(1, 4),
    simulations=st.integers(1, 60),
)
def test_gumbel_without_noise_equals_the_equations_of_its_paper(
    seed: int, config: dict[str, Any], num_roots: int, simulations: int
) -> None:
    planner, search, references = search_and_check(seed, config, num_roots, simulations=simulations)
    chosen = planner.choose(search)
    for b, reference in enumerate(references):
        assert isinstance(reference, GumbelReference)
        if reference.root.priors:
            assert chosen[b] == reference.final_choice()


@settings(max_examples=30)
@given(
    seed=seeds,
    config=configs,
    num_roots=st.integers(1, 4),
    simulations=st.integers(1, 60),
    leaves_per_wave=st.sampled_from([1, 1, 4]),
)
def test_uct_as_a_python_callable_grows_the_tree_of_the_compiled_uct(
    seed: int, config: dict[str, Any], num_roots: int, simulations: int, leaves_per_wave: int
) -> None:
    if leaves_per_wave > 1:  # with known leaves to revisit, waves are divided in another way
        config = config | {"exhausted": "skip"}
    smdp = random_smdp(seed)
    planner = planner_for(smdp, config | {"policy": "uct", "c": 0.7}, simulations=simulations)
    planner.leaves_per_wave = leaves_per_wave
    rng = random.Random(seed)
    env = planner.simulator.env
    assert isinstance(env, TableEnv)
    td = roots_at(env, [rng.randrange(smdp.num_states) for _ in range(num_roots)])
    compiled = planner.search(td)
    planner.tree_policy = uct_in_python(0.7)
    python = planner.search(td)
    for counter in ("simulations", "revisits", "expansions", "base_steps", "best_node"):
        assert compiled.roots[counter].tolist() == python.roots[counter].tolist()
    for b in range(num_roots):
        assert tree_of(compiled, b) == tree_of(python, b)


def tree_of(search: Search, b: int) -> tuple[bytes, bytes]:
    used = search.tree.num_nodes[b]
    return search.tree.nodes[b, :used].tobytes(), search.tree.edges[b, :used].tobytes()


@settings(max_examples=15)
@given(seed=seeds, config=configs)
def test_roots_that_are_walked_down_together_have_the_trees_they_have_alone(
    seed: int, config: dict[str, Any]
) -> None:
    # From 64 roots on the compiled descents go down in step.
    smdp = random_smdp(seed)
    planner = planner_for(smdp, config, simulations=40)
    rng = random.Random(seed)
    states = [rng.randrange(smdp.num_states) for _ in range(70)]
    env = planner.simulator.env
    assert isinstance(env, TableEnv)
    together = planner.search(roots_at(env, states))
    apart = planner.search(roots_at(env, list(range(smdp.num_states))))
    for b, state in enumerate(states):
        assert tree_of(together, b) == tree_of(apart, state)


@settings(max_examples=30)
@given(
    seed=seeds,
    config=configs,
    in_flight=st.sampled_from([(2, 1), (5, 1), (255, 1), (1, 2), (1, 255), (3, 4)]),
)
def test_several_leaves_in_flight_leave_a_consistent_tree_and_none_in_flight(
    seed: int, config: dict[str, Any], in_flight: tuple[int, int]
) -> None:
    smdp = random_smdp(seed)
    planner = planner_for(smdp, config, simulations=60)
    planner.leaves_per_wave, planner.waves_in_flight = in_flight
    env = planner.simulator.env
    assert isinstance(env, TableEnv)
    start = next(s for s in range(smdp.num_states) if s not in smdp.terminal)
    search = planner.search(roots_at(env, [start]))
    nodes, edges = search.tree.nodes[0], search.tree.edges[0]
    used = int(search.tree.num_nodes[0])
    assert not edges["in_flight"].any()
    assert not (nodes["flags"] & PENDING).any()
    links = [(int(n["parent"]), int(n["option"])) for n in nodes[1:used]]
    assert len(set(links)) == used - 1, "an option was simulated twice in one node"
    for number, (parent, option) in enumerate(links, start=1):
        edge, node = edges[parent, option], nodes[number]
        assert edge["child"] == number
        assert edge["visits"] == node["visits"]
        assert edge["value"] == pytest.approx(
            node["reward"] + node["discount"] * node["value"], rel=1e-6
        )
    goes_on = edges["visits"][:used].sum(-1) > 0
    assert (nodes["visits"][:used] == 1 + edges["visits"][:used].sum(-1))[goes_on].all()
    simulations, revisits = search.num_simulations[0], search.roots["revisits"][0]
    assert nodes["visits"][0] == 1 + simulations
    assert used == 1 + simulations - revisits
    if config["expand"] == "one":
        assert simulations <= 60
    if config["exhausted"] == "revisit":
        assert simulations >= 60


def bandit(**config: Any) -> Any:
    """One state, two terminal options of reward 0.25 and 0.75."""
    smdp = SMDP(
        num_states=2,
        num_options=2,
        gamma=0.9,
        table={(0, 0): (1, 0.25, 1), (0, 1): (1, 0.75, 1)},
        terminal=[1],
        values=[0.0, 0.0],
        priors=[[0.5, 0.5]] * 2,
    )
    defaults = {
        "policy": "uct",
        "c": 1.0,
        "backup": "mean",
        "expand": "one",
        "exhausted": "skip",
        "evaluate": False,
        "use_priors": False,
    }
    return reference_for(smdp, 0, {**defaults, **config})


def test_the_reference_knows_the_hand_made_bandit() -> None:
    # Guards the comparison itself.
    mean, best = bandit(), bandit(backup="max")
    mean.run(num_expansions=10)
    best.run(num_expansions=10)
    assert (mean.expansions, best.expansions) == (2, 2)
    assert mean.root.value == pytest.approx(1 / 3)
    assert best.root.value == 0.75
    # Revisits, c = 0: both once, then the better one: (0 + 0.25 + 5 * 0.75) / 7.
    greedy = bandit(exhausted="revisit", c=0.0)
    greedy.run(num_simulations=6)
    assert [greedy.root.children[a].visits for a in (0, 1)] == [1, 5]
    assert greedy.revisits == 4
    assert greedy.root.value == pytest.approx(4 / 7)
    # Four simulations halve two options into 2 + 2, then 0.75 wins.
    gumbel = bandit(policy="gumbel", c=0.1)
    gumbel.run(num_simulations=4)
    assert gumbel.schedule == [0, 0, 1, 1]
    assert gumbel.final_choice() == 1
