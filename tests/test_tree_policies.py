"""Tree policies: the compiled ones, the scores of TorchRL, and one's own."""

from __future__ import annotations

import itertools
import math
import random
from typing import Any

import numpy as np
import pytest
import torch
from search_parts import at, expansions, simulations, trees
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules.mcts.scores import (
    EXP3Score,
    MCTSScores,
    PUCTScore,
    UCB1TunedScore,
    UCBScore,
)

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    Gumbel,
    HighestValue,
    MCTSPlanner,
    NodeStatistics,
    Search,
    SearchBudget,
    TorchRLScore,
)
from torchrl_hmcts.testing import ChainEnv, TableEnv


class Problem:
    """A random SMDP of 12 states and 3 options, with a value and a prior for every state."""

    def __init__(self, seed: int, scale: float = 1.0) -> None:
        rng = random.Random(seed)
        pairs = [(s, a) for s in range(10) for a in range(3) if a == s % 3 or rng.random() < 0.8]
        table = {
            pair: (rng.randrange(12), scale * rng.uniform(-1.0, 1.0), rng.randint(1, 4))
            for pair in pairs
        }
        self.env = TableEnv(table, terminal=[10, 11])
        self.values = torch.tensor([scale * rng.uniform(-1.0, 1.0) for _ in range(12)])
        weights = torch.tensor([[rng.uniform(0.1, 1.0) for _ in range(3)] for _ in range(12)])
        self.priors = weights / weights.sum(-1, keepdim=True)

    def search(self, tree_policy: Any, budget: SearchBudget, **kwargs: Any) -> Search:
        planner = MCTSPlanner(
            self.env,
            gamma=0.9,
            tree_policy=tree_policy,
            leaf_evaluator=lambda td: self.values[td["state"]],
            option_prior=lambda td: self.priors[td["state"]],
            budget=budget,
            **kwargs,
        )
        return planner.search(at(self.env, [0, 1, 5]), seed=0)


def visits(search: Search) -> list[list[list[int]]]:
    tree = search.tree
    return [tree.edges["visits"][b, :n].tolist() for b, n in enumerate(tree.num_nodes)]


def bandit(rewards: list[float]) -> TableEnv:
    """One state; every option ends the episode."""
    return TableEnv({(0, a): (1, r, 1) for a, r in enumerate(rewards)}, terminal=[1])


def statistics(
    option_visits: list[float],
    option_values: list[float],
    *,
    priors: list[float] | None = None,
    squares: list[float] | None = None,
    allowed: list[bool] | None = None,
) -> NodeStatistics:
    """The statistics of one node."""
    num_options = len(option_visits)
    return NodeStatistics(
        node_visits=torch.tensor([1.0 + sum(option_visits)]),
        node_values=torch.zeros(1),
        depths=torch.zeros(1, dtype=torch.int64),
        option_visits=torch.tensor([option_visits]),
        option_values=torch.tensor([option_values]),
        option_squares=torch.tensor([squares or [0.0] * num_options]),
        priors=torch.tensor([priors or [1.0 / num_options] * num_options]),
        allowed=torch.tensor([allowed or [True] * num_options]),
        batch_size=[1],
    )


# ---------------------------------------------------------------------- the scores of TorchRL

EXPANSIONS = expansions(25)


@pytest.mark.parametrize("expand", ["one", "all"])
@pytest.mark.parametrize("leaves_per_wave", [1, 4])
@pytest.mark.parametrize("backup", ["mean", "max"])
def test_torchrls_puct_grows_the_trees_of_the_compiled_one(
    expand: Any, leaves_per_wave: int, backup: Any
) -> None:
    for seed in range(3):
        problem = Problem(seed)
        kwargs = {"expand": expand, "leaves_per_wave": leaves_per_wave, "backup": backup}
        ours = problem.search(PUCT(c=0.7), EXPANSIONS, **kwargs)
        theirs = problem.search(TorchRLScore(PUCTScore(c=0.7)), EXPANSIONS, **kwargs)
        assert ours.num_simulations.max() >= 25
        assert trees(ours) == trees(theirs)


