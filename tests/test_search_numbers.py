"""The numbers of a search: priors under masks, arrays that users change, magnitudes and counts."""

from __future__ import annotations

import copy
import dataclasses
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from search_parts import simulations
from tensordict import TensorDict, TensorDictBase
from torchrl.modules.mcts.scores import PUCTScore

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    DirichletNoise,
    Gumbel,
    HierarchicalPolicy,
    MCTSPlanner,
    MostVisited,
    NodeStatistics,
    ProgressiveWidening,
    RadiusNovelty,
    Root,
    Search,
    SearchBudget,
    TorchRLScore,
    Transition,
    Transpositions,
    tree_search,
)
from torchrl_hmcts.planners.tree import MOST_VISITS
from torchrl_hmcts.testing import ChainEnv, TableEnv

F32 = np.float32


# ---------------------------------------------------------------------- priors under masks

PAY, PRIOR, ALLOWED = np.array([0.0, 0.5, 0.9], F32), np.array([0.98, 0.011, 0.009], F32), [1, 2]
BANDIT = {(0, 1): (1, 0.5, 1), (0, 2): (1, 0.9, 1)}  # option 0 is forbidden


def puct_by_hand(prior: np.ndarray, num_simulations: int, c: float) -> list[int]:
    """Visits of a bandit whose allowed options share ``prior`` among them."""
    visits = [0, 0, 0]
    prior = prior / prior[ALLOWED].sum()
    for _ in range(num_simulations):
        root = sum(visits) ** 0.5

        def score(a: int, root: float = root) -> tuple[float, float]:
            q = float(PAY[a]) if visits[a] else 0.0
            return q + c * float(prior[a]) * root / (1 + visits[a]), float(prior[a])

        visits[max(ALLOWED, key=score)] += 1
    return visits


def bandit_planner(**kwargs: Any) -> MCTSPlanner:
    prior = kwargs.pop("prior", PRIOR)
    if prior is not None:
        kwargs["option_prior"] = lambda td: torch.from_numpy(prior).expand(*td.batch_size, 3)
    return MCTSPlanner(
        TableEnv(BANDIT, terminal=[1]),
        **{"expand": "one", "exhausted": "revisit", "budget": simulations(40), "seed": 0, **kwargs},
    )


@pytest.mark.parametrize("tree_policy", [PUCT(c=1.25), TorchRLScore(PUCTScore(c=1.25))])
def test_the_priors_of_the_allowed_options_sum_to_one(tree_policy: Any) -> None:
    planner = bandit_planner(tree_policy=tree_policy, final_choice=MostVisited())
    td = planner(planner.simulator.env.reset())
    assert puct_by_hand(PRIOR, 40, c=1.25) == [0, 8, 32]  # 8 and 32, worked out in the cases too
    assert td["root_visits"].tolist() == [0, 8, 32]
    assert td["action"].item() == 2

    def transition(state: np.ndarray, option: np.ndarray) -> Transition:
        zero = np.zeros(len(state), F32)
        return Transition(PAY[option], zero, np.full((len(state), 3), 1 / 3, F32), zero, state)

    root = Root(PRIOR[None], np.zeros(1, F32), np.zeros(1, np.int64))
    mask = np.array([[False, True, True]])
    search = tree_search(root, transition, 40, tree_policy=tree_policy, mask=mask)
    assert search.tree.edges["visits"][0, 0].tolist() == [0, 8, 32]


CORRIDOR = {(0, 0): (1, 0.0, 1), (1, 0): (2, 0.0, 1), (1, 2): (3, 1.0, 1), (2, 1): (3, 0.0, 1)}


