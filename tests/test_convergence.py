"""With more simulations the value of the root approaches that of value iteration.

Twenty random SMDPs of five states are searched at once, from their first states, by the engine;
the planner itself is checked on finite trees.
"""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    Gumbel,
    MCTSPlanner,
    MostVisited,
    Root,
    Search,
    SearchBudget,
    Transition,
    tree_search,
)
from torchrl_hmcts.planners.root_options import gumbel_choice
from torchrl_hmcts.testing import TableEnv

NUM_SMDPS, NUM_STATES, NUM_OPTIONS, GAMMA = 20, 5, 3, 0.7


class SMDPs:
    """Random SMDPs side by side: state 5 i + s is state s of SMDP i; s = 4 is its end."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        shape = (NUM_SMDPS * NUM_STATES, NUM_OPTIONS)
        first = np.arange(NUM_SMDPS).repeat(NUM_STATES)[:, None] * NUM_STATES
        self.next_state = first + rng.integers(0, NUM_STATES, shape)
        self.reward = rng.uniform(0.0, 1.0, shape).astype(np.float32)
        self.discount = (GAMMA ** rng.integers(1, 4, shape)).astype(np.float32)
        self.discount[self.next_state % NUM_STATES == NUM_STATES - 1] = 0.0
        best = np.zeros(len(self.reward))
        for _ in range(200):  # value iteration
            self.q = self.reward + self.discount * best[self.next_state]
            best = self.q.max(-1)
        uniform = np.zeros(len(self.reward))
        for _ in range(200):  # the value of choosing at random, as a poor critic
            uniform = (self.reward + self.discount * uniform[self.next_state]).mean(-1)
        self.critic = uniform.astype(np.float32)
        self.starts = np.arange(NUM_SMDPS) * NUM_STATES

    def search(self, simulations: int, *, critic: bool = False, **kwargs: Any) -> Search:
        values = self.critic if critic else 0 * self.critic

        def transition(state: np.ndarray, option: np.ndarray) -> Transition:
            after = self.next_state[state, option]
            prior = np.full((len(state), NUM_OPTIONS), 1 / NUM_OPTIONS, np.float32)
            return Transition(
                self.reward[state, option],
                self.discount[state, option],
                prior,
                values[after],
                after,
            )

        prior = np.full((NUM_SMDPS, NUM_OPTIONS), 1 / NUM_OPTIONS, np.float32)
        root = Root(prior, values[self.starts], self.starts)
        return tree_search(root, transition, simulations, **kwargs)

    def errors(self, search: Search) -> np.ndarray:
        """How far the roots' values are from the optimal ones."""
        return np.abs(search.tree.nodes["value"][:, 0] - self.q[self.starts].max(-1))

    def regrets(self, options: np.ndarray) -> np.ndarray:
        """How much worse than the best the chosen options are."""
        q = self.q[self.starts]
        return q.max(-1) - q[np.arange(NUM_SMDPS), options]


@pytest.fixture(scope="module")
def smdps() -> SMDPs:
    return SMDPs()


@pytest.mark.parametrize("leaves_per_wave", [1, 4])
def test_the_mean_backup_of_uct_converges_as_simulations_grow(
    smdps: SMDPs, leaves_per_wave: int
) -> None:
    # Values are up to 3.3. The mean includes what exploring cost, O(ln N / N) per option.
    few, some, many = (
        smdps.errors(smdps.search(n, tree_policy=UCT(1.0), leaves_per_wave=leaves_per_wave))
        for n in (100, 700, 5000)
    )
    assert few.mean() > 2 * some.mean() > 4 * many.mean(), (few, some, many)
    assert many.max() < 0.1, many


@pytest.mark.parametrize(
    "policy", [UCT(1.0), PUCT(2.0), PUCT(2.0, normalize="siblings"), PUCT(2.0, normalize="tree")]
)
@pytest.mark.parametrize("exhausted", ["skip", "revisit"])
def test_the_max_backup_converges_under_every_tree_policy(
    smdps: SMDPs, policy: Any, exhausted: Any
) -> None:
    search = smdps.search(5000, tree_policy=policy, backup="max", exhausted=exhausted)
    assert smdps.errors(search).max() < 0.05, smdps.errors(search)


@pytest.mark.parametrize(
    "policy", [UCT(1.0), PUCT(2.0), PUCT.mctx(), PUCT(2.0, normalize="tree")], ids=str
)
def test_the_optimal_option_is_the_most_visited_one(smdps: SMDPs, policy: Any) -> None:
    # Of mean values up to 3.3; two of the twenty may be almost as good.
    regrets = smdps.regrets(MostVisited().choose(smdps.search(5000, tree_policy=policy)))
    assert (regrets < 1e-5).sum() >= 18, regrets
    assert regrets.max() < 0.1, regrets


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_gumbel_chooses_the_optimal_option_with_few_simulations_and_a_poor_critic(
    smdps: SMDPs, scale: float
) -> None:
    # The critic is the value of choosing at random; 48 simulations look three options ahead.
    search = smdps.search(48, tree_policy=Gumbel(scale=scale), critic=True)
    regrets = smdps.regrets(gumbel_choice(search))
    at_random = (smdps.q[smdps.starts].max(-1) - smdps.q[smdps.starts].mean(-1)).mean()
    assert regrets.mean() < 0.1 * at_random, regrets
    assert (regrets < 0.03).mean() >= 0.8, regrets


# ---------------------------------------------------------------------- finite trees

Table = dict[tuple[int, int], tuple[int, float, int]]


@pytest.mark.parametrize("in_flight", [(2, 1), (8, 1), (1, 2), (1, 8), (2, 4)])
def test_leaves_do_not_revisit_while_others_are_in_flight(in_flight: tuple[int, int]) -> None:
    # Option 0 ends at 0.85; option 1 is worth 1.3, which takes a dozen visits to see. Were the
    # other leaves of a wave free to revisit option 0 until in-flight counts no longer kept them
    # from option 1, they would spend the whole budget there.
    rng = random.Random(1)
    table: Table = {
        (s, a): (rng.randrange(5), rng.uniform(0, 1), rng.randint(1, 3))
        for s in range(4)
        for a in range(rng.randint(2, 3))
    }
    visits = {}
    for leaves, waves in ((1, 1), in_flight):
        env = TableEnv(table, terminal=[4])
        planner = MCTSPlanner(
            env,
            gamma=GAMMA,
            tree_policy=UCT(0.5),
            expand="one",
            exhausted="revisit",
            leaves_per_wave=leaves,
            waves_in_flight=waves,
            budget=SearchBudget(simulations=1500, until_plan=False),
        )
        visits[leaves, waves] = planner(env.reset())["root_visits"].tolist()
    assert visits[1, 1][1] > 1000
    assert visits[in_flight][1] > 0.95 * visits[1, 1][1], visits