def test_puct_and_ucb_give_the_values_of_their_formulas() -> None:
    node = statistics([0.0, 2.0, 3.0], [0.0, 0.5, -1.0], priors=[0.5, 0.3, 0.2])
    root = math.sqrt(5.0)
    torch.testing.assert_close(
        TorchRLScore(PUCTScore(c=2.0))(node)[0],
        torch.tensor(
            [2 * 0.5 * root, 0.5 + 2 * 0.3 * root / 3, -1.0 + 2 * 0.2 * root / 4]
        ).double(),
    )
    torch.testing.assert_close(
        TorchRLScore(UCBScore(c=2.0))(node)[0],
        torch.tensor([2 * root, 0.5 + 2 * root / 3, -1.0 + 2 * root / 4]).double(),
    )


def test_ucb1_tuned_takes_unvisited_options_first_and_looks_at_the_variance() -> None:
    # Two returns of 1/4 and 3/4; four returns of 1/2.
    node = statistics([0.0, 2.0, 4.0], [0.0, 0.5, 0.5], squares=[0.0, 0.625, 1.0])
    scores = TorchRLScore(UCB1TunedScore(exploration_constant=0.01))(node)[0]
    log = math.log(6.0)
    variances = (0.0625 + math.sqrt(0.01 * log / 2), math.sqrt(0.01 * log / 4))
    assert max(variances) < 0.25
    expected = [0.5 + math.sqrt(log / n * v) for n, v in zip((2, 4), variances, strict=True)]
    assert scores[1:].tolist() == pytest.approx(expected)
    assert 1e6 < scores[0] < math.inf
    one_visit = TorchRLScore(UCB1TunedScore())(statistics([0.0, 1.0], [0.0, 0.9]))
    assert one_visit[0, 0] > one_visit[0, 1]


def test_exp3_spreads_visits_by_the_probabilities_of_its_weights() -> None:
    # w = exp(0.5 / 2 * 4 * Q); p = 0.5 w / sum(w) + 0.25
    node = statistics([3.0, 1.0], [0.2, 0.6])
    weights = [math.exp(0.2), math.exp(0.6)]
    p = [0.5 * w / sum(weights) + 0.25 for w in weights]
    scores = TorchRLScore(EXP3Score(gamma=0.5))(node)[0]
    assert scores.tolist() == pytest.approx([p[0] / 4, p[1] / 2])


def test_exp3_leaves_out_forbidden_options_and_survives_large_returns() -> None:
    node = statistics([9.0, 9.0, 0.0], [9e4, 5e4, 0.0], allowed=[False, True, True])
    scores = TorchRLScore(EXP3Score(gamma=0.3))(node)[0]
    assert torch.isfinite(scores).all()
    # Of the two that are allowed the first has all the weight: p = 0.7 + 0.1, and 0.1.
    assert scores[1:].tolist() == pytest.approx([0.8 / 10, 0.1])


@pytest.mark.parametrize("member", list(MCTSScores))
@pytest.mark.parametrize("expand", ["one", "all"])
@pytest.mark.parametrize("leaves_per_wave", [1, 3])
def test_every_score_of_torchrl_finds_the_reward(
    member: MCTSScores, expand: Any, leaves_per_wave: int
) -> None:
    env = ChainEnv(5)
    planner = MCTSPlanner(
        env,
        tree_policy=TorchRLScore(member),
        expand=expand,
        leaves_per_wave=leaves_per_wave,
        budget=expansions(70),
    )
    search = planner.search(env.reset(TensorDict({}, [2])))
    assert planner.choose(search).tolist() == [1, 1]
    assert search.best_return == pytest.approx(planner.gamma**3)
    for field in ("value", "squares"):
        assert np.isfinite(search.tree.edges[field]).all()
    assert not search.tree.edges["in_flight"].any()