@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        (None, [[1, 0, 0], [0.5, 0, 0.5], [0, 1, 0]]),
        ([0.2, 0.5, 0.3], [[1, 0, 0], [0.4, 0, 0.6], [0, 1, 0]]),
        ([0.0, 1.0, 0.0], [[1, 0, 0], [0.5, 0, 0.5], [0, 1, 0]]),  # nothing on what is allowed
        ([6.0, 1.0, 2.0], [[1, 0, 0], [0.75, 0, 0.25], [0, 1, 0]]),  # weights, no probabilities
    ],
)
@pytest.mark.parametrize("expand", ["one", "all"])
def test_every_node_has_priors_that_sum_to_one(
    weights: list[float] | None, expected: list[list[float]], expand: Any
) -> None:
    def prior(td: TensorDictBase) -> torch.Tensor:
        return torch.tensor(weights).expand(len(td), 3)

    env = TableEnv(CORRIDOR, terminal=[3])
    planner = MCTSPlanner(
        env, option_prior=None if weights is None else prior, expand=expand, budget=simulations(9)
    )
    search = planner.search(env.reset())
    nodes = {0: 0, 1: 1, 2: search.tree.outcomes(0, 0, 1)[0]}
    for state, node in nodes.items():
        assert search.tree.edges["prior"][0, node].tolist() == pytest.approx(expected[state])
    after = env.step(env.reset().set("action", torch.tensor(0)))["next"]
    assert planner.advance(search, torch.tensor(0), after).item()
    assert search.tree.edges["prior"][0, 0].tolist() == pytest.approx(expected[1])


def test_probabilities_of_options_that_are_all_allowed_keep_their_bits() -> None:
    prior = np.array([[0.1, 0.2, 0.7]], F32)  # their sum is not quite 1 in float32

    def transition(state: np.ndarray, option: np.ndarray) -> Transition:
        ones = np.ones(len(state), F32)
        return Transition(ones, 0.9 * ones, prior[state], 0 * ones, state)

    search = tree_search(Root(prior, np.zeros(1, F32), np.zeros(1, np.int64)), transition, 3)
    assert (search.tree.edges["prior"][0, :4] == prior).all()


# ---------------------------------------------------------------------- arrays that users change


def walk(state: np.ndarray, option: np.ndarray) -> Transition:
    """Left or right among five states, of which the last ends the episode with 1."""
    after = np.clip(state + 2 * option - 1, 0, 4)
    end = (after == 4).astype(F32)
    prior = np.full((len(state), 2), 0.5, F32)
    return Transition(end, F32(0.9) * (1 - end), prior, 0 * end, after)


def spoils_its_options(state: np.ndarray, option: np.ndarray) -> Transition:
    answer = walk(state, option)
    option += 10**6
    return answer


def spoils_its_states(state: np.ndarray, option: np.ndarray) -> Transition:
    answer = walk(state, option)
    state -= 7
    return answer


def answers_in_its_states(state: np.ndarray, option: np.ndarray) -> Transition:
    answer = walk(state, option)
    state[:] = answer.embedding
    return answer._replace(embedding=state)


class ReusesItsArrays:
    def __init__(self) -> None:
        self.kept: dict[Any, np.ndarray] = {}

    def __call__(self, state: np.ndarray, option: np.ndarray) -> Transition:
        answer = walk(state, option)
        for i, array in enumerate(answer):
            self.kept.setdefault((i, array.shape), np.empty_like(array))[...] = array
        return Transition(*(self.kept[i, array.shape] for i, array in enumerate(answer)))


def root_of(num_roots: int = 1) -> Root:
    return Root(np.full((num_roots, 2), 0.5, F32), np.zeros(num_roots, F32), np.full(num_roots, 2))


def least_visited(node: NodeStatistics) -> torch.Tensor:
    scores = -node.option_visits.clone()
    for entry in (node.allowed, node.option_visits, node.option_values, node.priors, node.depths):
        entry.zero_()  # what it is shown is its own
    return scores


