"""Chance: progressive widening, merged outcomes and their means, in stochastic simulators."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from search_parts import expansions, uct_in_python
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_hmcts.planners import (
    UCT,
    MCTSPlanner,
    MostVisited,
    ProgressiveWidening,
    Search,
    SearchBudget,
)
from torchrl_hmcts.planners.tree import PENDING, TERMINAL
from torchrl_hmcts.testing import TableEnv

Outcome = tuple[float, int, float]  # probability, next state, reward
Table = dict[tuple[int, int], list[Outcome]]


UCT_IN_PYTHON = uct_in_python(1.0)


class DiceEnv(EnvBase):
    """A stochastic MDP by its table; stateless, with random numbers of its own."""

    batch_locked = False
    _supports_set_state = True

    def __init__(self, table: Table, terminal: list[int], seed: int = 0) -> None:
        super().__init__(batch_size=[])
        self.num_states = 1 + max(o[1] for row in table.values() for o in row)
        num_options = 1 + max(a for _, a in table)
        width = max(map(len, table.values()))
        shape = (self.num_states, num_options, width)
        self.p, self.reward = torch.zeros(shape), torch.zeros(shape)
        self.next_state = torch.zeros(shape, dtype=torch.int64)
        for (s, a), row in table.items():
            for i, (p, after, reward) in enumerate(row):
                self.p[s, a, i], self.next_state[s, a, i], self.reward[s, a, i] = p, after, reward
        self.terminal = torch.zeros(self.num_states, dtype=torch.bool)
        self.terminal[terminal] = True
        self.calls: list[list[tuple[int, int]]] = []
        self.state_spec = Composite(state=Categorical(self.num_states, shape=()))
        self.observation_spec = Composite(state=Categorical(self.num_states, shape=()))
        self.action_spec = Categorical(num_options, shape=())
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite({k: Binary(1, dtype=torch.bool) for k in ("done", "terminated")})
        self.set_seed(seed)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, action = tensordict.get("state"), tensordict.get("action")
        self.calls.append(
            list(zip(state.flatten().tolist(), action.flatten().tolist(), strict=True))
        )
        p = self.p[state, action]
        drawn = torch.multinomial(p.reshape(-1, p.shape[-1]), 1, generator=self.rng)
        drawn = drawn.view(p.shape[:-1])
        after = self.next_state[state, action, drawn]
        ended = self.terminal[after].unsqueeze(-1)
        return TensorDict(
            {
                "state": after,
                "reward": self.reward[state, action, drawn].unsqueeze(-1),
                "terminated": ended,
                "done": ended.clone(),
            },
            batch_size=tensordict.batch_size,
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        shape = self.batch_size if tensordict is None else tensordict.batch_size
        state = torch.zeros(shape, dtype=torch.int64)
        if kwargs.get("set_state") and tensordict is not None:
            state = tensordict.get("state").clone()
        return TensorDict({"state": state}, batch_size=shape)

    def _set_seed(self, seed: int | None) -> None:
        self.rng = torch.Generator().manual_seed(seed or 0)


# Option 0 pays 1 or nothing, even odds; option 1 pays 3 or -1, one to three: both ends differ.
BANDIT: Table = {
    (0, 0): [(0.5, 1, 1.0), (0.5, 2, 0.0)],
    (0, 1): [(0.25, 3, 3.0), (0.75, 4, -1.0)],
}
BANDIT_ENDS = [1, 2, 3, 4]
# A walk on a ring of five that slips the other way one time in four; going round pays.
RING: Table = {
    (s, a): [
        (0.75, (s + 1 + 3 * a) % 5, float(s == 3) - 0.1 * a),
        (0.25, (s + 4 + 2 * a) % 5, 0.0),
    ]
    for s in range(5)
    for a in range(2)
}


def planner_in(env: EnvBase, simulations: int, **kwargs: Any) -> MCTSPlanner:
    kwargs.setdefault("gamma", 0.8)
    kwargs.setdefault("chance", ProgressiveWidening())
    budget = SearchBudget(simulations=simulations, until_plan=False)
    return MCTSPlanner(env, budget=budget, **kwargs)


def check_tree(search: Search, widening: ProgressiveWidening | None, b: int = 0) -> None:
    """What holds of every tree with chance."""
    tree = search.tree
    assert tree.states is not None
    used = int(tree.num_nodes[b])
    seen = [0]
    for n in range(used):
        for a in range(search.num_options):
            edge, children = tree.edges[b, n, a], search.tree.outcomes(b, a, n)
            seen += children
            if not children:
                assert (edge["visits"], edge["samples"], edge["value"]) == (0, 0, 0.0)
                continue
            below = tree.nodes[b, children]
            assert (below["parent"] == n).all()
            assert (below["option"] == a).all()
            if widening is not None:
                most = math.ceil(widening.k * float(edge["visits"]) ** widening.alpha)
                assert edge["samples"] <= max(1, most)
            assert edge["samples"] == below["samples"].sum()
            # one node for every state that was drawn
            states = tree.states["state"][b, children].tolist()
            assert len(set(states)) == len(states)
            # Q is the mean of R + D V over the samples
            q = below["reward"] + below["discount"] * below["value"]
            mean = (q * below["samples"]).sum() / below["samples"].sum()
            assert edge["value"] == pytest.approx(float(mean), rel=1e-4, abs=1e-5)
            # a visit is a new outcome, the same outcome again, or a descent into one
            merged = int(edge["samples"]) - len(children)
            assert edge["visits"] == below["visits"].sum() + merged
        if tree.edges[b, n]["visits"].any():
            assert tree.nodes[b, n]["visits"] == 1 + tree.edges[b, n]["visits"].sum()
    assert sorted(seen) == list(range(used))
    assert not tree.edges["in_flight"].any()
    assert not (tree.nodes["flags"] & PENDING).any()


@pytest.mark.parametrize(("k", "alpha"), [(1.0, 0.5), (2.0, 0.3), (0.4, 0.8), (3.0, 0.0), (1.0, 1)])
@pytest.mark.parametrize("expand", ["one", "all"])
@pytest.mark.parametrize("leaves_per_wave", [1, 6])
def test_samples_are_bounded_merged_and_averaged_at_every_edge(
    k: float, alpha: float, expand: Any, leaves_per_wave: int
) -> None:
    widening = ProgressiveWidening(k=k, alpha=alpha)
    env = DiceEnv(RING, [])
    planner = planner_in(env, 200, chance=widening, expand=expand, leaves_per_wave=leaves_per_wave)
    search = planner.search(env.reset())
    check_tree(search, widening)
    simulated = sum(map(len, env.calls))
    assert search.num_base_steps[0] == simulated
    assert search.num_simulations[0] == simulated + search.roots["revisits"][0]
    assert 200 <= search.num_simulations[0] <= 200 + (expand == "all")
    root = search.tree.edges[0, 0]
    if alpha > 0:  # both outcomes of the option that is taken most have been seen
        assert len(search.tree.outcomes(0, int(root["visits"].argmax()), 0)) == 2


def test_widening_draws_as_often_as_it_may() -> None:
    # One option, one terminal outcome: the draws come at visits 1, 2, 5, 10, 17 = n^2 + 1.
    env = DiceEnv({(0, 0): [(1.0, 1, 0.5)]}, [1])
    for simulations, drawn in [(1, 1), (2, 2), (4, 2), (5, 3), (9, 3), (10, 4), (17, 5), (26, 6)]:
        search = planner_in(env, simulations).search(env.reset())
        edge = search.tree.edges[0, 0, 0]
        assert (edge["visits"], edge["samples"]) == (simulations, drawn)
        assert search.tree.num_nodes[0] == 2
        assert search.tree.nodes[0, 1]["samples"] == drawn
        assert edge["value"] == 0.5


def test_descents_go_to_outcomes_in_proportion_to_their_samples() -> None:
    env = DiceEnv(RING, [], seed=3)
    search = planner_in(env, 1000, chance=ProgressiveWidening(k=20, alpha=0)).search(env.reset())
    edge = search.tree.edges[0, 0]
    a = int(edge["visits"].argmax())
    assert edge["samples"][a] == 20
    below = search.tree.nodes[0, search.tree.outcomes(0, a, 0)]
    assert len(below) == 2
    share = below["visits"] / below["visits"].sum()
    np.testing.assert_allclose(share, below["samples"] / 20, atol=0.02)


def test_terminal_outcomes_are_drawn_again_and_revisited() -> None:
    env = DiceEnv(BANDIT, BANDIT_ENDS)
    planner = planner_in(env, 400)
    search = planner.search(env.reset())
    tree = search.tree
    assert search.num_simulations.tolist() == [400]
    assert tree.num_nodes[0] == 5
    assert (tree.nodes["flags"][0, 1:5] & TERMINAL != 0).all()
    assert (tree.nodes["discount"][0, 1:5] == 0).all()
    assert not search.exhausted(np.array([0])).any()  # another draw may tell something new
    assert all(pair[0] == 0 for call in env.calls for pair in call)
    check_tree(search, ProgressiveWidening())


def bandit_with(**kwargs: Any) -> Search:
    env = TableEnv({(0, 0): (1, 0.0, 1), (0, 1): (1, -1.0, 1)}, terminal=[1])
    budget = expansions(50)
    return MCTSPlanner(env, budget=budget, **kwargs).search(env.reset())


@pytest.mark.parametrize("policy", [UCT(), UCT_IN_PYTHON])
def test_a_root_that_wants_no_more_outcomes_ends_without_a_limit_of_simulations(
    policy: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchrl_hmcts.planners.search_loop._MAX_FRUITLESS_REVISITS", 200)
    # k = 1, alpha = 0: no second outcome is ever drawn, so 50 expansions are never reached.
    search = bandit_with(chance=ProgressiveWidening(k=1, alpha=0), tree_policy=policy, expand="one")
    assert search.num_expansions.tolist() == [2]
    assert search.tree.edges[0, 0]["samples"].tolist() == [1, 1]


@pytest.mark.parametrize("expand", ["one", "all"])
@pytest.mark.parametrize("policy", [UCT(), UCT_IN_PYTHON])
def test_a_deterministic_env_under_chance_has_one_outcome_per_option(
    expand: Any, policy: Any
) -> None:
    table = {(s, a): ((2 * s + a) % 7, 0.1 * s - 0.2 * a, 1) for s in range(7) for a in range(2)}
    env = TableEnv(table)
    planner = planner_in(env, 100, expand=expand, tree_policy=policy)
    search = planner.search(env.reset())
    check_tree(search, ProgressiveWidening())
    used = int(search.tree.num_nodes[0])
    assert (search.tree.nodes["sibling"][0, :used] == -1).all()
    assert search.tree.edges["samples"][0, 0].min() > 1
    links = list(
        zip(
            search.tree.nodes["parent"][0, 1:used].tolist(),
            search.tree.nodes["option"][0, 1:used].tolist(),
            strict=True,
        )
    )
    assert len(set(links)) == len(links)


def test_uct_in_python_grows_the_tree_of_the_compiled_uct_under_chance() -> None:
    found = []
    for policy in (UCT(), UCT_IN_PYTHON):
        env = DiceEnv(RING, [], seed=4)  # the same draws for the same simulations
        search = planner_in(env, 400, tree_policy=policy).search(env.reset())
        used = int(search.tree.num_nodes[0])
        found.append((search.tree.nodes[0, :used], search.tree.edges[0, :used]))
    for compiled, python in zip(*found, strict=True):
        assert compiled.tobytes() == python.tobytes()


def test_a_truncated_and_a_terminated_end_in_one_state_are_two_outcomes() -> None:
    class Flaky(DiceEnv):
        """Every other step from here on ends the episode."""

        ends = False

        def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
            after = super()._step(tensordict)
            self.ends = not self.ends
            flag = torch.full_like(after["done"], self.ends)
            return after.set("done", flag).set("terminated", flag.clone())

    env = Flaky({(0, 0): [(1.0, 0, 1.0)]}, [])
    search = planner_in(env, 2, expand="one").search(env.reset())
    # The first draw ends; the second, at visit 2, is the same state and goes on.
    assert search.tree.states is not None
    assert search.tree.states["state"][0, :3].tolist() == [0, 0, 0]
    assert search.tree.outcomes(0, 0, 0) == [1, 2]
    assert (search.tree.nodes["flags"][0, 1:3] & TERMINAL != 0).tolist() == [True, False]
    assert search.tree.nodes["discount"][0, 1:3].tolist() == pytest.approx([0.0, 0.8])


def test_rewards_of_a_merged_outcome_are_averaged() -> None:
    class Paying(DiceEnv):
        """Pays 1, 2, 3, ... for one and the same transition."""

        def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
            after = super()._step(tensordict)
            return after.set("reward", torch.full_like(after["reward"], float(len(self.calls))))

    env = Paying({(0, 0): [(1.0, 1, 0.0)]}, [1])
    search = planner_in(env, 10, expand="one").search(env.reset())
    # Draws at visits 1, 2, 5 and 10 paid 1, 2, 3 and 4.
    assert search.tree.nodes[0, 1]["samples"] == 4
    assert search.tree.edges[0, 0, 0]["value"] == pytest.approx(2.5)


def optimal_value(table: Table, terminal: list[int], gamma: float) -> float:
    num_states = 1 + max(o[1] for row in table.values() for o in row)
    values = np.zeros(num_states)
    for _ in range(400):
        values = np.array(
            [
                max(
                    (
                        sum(p * (r + gamma * values[s2]) for p, s2, r in row)
                        for (s1, _), row in table.items()
                        if s1 == s and s not in terminal
                    ),
                    default=0.0,
                )
                for s in range(num_states)
            ]
        )
    return float(values[0])


def random_table(seed: int) -> Table:
    rng = np.random.default_rng(seed)
    table: Table = {}
    for s in range(4):
        for a in range(2):
            p = float(rng.uniform(0.2, 0.8))
            one, other = rng.choice(5, 2, replace=False).tolist()
            table[s, a] = [(p, one, float(rng.uniform())), (1 - p, other, float(rng.uniform()))]
    table[3, 1].append((0.0, 4, 0.0))  # so that state 4, the end, exists
    return table


@pytest.mark.parametrize("backup", ["mean", "max"])
def test_the_value_of_the_root_approaches_value_iteration(backup: str) -> None:
    # Six random MDPs of four states and an end, each searched from 16 equal roots.
    errors: dict[int, list[float]] = {50: [], 800: []}
    for seed in range(6):
        table = random_table(seed)
        best = optimal_value(table, [4], 0.6)
        for simulations in errors:
            kwargs: dict[str, Any] = {"backup": "max"} if backup == "max" else {}
            planner = planner_in(
                DiceEnv(table, [4], seed=seed),
                simulations,
                gamma=0.6,
                chance=ProgressiveWidening(k=2, alpha=0.6),
                leaves_per_wave=8,
                **kwargs,
            )
            states = TensorDict({"state": torch.zeros(16, dtype=torch.int64)}, [16])
            td = planner(planner.simulator.env.reset(states, set_state=True))
            errors[simulations].append(abs(td["root_value"].mean().item() - best))
    assert np.mean(errors[800]) < 0.6 * np.mean(errors[50]), errors
    assert max(errors[800]) < 0.25, errors


def test_with_chance_the_most_visited_option_is_chosen() -> None:
    # The first draws of option 1 may pay 3; its mean is 0 and that of option 0 is 1/2.
    env = DiceEnv(BANDIT, BANDIT_ENDS, seed=2)
    planner = planner_in(env, 500, chance=ProgressiveWidening(k=1, alpha=1))
    assert isinstance(planner.final_choice, MostVisited)
    td = env.reset(TensorDict({"state": torch.zeros(10, dtype=torch.int64)}, [10]), set_state=True)
    assert planner(td)["action"].tolist() == [0] * 10
    assert td["plan_found"].all()