@pytest.mark.parametrize("nested", [False, True])
def test_a_score_may_name_its_entries_otherwise(nested: bool) -> None:
    node = statistics([0.0, 2.0, 3.0], [0.1, 0.5, -1.0], squares=[0.0, 1.0, 3.0])

    def key(name: str) -> Any:
        return ("own", name) if nested else name

    for score_class, kwargs, names in (
        # What is called visits here is the win count.
        (
            PUCTScore,
            {"c": 1.0},
            {"win_count": "visits", "visits": "n", "total_visits": "N", "prior_prob": "p"},
        ),
        (UCBScore, {"c": 1.0}, {"win_count": "w", "visits": "n", "total_visits": "N"}),
        (UCB1TunedScore, {}, {"win_count": "w", "visits": "n", "sum_squared_rewards": "s"}),
        (EXP3Score, {}, {"weights": "w", "num_actions": "k"}),
    ):
        keys = {f"{name}_key": key(own) for name, own in names.items()}
        renamed = score_class(**kwargs, **keys, score_key=key("result"))
        expected = TorchRLScore(score_class(**kwargs))(node)
        assert torch.equal(TorchRLScore(renamed)(node), expected)


class Own(TensorDictModuleBase):
    """A score of one's own that reads the given entries."""

    def __init__(self, *in_keys: str) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(in_keys), ["result"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("result", sum(tensordict[key] for key in self.in_keys))


def test_a_score_of_ones_own_reads_the_entries_by_name() -> None:
    node = statistics([0.0, 2.0], [0.0, 0.5], priors=[0.75, 0.25])
    scores = TorchRLScore(Own("win_count", "prior_prob"))(node)
    assert scores.tolist() == [[0.75, 1.25]]


def test_a_score_that_reads_what_a_search_does_not_have_is_refused() -> None:
    with pytest.raises(ValueError, match=r"Own reads 'temperature'.*It has win_count, visits"):
        TorchRLScore(Own("visits", "temperature"))
    with pytest.raises(ValueError, match="Own reads 'weights'"):
        TorchRLScore(Own("weights"))
    with pytest.raises(TypeError, match=r"needs a score module.*PUCTScore\(c=1.25\); got UCT"):
        TorchRLScore(UCT())  # type: ignore[arg-type]


# ---------------------------------------------------------------------- policies of one's own


def test_a_policy_is_told_visits_values_and_squared_returns() -> None:
    # A corridor: the first simulation returns 1, the second 1 + 0.5 * 3, the third adds nothing.
    table = {(0, 0): (1, 1.0, 1), (1, 0): (2, 3.0, 1), (2, 0): (3, 0.0, 1), (0, 2): (3, 0.0, 1)}
    seen: list[NodeStatistics] = []

    def policy(node: NodeStatistics) -> Tensor:
        seen.append(node.clone())
        return torch.tensor([1.0, 9.0, 0.0]).expand(len(node), 3)

    env = TableEnv(table, terminal=[3])
    planner = MCTSPlanner(env, gamma=0.5, tree_policy=policy, expand="one", budget=simulations(3))
    planner(env.reset())
    at_root = [node for node in seen if node.depths.item() == 0]
    assert [node.depths.item() for node in seen] == [0, 0, 1, 0, 1, 2]
    assert all(node.allowed.tolist() == [[True, False, True]] for node in at_root)
    assert [node.node_visits.item() for node in at_root] == [1.0, 2.0, 3.0]
    assert [node.option_visits.tolist() for node in at_root] == [
        [[0.0, 0.0, 0.0]],
        [[1.0, 0.0, 0.0]],
        [[2.0, 0.0, 0.0]],
    ]
    assert [node.option_values[0, 0].item() for node in at_root] == [0.0, 1.0, 1.75]
    assert [node.option_squares[0, 0].item() for node in at_root] == [0.0, 1.0, 1.0 + 2.5**2]
    assert at_root[2].node_values.item() == pytest.approx((0.0 + 1.0 + 2.5) / 3)
    assert at_root[0].priors[0].tolist() == [0.5, 0.0, 0.5]


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (lambda node: torch.zeros(len(node), 3), r"returned \[1, 3\].*a tensor \[1, 2\]"),
        (lambda node: torch.zeros(2), r"returned \[2\].*a tensor \[1, 2\]"),
        (lambda node: [0.0, 1.0], r"returned list.*a tensor \[1, 2\]"),
        (
            lambda node: node.option_values / node.option_visits,
            "returned NaN for option 0, visited 0 times.*TorchRLScore",
        ),
    ],
)
def test_a_policy_that_returns_nonsense_is_named(policy: Any, message: str) -> None:
    env = ChainEnv(4)
    with pytest.raises(ValueError, match=f"The tree policy {message}"):
        MCTSPlanner(env, tree_policy=policy, expand="one")(env.reset())