@pytest.mark.parametrize("tree_policy", [PUCT(), least_visited])
@pytest.mark.parametrize("leaves_per_wave", [1, 3])
@pytest.mark.parametrize(
    "transition",
    [spoils_its_options, spoils_its_states, answers_in_its_states, ReusesItsArrays()],
)
def test_what_a_transition_function_does_to_its_arrays_changes_no_tree(
    transition: Any, tree_policy: Any, leaves_per_wave: int
) -> None:
    kwargs: dict[str, Any] = {"tree_policy": tree_policy, "leaves_per_wave": leaves_per_wave}
    honest = tree_search(root_of(2), walk, 60, **kwargs)
    search = tree_search(root_of(2), transition, 60, **kwargs)
    assert search.tree.edges.tobytes() == honest.tree.edges.tobytes()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda x: x._replace(embedding=np.repeat(x.embedding, 2)), ValueError, r"int64 \[2\]"),
        (lambda x: x._replace(prior=-x.prior), ValueError, "the prior -0.5; .*not negative"),
        (lambda x: x._replace(discount=x.discount + 1), ValueError, r"the discount 1.8\d*; .*1\]"),
        (lambda x: x._replace(discount=x.discount - 1), ValueError, r"the discount -0.1\d*; "),
        (lambda x: x._replace(reward=x.reward + F32(3e38)), ValueError, "the reward 3.*smaller"),
        (lambda x: x._replace(value=x.value - F32(3e38)), ValueError, "the value -3.*smaller"),
        (lambda x: x[:4], TypeError, "returned tuple; return a Transition"),
        (lambda x: x._replace(reward=x.reward.tolist()), TypeError, "reward as list"),
    ],
)
@pytest.mark.parametrize("tree_policy", [PUCT(), least_visited])
def test_an_answer_that_turns_bad_is_named(
    change: Callable[[Any], Any], error: type[Exception], message: str, tree_policy: Any
) -> None:
    calls: list[int] = []

    def turns_bad(state: np.ndarray, option: np.ndarray) -> Any:
        calls.append(0)
        return walk(state, option) if len(calls) < 3 else change(walk(state, option))

    with pytest.raises(error, match=message):
        tree_search(root_of(), turns_bad, 20, tree_policy=tree_policy)
    assert len(calls) == 3


@pytest.mark.parametrize(
    ("change", "got"),
    [
        (lambda x: x.bfloat16(), r"bfloat16 \[1\]"),
        (lambda x: torch._neg_view(-x), r"float32 \[1\] \(not contiguous\)"),
    ],
)
@pytest.mark.parametrize("tree_policy", [PUCT(), least_visited])
def test_a_tensor_that_numpy_cannot_read_is_named(
    change: Callable[[torch.Tensor], torch.Tensor], got: str, tree_policy: Any
) -> None:
    def transition(state: torch.Tensor, option: torch.Tensor) -> Transition:
        answer = Transition(*map(torch.from_numpy, walk(state.numpy(), option.numpy())))
        return answer._replace(reward=change(answer.reward))

    root = Root(*map(torch.from_numpy, root_of()))
    with pytest.raises(ValueError, match=f"returned reward as {got}; it must be float32"):
        tree_search(root, transition, 20, tree_policy=tree_policy)


@pytest.mark.parametrize("embedding", [np.array([None]), torch.zeros(1, 3, dtype=torch.bfloat16)])
def test_states_that_numpy_cannot_keep_are_refused(embedding: Any) -> None:
    with pytest.raises(TypeError, match=r"embedding must be rows of numbers .* got (object|.*16)"):
        tree_search(root_of()._replace(embedding=embedding), walk, 20)


class ReusesItsTensors(ChainEnv):
    """Writes every step's outcome into the same tensors, and into the options it was given."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = super()._step(tensordict)
        kept = self.__dict__.setdefault("kept", {})
        out = kept.setdefault(len(after), after.clone())
        out.update_(after)
        tensordict["action"].fill_(10**6)
        return out


@pytest.mark.parametrize("waves_in_flight", [1, 2])
@pytest.mark.parametrize("chance", [None, ProgressiveWidening()])
def test_an_env_that_reuses_its_tensors_changes_no_tree(
    waves_in_flight: int, chance: ProgressiveWidening | None
) -> None:
    def edges(env: ChainEnv) -> bytes:
        planner = MCTSPlanner(
            env, expand="one", budget=simulations(60), waves_in_flight=waves_in_flight, seed=0,
            chance=chance, leaves_per_wave=2,
        )  # fmt: skip
        return planner.search(env.reset()).tree.edges.tobytes()

    assert edges(ReusesItsTensors(length=6)) == edges(ChainEnv(length=6))


@pytest.mark.parametrize("part", ["leaf_evaluator", "option_prior"])
def test_an_evaluator_that_changes_its_states_changes_no_tree(part: str) -> None:
    def spoils(td: TensorDictBase) -> torch.Tensor:
        td["state"].fill_(0)
        return torch.full((len(td), 2), 0.5) if part == "option_prior" else torch.zeros(len(td))

    env = ChainEnv(length=6)
    honest = MCTSPlanner(env, seed=0).plan(env.reset())
    td = env.reset(TensorDict(batch_size=[1]))
    plan = MCTSPlanner(env, seed=0, **{part: spoils}).plan(td)
    assert plan.options.squeeze(0).tolist() == honest.options.tolist()
    td["state"] += 3
    planner = MCTSPlanner(env, seed=0, **{part: spoils})
    planner.search(td)
    assert td["state"].item() == 3


@pytest.mark.parametrize(
    ("field", "wrong", "message"),
    [
        ("rewards", np.zeros(1, F32), r"rewards \[1\] for 2 states; it needs \[2\]"),
        ("durations", np.ones(3, np.int64), r"durations \[3\]"),
        ("priors", np.ones((2, 3), F32), r"priors \[2, 3\] for 2 states; it needs \[2, 2\]"),
        ("masks", np.ones((1, 2), np.bool_), r"masks \[1, 2\]"),
        ("rewards", np.full(2, 1e31, F32), "the reward 9.99"),
        ("values", np.full(2, np.nan, F32), "the value nan"),
        ("priors", np.full((2, 2), -1, F32), "priors not negative"),
    ],
)
def test_outcomes_that_do_not_fit_a_wave_are_refused(
    field: str, wrong: np.ndarray, message: str
) -> None:
    from torchrl_hmcts.planners.outcomes import Outcomes, RootStates
    from torchrl_hmcts.planners.subtree import reroot

    search = Search(1, 2)
    nothing, no_masks = np.zeros((0, 2), F32), np.zeros((0, 2), np.bool_)
    search.plant(RootStates(np.zeros(1, F32), np.zeros(1, np.bool_), nothing, no_masks))
    wave = search.select()
    ones = np.ones(2, F32)
    good = Outcomes(
        ones, ones, np.ones(2, np.int64), np.zeros(2, np.bool_), ones, nothing, no_masks
    )
    with pytest.raises(ValueError, match=message):
        search.insert(wave, good._replace(**{field: wrong}))
    assert search.insert(wave, good).tolist() == [1, 2]  # nothing was written before
    with pytest.raises(ValueError, match="has no node 3"):
        reroot(search, 0, 3)


def test_a_novelty_test_that_answers_in_indices_is_refused() -> None:
    class Indices(RadiusNovelty):
        def accept(self, *args: Any) -> np.ndarray:
            return np.flatnonzero(super().accept(*args))

    env = ChainEnv(length=6)
    with pytest.raises(ValueError, match="returned int64 .*a bool for each"):
        MCTSPlanner(env, novelty=Indices("state", 0.5)).search(env.reset())


# ---------------------------------------------------------------------- magnitudes


class Loop(TableEnv):
    """One state, two options that stay in it and earn ``pay`` in ``duration`` base steps."""

    def __init__(self, pay: float, duration: int = 1) -> None:
        super().__init__({(0, 0): (0, pay, duration), (0, 1): (0, pay, duration)})


@pytest.mark.parametrize("kwargs", [{}, {"backup": "max"}, {"chance": ProgressiveWidening()}])
@pytest.mark.parametrize("pay", [3e38, -3e38, 1e31])
def test_a_reward_whose_sums_would_overflow_is_named(pay: float, kwargs: dict[str, Any]) -> None:
    env = Loop(pay)
    planner = MCTSPlanner(env, budget=simulations(50), seed=0, **kwargs)
    with pytest.raises(ValueError, match="the reward .*scale the rewards"):
        planner(env.reset())


@pytest.mark.parametrize(
    "tree_policy", [UCT(), PUCT(), PUCT.mctx(), PUCT(normalize="tree"), Gumbel()]
)
def test_the_largest_rewards_give_finite_values(tree_policy: Any) -> None:
    env = Loop(9e29)
    planner = MCTSPlanner(
        env, gamma=1.0, tree_policy=tree_policy, expand="one", budget=simulations(300), seed=0
    )
    search = planner.search(env.reset())
    assert np.isfinite(search.tree.nodes["value"]).all()
    assert np.isfinite(search.tree.edges["value"]).all()
    assert np.isfinite(search.best_return).all()
    assert search.num_simulations.tolist() == [300]


def test_a_value_whose_sums_would_overflow_is_named() -> None:
    env = ChainEnv(length=4)
    planner = MCTSPlanner(env, leaf_evaluator=lambda td: torch.full((len(td),), 3e38))
    with pytest.raises(ValueError, match="leaf evaluator returned 3.*smaller than 1e"):
        planner(env.reset())


@pytest.mark.parametrize("duration", [0, -3, 2**31])
def test_a_duration_that_no_option_takes_is_named(duration: int) -> None:
    env = Loop(0.0, duration)
    with pytest.raises(ValueError, match=f"duration of {duration}.*one base step or more"):
        MCTSPlanner(env)(env.reset())


def test_a_path_that_would_be_too_long_to_count_is_refused() -> None:
    env = Loop(0.0, 2**30)
    with pytest.raises(ValueError, match="2,147,483,647 at most"):
        MCTSPlanner(env)(env.reset())


def test_a_discount_that_underflows_leaves_the_reward() -> None:
    env = TableEnv({(0, 0): (1, 1.0, 10**6), (1, 0): (2, 5.0, 1)}, terminal=[2])
    search = MCTSPlanner(env, gamma=0.5, budget=simulations(2)).search(env.reset())
    assert search.tree.edges["value"][0, 0].tolist() == [1.0]


# ---------------------------------------------------------------------- very many visits

COIN = {(0, 0): (1, 1.0, 1), (0, 1): (2, 0.0, 1)}  # pays 1 or 0


def with_visits(visits: int, mean: float) -> tuple[MCTSPlanner, Search]:
    """A search of the coin that has been at it for ``visits`` simulations."""
    env = TableEnv(COIN, terminal=[1, 2])
    planner = MCTSPlanner(
        env, tree_policy=UCT(c=0.0), expand="one", exhausted="revisit", budget=simulations(10)
    )
    search = planner.search(env.reset())
    tree = search.tree
    tree.nodes["visits"][0, 0], tree.nodes["value"][0, 0] = visits, mean
    tree.edges["visits"][0, 0, 0] = visits
    return planner, search


def test_a_mean_of_very_many_visits_still_moves() -> None:
    # 60,000,000 returns of mean 0.1, then 2,000,000 of 1: (6 + 2) / 62 = 0.129032...
    planner, search = with_visits(60_000_000, 0.1)
    planner.budget = simulations(2_000_000)
    planner.resume(search)
    assert search.tree.nodes["visits"][0, 0] == 62_000_000
    assert search.tree.nodes["value"][0, 0] == pytest.approx(8 / 62, rel=1e-6)


def test_a_search_ends_before_its_visits_would_wrap() -> None:
    planner, search = with_visits(MOST_VISITS - 5_000, 1.0)
    planner.budget = simulations(20_000_000)
    planner.resume(search)
    assert search.tree.nodes["visits"].min() >= 0
    assert MOST_VISITS <= search.tree.nodes["visits"][0, 0] < 2**31 - 1


# ---------------------------------------------------------------------- counts

HUGE = [sys.maxsize, 2**31, 2**63 - 1, 2**63, 2**70, np.int64(2**62)]


@pytest.mark.parametrize("huge", HUGE)
def test_a_huge_number_of_expansions_improves_to_the_end(huge: int) -> None:
    env = ChainEnv(length=5)
    budget = SearchBudget(expansions=40, improve_expansions=huge)
    assert MCTSPlanner(env, budget=budget, seed=0)(env.reset())["num_expansions"] == 40
    chance = MCTSPlanner(
        env, chance=ProgressiveWidening(k=1.0, alpha=0.0), expand="one", seed=0,
        budget=SearchBudget(simulations=huge, until_plan=False, nodes=6),
    )  # fmt: skip
    assert chance(env.reset())["num_expansions"].item() == 5


@pytest.mark.parametrize("wrong", [1e3, 1.5, True, np.bool_(True), "3", float("inf"), 0, -1])
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda n: SearchBudget(expansions=n), "expansions"),
        (lambda n: SearchBudget(simulations=n), "simulations"),
        (lambda n: SearchBudget(base_steps=n), "base_steps"),
        (lambda n: SearchBudget(nodes=n), "nodes"),
        (lambda n: MCTSPlanner(ChainEnv(4), leaves_per_wave=n), "leaves_per_wave"),
        (lambda n: MCTSPlanner(ChainEnv(4), waves_in_flight=n), "waves_in_flight"),
        (lambda n: Gumbel(max_considered=n), "max_considered"),
        (lambda n: tree_search(root_of(), walk, n), "num_simulations"),
        (lambda n: Search(1, 2, capacity=n), "capacity"),
        (lambda n: Search(1, n), "num_options"),
    ],
)
def test_a_count_that_is_none_is_refused_by_name(
    make: Callable[[Any], Any], name: str, wrong: Any
) -> None:
    with pytest.raises((TypeError, ValueError), match=name):
        make(wrong)


@pytest.mark.parametrize("seed", [2**63 - 1, 2**63, 2**64 + 5, np.int32(7)])
def test_a_huge_seed_is_a_seed(seed: int) -> None:
    kwargs: dict[str, Any] = {"tree_policy": Gumbel()}
    search = tree_search(root_of(3), walk, 8, seed=seed, **kwargs)
    assert search.seeds.tolist() == [(int(seed) + b) % 2**63 for b in range(3)]
    env = ChainEnv(length=5)
    assert MCTSPlanner(env).search(env.reset(), seed=seed).seeds[0] == int(seed) % 2**63
    assert MCTSPlanner(env, seed=seed)(env.reset())["action"].item() == 1


@pytest.mark.parametrize("seed", [-1, 1.0, True])
def test_a_seed_that_is_none_is_refused_by_name(seed: Any) -> None:
    env = ChainEnv(length=5)
    for make in (
        lambda: tree_search(root_of(), walk, 8, seed=seed),
        lambda: MCTSPlanner(env, seed=seed),
        lambda: MCTSPlanner(env).search(env.reset(), seed=seed),
    ):
        with pytest.raises((TypeError, ValueError), match="seed"):
            make()


def test_gumbel_refuses_more_simulations_than_it_can_plan() -> None:
    with pytest.raises(ValueError, match="plans every simulation ahead, 16,777,216 at most"):
        MCTSPlanner(
            ChainEnv(4), tree_policy=Gumbel(), expand="one", budget=simulations(sys.maxsize)
        )


# ---------------------------------------------------------------------- no roots


@pytest.mark.parametrize("shape", [[0], [2, 0]])
@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"tree_policy": Gumbel(), "expand": "one", "budget": simulations(4)},
        {"tree_policy": least_visited},
        {"root_noise": DirichletNoise()},
        {"novelty": RadiusNovelty("state", 0.5)},
        {"transpositions": Transpositions("state")},
        {"chance": ProgressiveWidening()},
    ],
)
def test_no_roots_are_an_empty_answer(kwargs: dict[str, Any], shape: list[int]) -> None:
    env = ChainEnv(length=5)
    planner = MCTSPlanner(env, seed=0, **kwargs)
    td = env.reset(TensorDict(batch_size=shape))
    out = planner(td.clone())
    assert out["action"].shape == torch.Size(shape)
    assert out["root_visits"].shape == torch.Size([*shape, 2])
    assert planner.plan(td).lengths.shape == torch.Size(shape)
    search = planner.search(td)
    action = torch.zeros(shape, dtype=torch.int64)
    assert planner.advance(search, action, td).shape == torch.Size(shape)
    assert planner.resume(search).num_simulations.tolist() == []
    assert HierarchicalPolicy(planner)(td.clone())["plan_step"].shape == torch.Size([*shape, 1])


# ---------------------------------------------------------------------- parts that are assigned


@pytest.mark.parametrize(
    ("first", "then", "names"),
    [
        (UCT(c=1.0), UCT(c=50.0), ["c"]),
        (PUCT(c=1.0), PUCT(c=9.0, unvisited_value=0.5), ["c", "unvisited_value"]),
    ],
)
def test_a_kept_search_follows_the_tree_policy_of_its_planner(
    first: Any, then: Any, names: list[str]
) -> None:
    env = ChainEnv(length=6)
    planner = MCTSPlanner(env, tree_policy=first, seed=0)
    search = planner.plant(env.reset())
    planner.tree_policy = then
    planner.resume(search)
    assert [search.record[name][0] for name in names] == [getattr(then, name) for name in names]
    planted = MCTSPlanner(env, tree_policy=then, seed=0).search(env.reset())
    assert search.tree.edges.tobytes() == planted.tree.edges.tobytes()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tree_policy", PUCT()),
        ("backup", "max"),
        ("novelty", RadiusNovelty("state", 0.5)),
        ("transpositions", Transpositions("state")),
        ("chance", ProgressiveWidening()),
        ("expand", "one"),
        ("exhausted", "revisit"),
    ],
)
def test_a_kept_search_refuses_what_its_tree_does_not_fit(name: str, value: Any) -> None:
    env = ChainEnv(length=6)
    planner = MCTSPlanner(env, seed=0)
    search = planner.plant(env.reset())
    other = MCTSPlanner(env, seed=0, **{name: value})
    with pytest.raises(ValueError, match=f"planted with {name}=.*plant a new one"):
        other.resume(search)
    setattr(planner, name, value)
    with pytest.raises(ValueError, match=f"planted with {name}="):
        planner.resume(search)


@pytest.mark.parametrize("tree_policy", [UCT(), least_visited])
def test_a_kept_search_follows_the_waves_of_its_planner(tree_policy: Any) -> None:
    env = ChainEnv(length=6)
    kwargs: dict[str, Any] = {"tree_policy": tree_policy, "expand": "one", "budget": simulations(9)}
    planner = MCTSPlanner(env, **kwargs)
    search = planner.plant(env.reset())
    planner.leaves_per_wave, planner.waves_in_flight = 3, 2
    planner.resume(search)
    planted = MCTSPlanner(env, leaves_per_wave=3, waves_in_flight=2, **kwargs).search(env.reset())
    one, other = (x.tree.edges[:, : x.tree.num_nodes[0]] for x in (search, planted))
    assert one.tobytes() == other.tobytes()
    planner.leaves_per_wave, planner.waves_in_flight = 1, 1
    assert planner.resume(search).num_simulations.tolist() == [9]
    assert not search.tree.edges["in_flight"].any()


def test_a_planner_and_its_search_hold_the_same_settings_which_cannot_be_changed() -> None:
    env = ChainEnv(length=6)
    planner = MCTSPlanner(env, seed=0)
    search = planner.plant(env.reset())
    assert search.settings is planner.settings
    with pytest.raises(dataclasses.FrozenInstanceError):
        planner.settings.tree_policy = UCT(c=5.0)  # type: ignore[misc]
    planner.tree_policy = UCT(c=5.0)
    assert planner.settings.tree_policy == planner.tree_policy == UCT(c=5.0)
    assert planner.resume(search).settings is planner.settings


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("tree_policy", Gumbel(), "Gumbel needs a fixed number"),
        ("leaves_per_wave", 0, "product up to 255; got leaves_per_wave=0"),
        ("expand", "some", "expand must be 'all' or 'one'; got 'some'"),
        ("settings", UCT(), "SearchSettings for settings"),
    ],
)
def test_a_part_that_makes_no_search_is_refused_where_it_is_assigned(
    name: str, value: Any, error: str
) -> None:
    planner = MCTSPlanner(ChainEnv(length=6), seed=0)
    before = planner.settings
    with pytest.raises((ValueError, TypeError), match=error):
        setattr(planner, name, value)
    assert planner.settings is before


def test_a_copy_of_a_search_is_resumed() -> None:
    env = ChainEnv(length=6)
    planner = MCTSPlanner(env, novelty=RadiusNovelty("state", 0.5), seed=0)
    search = planner.plant(env.reset())
    copied = planner.resume(copy.deepcopy(search))
    assert copied.tree.edges.tobytes() == planner.resume(search).tree.edges.tobytes()