@pytest.mark.parametrize("expand", ["one", "all"])
@pytest.mark.parametrize("last_call", range(8, 12))
def test_a_search_goes_on_after_its_policy_raised(expand: Any, last_call: int) -> None:
    calls = itertools.count()

    def policy(node: NodeStatistics) -> Tensor:
        if next(calls) == last_call:
            raise RuntimeError("no idea")
        return -node.option_visits

    env = ChainEnv(9)
    budget = expansions(12)
    planner = MCTSPlanner(env, tree_policy=policy, expand=expand, leaves_per_wave=3, budget=budget)
    with pytest.raises(RuntimeError, match="no idea"):
        planner.search(env.reset())
    search = planner.last_search
    assert search is not None
    assert not search.tree.edges["in_flight"].any()
    assert planner.resume(search).num_expansions[0] >= 12
    assert not search.tree.edges["in_flight"].any()


def test_not_a_number_for_a_forbidden_option_does_not_matter() -> None:
    env = TableEnv({(0, 1): (1, 0.0, 1), (1, 1): (2, 1.0, 1)}, terminal=[2])
    nan_first = lambda node: torch.tensor([math.nan, 1.0]).expand(len(node), 2)  # noqa: E731
    planner = MCTSPlanner(env, tree_policy=nan_first, expand="one")
    assert planner.plan(env.reset()).options.tolist() == [1, 1]


def test_something_that_is_no_policy_is_refused() -> None:
    with pytest.raises(TypeError, match=r"needs a tree policy.*TorchRLScore.*got 'uct'"):
        MCTSPlanner(ChainEnv(3), tree_policy="uct")  # type: ignore[arg-type]


# ---------------------------------------------------------------------- Gumbel


def gumbel_planner(env: TableEnv, simulations: int, **kwargs: Any) -> MCTSPlanner:
    budget = SearchBudget(simulations=simulations, until_plan=False)
    return MCTSPlanner(env, expand="one", budget=budget, **kwargs)


def test_gumbel_noise_follows_the_seed_and_draws_by_the_prior() -> None:
    env = bandit([0.0] * 3)
    prior = lambda td: torch.tensor([0.6, 0.3, 0.1]).expand(len(td), 3)  # noqa: E731
    planner = gumbel_planner(env, 1, tree_policy=Gumbel(max_considered=3), option_prior=prior)
    roots = at(env, [0] * 2000)
    first = planner.choose(planner.search(roots, seed=3))
    assert (first == planner.choose(planner.search(roots, seed=3))).all()
    # One simulation of the first option drawn: a draw from the prior, standard error 0.011.
    frequencies = np.bincount(first, minlength=3) / 2000
    assert frequencies.tolist() == pytest.approx([0.6, 0.3, 0.1], abs=0.05)


def test_a_final_choice_of_ones_own_replaces_that_of_gumbel() -> None:
    env = bandit([1.0, 0.0, 0.0, 0.0])
    prior = lambda td: torch.tensor([0.1, 0.1, 0.7, 0.1]).expand(len(td), 4)  # noqa: E731
    policy = Gumbel(max_considered=2, scale=0.0, c_scale=0.01)
    planner = gumbel_planner(
        env, 4, tree_policy=policy, option_prior=prior, final_choice=HighestValue()
    )
    assert planner(env.reset())["action"].item() == 0


@pytest.mark.parametrize(
    "kwargs",
    [
        {"budget": SearchBudget(expansions=8)},
        {"expand": "all"},
        {"leaves_per_wave": 2},
    ],
)
def test_gumbel_says_what_it_needs(kwargs: dict[str, Any]) -> None:
    rest = {"budget": SearchBudget(simulations=8), "expand": "one", **kwargs}
    with pytest.raises(ValueError, match=r"Gumbel needs a fixed number.*leaves_per_wave=1"):
        MCTSPlanner(ChainEnv(4), tree_policy=Gumbel(), **rest)
