"""What the planner does as a policy: batches, budgets, choices, evaluators, bad input, control."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
import torch
from search_parts import (
    BINARY_TREE,
    FOREVER,
    LEAVES,
    CountingEnv,
    DeadEnd,
    assert_nothing_in_flight,
    at,
    expansions,
    simulations,
    trees,
)
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.envs import ActionDiscretizer, Compose, PendulumEnv, StepCounter, TransformedEnv

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    BestPlan,
    DirichletNoise,
    Gumbel,
    HierarchicalPolicy,
    HighestValue,
    MCTSPlanner,
    MostVisited,
    RadiusNovelty,
    RolloutEvaluator,
    SampledVisits,
    SearchBudget,
    SearchProgress,
    SearchTree,
    extract_plans,
)
from torchrl_hmcts.planners.tree import FORBIDDEN
from torchrl_hmcts.testing import ChainEnv, TableEnv
from torchrl_hmcts.transforms import OptionTransform

# ---------------------------------------------------------------------- batches


@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 2), (1, 2, 3)])
def test_any_batch_shape_is_planned_for_and_written_with_its_shape(shape: tuple[int, ...]) -> None:
    env = ChainEnv(5)
    planner = MCTSPlanner(env, gamma=0.9)
    states = torch.randint(0, 4, shape)
    td = env.reset(TensorDict({"state": states}, shape), set_state=True)
    out = planner(td)
    assert out is td
    assert out["action"].shape == shape
    assert out["action"].dtype == torch.int64
    assert (out["action"] == 1).all()
    for key, dtype in (
        ("plan_found", torch.bool),
        ("root_value", torch.float32),
        ("num_expansions", torch.int64),
        ("num_simulated_steps", torch.int64),
    ):
        assert out[key].shape == (*shape, 1)
        assert out[key].dtype == dtype
    assert out["root_visits"].shape == (*shape, 2)
    plan = planner.plan(td)
    assert plan.batch_size == torch.Size(shape)
    assert torch.equal(plan.lengths, 4 - states)
    torch.testing.assert_close(plan.returns, 0.9 ** (3.0 - states))
    assert set(planner.out_keys) <= set(out.keys())


def test_the_plan_is_padded_behind_its_end() -> None:
    env = ChainEnv(5)
    plan = MCTSPlanner(env).plan(at(env, [3, 1]))
    assert plan.options.tolist() == [[1, -1, -1], [1, 1, 1]]
    assert plan.lengths.tolist() == [1, 3]
    assert plan.durations.tolist() == [1, 3]
    assert plan.states["state"].tolist() == [[3, 4, 4, 4], [1, 2, 3, 4]]


# ---------------------------------------------------------------------- closing and masks


@pytest.mark.parametrize("expand", ["one", "all"])
@pytest.mark.parametrize("leaves_per_wave", [1, 4])
def test_nothing_is_simulated_twice_and_an_exhausted_search_stops(
    expand: Any, leaves_per_wave: int
) -> None:
    env = CountingEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(env, expand=expand, leaves_per_wave=leaves_per_wave, budget=FOREVER)
    td = planner(env.reset())
    pairs = env.pairs
    assert sorted(pairs) == sorted(BINARY_TREE)
    assert td["num_expansions"].item() == (14 if expand == "one" else 7)
    assert td["num_simulated_steps"].item() == 14
    assert td["plan_found"].item()


def test_an_exhausted_search_without_a_reward_says_that_it_found_no_plan() -> None:
    env = TableEnv({(0, 0): (1, 0.0, 1), (0, 1): (1, -1.0, 1)}, terminal=[1])
    planner = MCTSPlanner(env)
    td = planner(env.reset())
    assert not td["plan_found"].item()
    assert td["num_expansions"].item() == 1
    plan = planner.plan(env.reset())
    assert (plan.found.item(), plan.lengths.item(), plan.returns.item()) == (False, 0, 0.0)
    assert plan.options.shape == (0,)


def test_without_durations_an_option_is_discounted_by_gamma_and_by_0_where_it_ends() -> None:
    env = ChainEnv(length=3)  # which writes no duration: state 2 ends the episode
    planner = MCTSPlanner(env, gamma=0.5, budget=expansions(4))
    assert planner.simulator.duration_key is None
    search = planner.search(env.reset().unsqueeze(0))
    count = search.tree.num_nodes[0]
    discounts = search.tree.nodes["discount"][0, 1:count]
    states = search.tree.get_states(
        np.zeros(count - 1, np.int64), np.arange(1, count), planner.simulator.state_keys
    )["state"]
    assert set(states.flatten().tolist()) == {0, 1, 2}
    assert discounts.tolist() == [0.0 if s == 2 else 0.5 for s in states.flatten().tolist()]


def test_roots_that_are_finished_cost_no_more_simulation() -> None:
    table = {(s, 0): (s + 1, float(s == 5), 1) for s in range(6)}
    env = CountingEnv(table, terminal=[6])
    planner = MCTSPlanner(env)
    td = planner(at(env, [0, 4, 5]))
    assert [len(call) for call in env.calls] == [3, 2, 1, 1, 1, 1]
    assert td["num_expansions"].flatten().tolist() == [6, 2, 1]


def test_all_roots_of_a_wave_share_one_simulator_call() -> None:
    env = CountingEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(env, budget=expansions(1))
    planner(at(env, [0, 0, 1, 2]))
    assert [len(call) for call in env.calls] == [8]


@pytest.mark.parametrize(("end", "value"), [("terminal", 0.0), ("truncated", 0.5)])
def test_a_root_that_has_ended_is_not_searched_and_a_truncated_one_worth_its_evaluation(
    end: str, value: float
) -> None:
    env = CountingEnv(BINARY_TREE, **{end: LEAVES})
    planner = MCTSPlanner(env, leaf_evaluator=lambda td: torch.full((len(td),), 0.5))
    td, ends = at(env, [7, 0]), torch.tensor([[True], [False]])
    td = planner(td.set("truncated" if value else "terminated", ends).set("done", ends))
    assert td["num_expansions"][0].item() == 0 < td["num_expansions"][1].item()
    assert td["root_visits"][0].tolist() == [0, 0]
    assert td["root_value"][0].item() == value
    assert not td["plan_found"][0].item()
    assert all(state != 7 for state, _ in env.pairs)


def test_truncation_bootstraps_and_termination_does_not() -> None:
    # Two base steps that earn 1, then the end of the episode; the evaluator says 8 everywhere.
    table = {(0, 0): (1, 1.0, 2)}
    roots = {}
    for end in ("terminal", "truncated"):
        env = TableEnv(table, **{end: [1]})
        planner = MCTSPlanner(
            env,
            gamma=0.5,
            backup="max",
            leaf_evaluator=lambda td: torch.full((len(td), 1), 8.0),
            budget=FOREVER,
        )
        td = planner(env.reset())
        roots[end] = td["root_value"].item()
        assert td["num_expansions"].item() == 1
    assert roots == {"terminal": 1.0, "truncated": 1.0 + 0.25 * 8.0}


def test_options_that_the_mask_forbids_are_never_simulated() -> None:
    table = {(0, 0): (1, 0.0, 1), (0, 2): (2, 0.0, 1), (1, 1): (3, 1.0, 1), (2, 2): (3, 2.0, 1)}
    for expand in ("one", "all"):
        env = CountingEnv(table, terminal=[3])
        td = MCTSPlanner(env, expand=expand, gamma=1.0, budget=FOREVER)(env.reset())
        assert sorted(env.pairs) == sorted(table)
        assert td["root_visits"][1].item() == 0
        assert td["action"].item() == 2


def test_the_mask_may_have_another_name() -> None:
    class RenamedMask(TableEnv):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            self.observation_spec["legal"] = self.observation_spec["action_mask"].clone()

        def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
            after = super()._step(tensordict)
            legal = after["action_mask"].clone()
            return after.set("legal", legal).set("action_mask", torch.ones_like(legal))

        def _reset(self, tensordict: TensorDictBase | None = None, **kw: Any) -> TensorDictBase:
            td = super()._reset(tensordict, **kw)
            return td.set("legal", td["action_mask"].clone())

    env = RenamedMask({(0, 1): (1, 0.0, 1), (1, 1): (2, 1.0, 1)}, terminal=[2])
    plan = MCTSPlanner(env, mask_key="legal").plan(env.reset())
    assert plan.options.tolist() == [1, 1]


def test_a_dead_end_below_the_root_is_closed() -> None:
    table = {(0, 0): (1, 0.5, 1), (0, 1): (2, 0.0, 1), (1, 0): (1, 9.0, 1), (2, 0): (3, 1.0, 1)}
    env = DeadEnd(table, terminal=[3])
    planner = MCTSPlanner(env, gamma=1.0, budget=FOREVER)
    td = planner(env.reset())
    assert td["num_expansions"].item() == 2
    assert planner.plan(env.reset()).returns.item() == 1.0


def test_a_python_policy_takes_no_option_of_a_dead_end_that_others_pass_by() -> None:
    # Root 0 revisits the dead end 1 while root 1 goes round and round between 2 and 3.
    table = {(0, 0): (1, 0.5, 1), (0, 1): (2, 0.0, 1), (1, 0): (1, 9.0, 1)}
    table |= {(2, 0): (3, 0.0, 1), (3, 0): (2, 0.0, 1)}
    env = DeadEnd(table)
    planner = MCTSPlanner(
        env,
        tree_policy=lambda statistics: -statistics.option_visits,
        expand="one",
        exhausted="revisit",
        budget=simulations(12),
    )
    search = planner.search(at(env, [0, 2]))
    assert search.num_simulations.tolist() == [12, 12]
    assert search.roots["revisits"][0] > 0 == search.roots["revisits"][1]
    assert all(state != 1 for state, _ in env.pairs)


def test_a_root_without_an_option_is_refused() -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    td = at(env, [0, 1])
    td["action_mask"][1] = False
    with pytest.raises(ValueError, match=r"Root 1 has no option that may be taken.*all False"):
        MCTSPlanner(env)(td)
    assert "action" not in td.keys()


# ---------------------------------------------------------------------- waves and memory


@pytest.mark.parametrize("expand", ["one", "all"])
def test_several_leaves_per_wave_find_the_same_exhausted_tree(expand: Any) -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    kwargs = {"expand": expand, "backup": "max", "budget": FOREVER}
    searches = [
        MCTSPlanner(env, leaves_per_wave=leaves, **kwargs).search(env.reset()) for leaves in (1, 5)
    ]
    one, many = (search.tree for search in searches)
    for search, tree in zip(searches, (one, many), strict=True):
        assert_nothing_in_flight(search)
        assert tree.states is not None
        assert sorted(tree.states["state"][0, :15].tolist()) == list(range(15))
    assert one.nodes["value"][0, 0] == many.nodes["value"][0, 0]
    assert one.nodes["visits"][0, 0] == many.nodes["visits"][0, 0] == 15


@pytest.mark.parametrize("expand", ["one", "all"])
def test_growing_by_doubling_loses_nothing(expand: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    env = ChainEnv(400)
    planner = MCTSPlanner(
        env,
        expand=expand,
        novelty=RadiusNovelty("state", 0.5),
        leaves_per_wave=3,
        budget=expansions(150),
    )
    td = at(env, [100, 200, 7])
    grown = planner.search(td)
    assert grown.tree.capacity > 64
    with monkeypatch.context() as patch:
        roomy = lambda roots, options, **kwargs: SearchTree(roots, options, capacity=4096)  # noqa: E731
        patch.setattr("torchrl_hmcts.planners.search.SearchTree", roomy)
        large = planner.search(td)
    assert large.tree.capacity == 4096
    assert int(grown.tree.num_nodes.min()) > 64
    assert trees(grown) == trees(large)
    used = int(grown.tree.num_nodes.min())
    assert (grown.tree.states[:, :used] == large.tree.states[:, :used]).all()
    assert np.array_equal(grown.tree.features[:, :used], large.tree.features[:, :used])


def test_a_view_shares_the_memory_of_the_tree() -> None:
    env = ChainEnv(4)
    tree = MCTSPlanner(env).search(at(env, [0, 1])).tree
    view = tree.view()
    assert view.batch_size == torch.Size([2])
    tree.nodes["value"][1, 0] = 123.0
    assert view.node_values[1, 0].item() == 123.0
    assert view.states.batch_size == torch.Size([2, tree.capacity])


# ---------------------------------------------------------------------- budgets


def test_the_search_stops_at_its_number_of_expansions() -> None:
    env = ChainEnv(100)
    for expand in ("one", "all"):
        planner = MCTSPlanner(env, expand=expand, budget=SearchBudget(expansions=17))
        td = planner(at(env, [0, 50]))
        assert td["num_expansions"].flatten().tolist() == [17, 17]
        assert not td["plan_found"].any()


def test_the_search_stops_when_its_base_steps_are_spent() -> None:
    env = TableEnv({(0, 0): (0, 0.0, 7), (0, 1): (0, 0.0, 3)})
    planner = MCTSPlanner(env, budget=SearchBudget(base_steps=35))
    td = planner(env.reset())
    assert td["num_simulated_steps"].item() == 40  # 10 per expansion: the wave that crosses 35
    assert td["num_expansions"].item() == 4


def test_the_search_stops_when_its_time_is_up() -> None:
    env = ChainEnv(100_000)
    budget = SearchBudget(expansions=10**9, seconds=0.2, until_plan=False)
    planner = MCTSPlanner(env, budget=budget)
    planner(env.reset())
    begin = time.perf_counter()
    planner(env.reset())
    assert 0.15 < time.perf_counter() - begin < 2.0


def test_the_search_stops_at_its_first_plan_or_improves_it_for_a_while() -> None:
    env = ChainEnv(4)
    first = MCTSPlanner(env).search(env.reset())
    found_at = int(first.expansions_to_plan[0])
    assert found_at == first.num_expansions[0]
    assert first.base_steps_to_plan[0] == first.num_base_steps[0]
    budget = SearchBudget(improve_expansions=5)
    search = MCTSPlanner(env, budget=budget).search(env.reset())
    assert search.expansions_to_plan[0] == found_at
    assert search.num_expansions[0] == found_at + 5
    endless = expansions(60)
    assert MCTSPlanner(env, budget=endless).search(env.reset()).num_expansions[0] == 60


@pytest.mark.parametrize("name", ["expansions", "simulations", "base_steps", "seconds", "nodes"])
@pytest.mark.parametrize("value", [0, -1])
def test_a_budget_of_nothing_is_refused_with_its_value(name: str, value: int) -> None:
    with pytest.raises(ValueError, match=f"{name} > 0; got {value}"):
        SearchBudget(**{name: value})


def test_a_progress_display_is_told_of_every_wave() -> None:
    env = CountingEnv(BINARY_TREE, terminal=LEAVES)
    seen: list[SearchProgress] = []
    MCTSPlanner(env, budget=FOREVER, progress=seen.append)(at(env, [0, 3]))
    assert len(seen) == len(env.calls)
    assert [p.num_roots for p in seen] == [2] * len(seen)
    assert seen[0].num_active == 2
    assert seen[-1].num_active == 1
    assert seen[-1].expansions == 8
    assert seen[-1].base_steps == 16
    seconds = [p.seconds for p in seen]
    assert seconds == sorted(seconds)


# ---------------------------------------------------------------------- simulations and nodes


# A ring of 50 states with three options each, none of which ends: no tree is ever exhausted.
RING = {
    (s, a): ((s * (a + 2) + a + 1) % 50, 0.01 * ((7 * s + 3 * a) % 11) - 0.05, 1 + (s + a) % 3)
    for s in range(50)
    for a in range(3)
}


@pytest.mark.parametrize("leaves_per_wave", [1, 2, 7, 255])
@pytest.mark.parametrize("n", [1, 13, 40])
def test_a_budget_of_simulations_is_spent_exactly(leaves_per_wave: int, n: int) -> None:
    env = CountingEnv(RING)
    planner = MCTSPlanner(env, expand="one", leaves_per_wave=leaves_per_wave, budget=simulations(n))
    td = planner(at(env, [0, 5]))
    assert td["num_simulations"].flatten().tolist() == [n, n]
    assert td["root_visits"].sum(-1).tolist() == [n, n]
    assert sum(map(len, env.calls)) == 2 * n
    # All options of a leaf are simulated together: up to two more of the three.
    env = CountingEnv(RING)
    planner = MCTSPlanner(env, leaves_per_wave=leaves_per_wave, budget=simulations(n))
    assert planner(env.reset())["num_simulations"].item() == 3 * -(-n // 3)


def test_a_budget_of_simulations_is_spent_however_long_nothing_new_was_found() -> None:
    # 10,000 fruitless revisits end a search only where nothing else does.
    env = CountingEnv(BINARY_TREE, terminal=LEAVES)
    planner = MCTSPlanner(
        env,
        tree_policy=UCT(20.0),
        expand="one",
        exhausted="revisit",
        leaves_per_wave=8,
        budget=simulations(10_500),
    )
    assert planner(env.reset())["num_simulations"].item() == 10_500


# ---------------------------------------------------------------------- interruptions


@pytest.mark.parametrize("expand", ["one", "all"])
@pytest.mark.parametrize("leaves_per_wave", [1, 2])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_the_best_plan_so_far_survives_an_interruption_and_the_search_goes_on(
    error: type[BaseException], leaves_per_wave: int, expand: Any
) -> None:
    class Interrupted(CountingEnv):
        interrupt = False

        def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
            if self.interrupt:
                raise error("stop")
            return super()._step(tensordict)

    env = Interrupted(BINARY_TREE, terminal=LEAVES)
    best: list[float] = []

    def watch(progress: SearchProgress) -> None:
        plans = extract_plans(progress.search)
        assert plans.found.item() == (progress.num_found == 1)
        best.append(plans.returns.item())
        env.interrupt = plans.found.item()

    planner = MCTSPlanner(
        env,
        gamma=1.0,
        expand=expand,
        leaves_per_wave=leaves_per_wave,
        budget=FOREVER,
        progress=watch,
    )
    with pytest.raises(error, match="stop"):
        planner(env.reset())
    search = planner.last_search
    assert search is not None
    assert best == sorted(best)
    plan = extract_plans(search)
    assert plan.found.item()
    assert plan.returns.item() == best[-1] > 0.0
    assert plan.lengths.item() == 3
    assert_nothing_in_flight(search)
    # Each transition pays once in a healthy search, so the rest is simulated now, and no more.
    env.interrupt = False
    planner.progress = None
    assert planner.resume(search) is search
    assert sorted(env.pairs) == sorted(BINARY_TREE)
    assert extract_plans(search).returns.item() == 4.0
    assert search.exhausted(np.array([0])).all()
    assert_nothing_in_flight(search)


def test_an_interrupted_gumbel_search_goes_on_with_its_schedule() -> None:
    class Interrupted(TableEnv):
        steps_left = 11

        def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
            if self.steps_left == 0:
                raise KeyboardInterrupt
            self.steps_left -= 1
            return super()._step(tensordict)

    env = Interrupted(RING)
    planner = MCTSPlanner(env, tree_policy=Gumbel(), expand="one", budget=simulations(30), seed=3)
    with pytest.raises(KeyboardInterrupt):
        planner.search(env.reset(), seed=8)
    search = planner.last_search
    assert search is not None
    assert search.num_simulations.tolist() == [11]
    env.steps_left = 1000
    planner.resume(search)
    assert trees(search) == trees(planner.search(env.reset(), seed=8))
    finished = trees(search)
    assert trees(planner.resume(search)) == finished  # a schedule ends once


def test_resuming_grants_a_fresh_budget() -> None:
    env = TableEnv(RING)
    planner = MCTSPlanner(env, expand="one", budget=simulations(20))
    search = planner.search(env.reset())
    planner.resume(search)
    assert search.num_simulations.tolist() == [20]
    assert search.tree.num_nodes.tolist() == [41]
    planner.budget = simulations(40)
    assert trees(planner.search(env.reset())) == trees(search)


# ---------------------------------------------------------------------- random numbers


def skewed(td: TensorDictBase) -> torch.Tensor:
    return torch.tensor([0.2, 0.3, 0.5]).expand(len(td), 3)


def root_priors(seed: int, num_roots: int = 1, **kwargs: Any) -> np.ndarray:
    env = TableEnv(RING)
    planner = MCTSPlanner(env, option_prior=skewed, budget=simulations(3), **kwargs)
    search = planner.search(at(env, [0] * num_roots), seed=seed)
    below = search.tree.edges["prior"][0, 1]
    np.testing.assert_allclose(below, [0.2, 0.3, 0.5])  # noise is the root's alone
    priors: np.ndarray = search.tree.edges["prior"][:, 0]
    return priors


def test_root_noise_is_mixed_into_the_prior_in_its_fraction() -> None:
    given = np.array([0.2, 0.3, 0.5])
    none = root_priors(0, root_noise=DirichletNoise(fraction=0.0))
    np.testing.assert_allclose(none[0], given, rtol=1e-6)
    half = root_priors(0, root_noise=DirichletNoise(fraction=0.5))[0]
    full = root_priors(0, root_noise=DirichletNoise(fraction=1.0))[0]
    np.testing.assert_allclose(half, 0.5 * given + 0.5 * full, rtol=1e-5)
    assert full.sum() == pytest.approx(1.0)
    assert not np.allclose(full, given, atol=0.01)


def test_root_noise_has_the_moments_of_its_dirichlet_distribution() -> None:
    # Dir(2, 2, 2): mean 1/3, variance (1/3)(2/3) / (6 + 1) = 0.0317; 600 roots.
    noise = root_priors(7, 600, root_noise=DirichletNoise(alpha=2.0, fraction=1.0))
    np.testing.assert_allclose(noise.mean(0), 1 / 3, atol=0.03)
    np.testing.assert_allclose(noise.var(0), 0.0317, atol=0.006)
    assert len(np.unique(noise[:, 0])) == 600


def test_root_noise_leaves_masked_options_at_zero() -> None:
    table = {(0, 0): (1, 0.0, 1), (0, 2): (1, 0.0, 1), (1, 1): (0, 0.0, 1)}
    env = TableEnv(table)
    for fraction in (0.0, 0.25, 1.0):
        planner = MCTSPlanner(
            env,
            option_prior=skewed,
            root_noise=DirichletNoise(fraction=fraction),
            budget=simulations(5),
        )
        edges = planner.search(env.reset()).tree.edges[0, 0]
        assert edges["closed"].tolist()[1] == FORBIDDEN
        assert edges["prior"][1] == 0.0
        assert edges["prior"].sum() == pytest.approx(1.0)
        if fraction == 0.0:  # 0.2 and 0.5, scaled to 1
            np.testing.assert_allclose(edges["prior"], [2 / 7, 0, 5 / 7], rtol=1e-6)


@pytest.mark.parametrize(("temperature", "power"), [(1.0, 1.0), (0.5, 2.0), (2.0, 0.5)])
def test_sampled_visits_follow_the_visits_to_the_power_of_one_over_t(
    temperature: float, power: float
) -> None:
    env = TableEnv(RING)
    planner = MCTSPlanner(env, tree_policy=UCT(0.03), expand="one", budget=simulations(60))
    search = planner.search(at(env, [0] * 3000), seed=5)
    visits = search.tree.edges["visits"][0, 0].astype(float)
    assert (search.tree.edges["visits"][:, 0] == visits).all()
    assert visits.max() > 1.5 * visits.min()  # otherwise every power looks the same
    chosen = SampledVisits(temperature=temperature).choose(search)
    expected = visits**power / (visits**power).sum()
    np.testing.assert_allclose(np.bincount(chosen, minlength=3) / 3000, expected, atol=0.035)
    np.testing.assert_array_equal(SampledVisits(temperature=temperature).choose(search), chosen)


def test_sampled_visits_never_take_a_masked_option() -> None:
    env = TableEnv({(0, 0): (1, 0.0, 1), (0, 2): (1, 0.0, 1), (1, 1): (0, 0.0, 1)})
    planner = MCTSPlanner(env, final_choice=SampledVisits(100.0), budget=simulations(20))
    assert set(planner(at(env, [0] * 100))["action"].tolist()) == {0, 2}


def rollouts() -> RolloutEvaluator:
    return RolloutEvaluator(max_options=3)


RANDOM: dict[str, dict[str, Any]] = {
    "noise": {"root_noise": DirichletNoise(), "tree_policy": PUCT(0.1)},
    "gumbel": {"tree_policy": Gumbel(max_considered=2), "expand": "one"},
    "rollouts": {"leaf_evaluator": rollouts, "leaves_per_wave": 3},
    "sampled": {"final_choice": SampledVisits()},
}


def random_planner(name: str, **kwargs: Any) -> tuple[TableEnv, MCTSPlanner]:
    kwargs = {**RANDOM[name], **kwargs}
    if "leaf_evaluator" in kwargs:
        kwargs["leaf_evaluator"] = kwargs["leaf_evaluator"]()
    env = TableEnv(RING)
    return env, MCTSPlanner(env, budget=simulations(30), **kwargs)


@pytest.mark.parametrize("name", RANDOM)
def test_a_seed_gives_one_tree_whatever_is_searched_beside_it(name: str) -> None:
    env, planner = random_planner(name)
    states = [0, 9, 9, 31, 9, 9]
    together = planner.search(at(env, states), seed=100)
    chosen = planner.choose(together)
    again = planner.search(at(env, states), seed=100)
    assert trees(together) == trees(again)
    np.testing.assert_array_equal(planner.choose(again), chosen)
    for b, state in enumerate(states):
        alone = planner.search(at(env, [state]), seed=100 + b)
        assert trees(alone)[0] == trees(together)[b]
        assert planner.choose(alone)[0] == chosen[b]
    if name != "sampled":  # roots 1, 2, 4 and 5 are the same state under different seeds
        assert any(trees(together)[1] != trees(together)[b] for b in (2, 4, 5))


@pytest.mark.parametrize("name", ["noise", "gumbel", "rollouts"])
def test_a_planner_with_a_seed_repeats_as_a_whole_but_not_from_call_to_call(name: str) -> None:
    runs = []
    for _ in range(2):
        env, planner = random_planner(name, seed=11)
        runs.append([trees(planner.search(at(env, 0))) for _ in range(6)])
    assert runs[0] == runs[1]
    assert any(run != runs[0][0] for run in runs[0])
    env, other = random_planner(name, seed=12)
    assert [trees(other.search(at(env, 0))) for _ in range(6)] != runs[0]


def test_without_a_seed_torch_decides() -> None:
    runs = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        env, planner = random_planner("noise")
        runs.append([trees(planner.search(at(env, 0))) for _ in range(2)])
    assert runs[0] == runs[1] != runs[2]
    assert runs[0][0] != runs[0][1]


# ---------------------------------------------------------------------- final choices


def test_the_final_choices_read_the_root_in_their_own_way() -> None:
    # Option 0: 0.6 and the end. Option 1: a loop of 0.2 per step with gamma 1/2, worth up to 0.4,
    # never closed and so most visited. Option 2: -0.2 now, then 2 and the end: the best plan.
    table = {
        (0, 0): (2, 0.6, 1),
        (0, 1): (1, 0.2, 1),
        (0, 2): (3, -0.2, 1),
        (1, 0): (1, 0.2, 1),
        (3, 0): (2, 2.0, 1),
    }
    env = TableEnv(table, terminal=[2])
    budget = expansions(50)
    chosen = {}
    for choice in (BestPlan(), MostVisited(), HighestValue()):
        planner = MCTSPlanner(
            env, gamma=0.5, expand="one", final_choice=choice, budget=budget, tree_policy=UCT(0.5)
        )
        td = planner(env.reset())
        chosen[type(choice)] = td["action"].item()
    # Values with mean backup: 0.6, at most 0.4, and -0.2 + (0 + 2)/2 / 2 = 0.3.
    assert chosen == {BestPlan: 2, MostVisited: 1, HighestValue: 0}


def test_the_most_visited_option_breaks_ties_by_value_then_by_index() -> None:
    table = {(0, 0): (1, 0.1, 1), (0, 1): (1, 0.3, 1), (0, 2): (1, 0.3, 1)}
    env = TableEnv(table, terminal=[1])
    planner = MCTSPlanner(env, final_choice=MostVisited(), budget=FOREVER)
    td = planner(env.reset())
    assert td["root_visits"].tolist() == [1, 1, 1]
    assert td["action"].item() == 1


def test_without_a_plan_the_best_plan_falls_back_to_the_most_visited_option() -> None:
    table = {(0, 0): (1, -1.0, 1), (0, 1): (2, -0.1, 1), (1, 0): (1, 0.0, 1), (2, 0): (2, 0.0, 1)}
    env = TableEnv(table)
    td = MCTSPlanner(env, budget=SearchBudget(expansions=20))(env.reset())
    assert not td["plan_found"].item()
    assert td["root_visits"].argmax().item() == td["action"].item() == 1


# ---------------------------------------------------------------------- evaluators and priors


def test_an_evaluator_may_be_a_module_call_with_a_trailing_dimension() -> None:
    net = torch.nn.Linear(1, 1)
    env = ChainEnv(5)
    planner = MCTSPlanner(env, leaf_evaluator=lambda td: net(td["state"].float().unsqueeze(-1)))
    td = planner(env.reset())
    assert not td["root_value"].requires_grad
    assert len(list(planner.parameters())) == 0


def constant(shape: tuple[int, ...], value: float) -> Any:
    return lambda td: torch.full(shape, value)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"leaf_evaluator": constant((1,), float("nan"))}, ValueError, "evaluator returned nan"),
        (
            {"leaf_evaluator": constant((1, 3), 0.0)},
            ValueError,
            r"shape \[1, 3\].*\[1\] or \[1, 1\]",
        ),
        ({"leaf_evaluator": lambda td: td}, TypeError, "must return a tensor; got TensorDict"),
        ({"option_prior": constant((1, 5), 0.2)}, ValueError, r"shape \[1, 5\].*\[1, 2\]"),
        ({"option_prior": constant((2,), 0.5)}, ValueError, r"shape \[2\].*\[1, 2\]"),
        ({"option_prior": constant((1, 2), float("nan"))}, ValueError, "prior returned nan"),
        ({"option_prior": constant((1, 2), -0.5)}, ValueError, "prior returned -0.5.*softmax"),
        ({"option_prior": lambda td: [0.5]}, TypeError, "option prior must return a tensor"),
    ],
)
def test_an_evaluator_that_returns_nonsense_is_named(
    kwargs: dict[str, Any], error: type[Exception], message: str
) -> None:
    env = ChainEnv(4)
    td = env.reset()
    with pytest.raises(error, match=message):
        MCTSPlanner(env, **kwargs)(td)
    assert "action" not in td.keys()


# ---------------------------------------------------------------------- bad input


def test_an_env_that_cannot_be_set_to_a_state_is_refused() -> None:
    gym_env = pytest.importorskip("torchrl.envs").GymEnv("CartPole-v1")
    with pytest.raises(
        ValueError, match=r"set to any state; GymEnv cannot .*WaterworldMazeEnv\(\)"
    ):
        MCTSPlanner(gym_env)


def test_something_that_is_no_torchrl_env_is_refused() -> None:
    with pytest.raises(TypeError, match="plans in a TorchRL env; got {}. Make one"):
        MCTSPlanner({})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"gamma": 0.0}, r"gamma > 0.0 and <= 1.0; got 0.0"),
        ({"gamma": 1.01}, r"gamma > 0.0 and <= 1.0; got 1.01"),
        ({"gamma": float("nan")}, r"gamma > 0.0 and <= 1.0; got nan"),
        ({"leaves_per_wave": 0}, "product up to 255; got leaves_per_wave=0"),
        ({"leaves_per_wave": 256}, "product up to 255; got leaves_per_wave=256"),
        ({"exhausted": "stop"}, "'skip' or 'revisit'; got 'stop'"),
        ({"expand": "some"}, "'all' or 'one'; got 'some'"),
    ],
)
def test_a_number_out_of_range_is_refused_at_construction(
    kwargs: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        MCTSPlanner(ChainEnv(3), **kwargs)


def test_missing_entries_of_the_state_are_named() -> None:
    env = TableEnv(BINARY_TREE, terminal=LEAVES)
    with pytest.raises(ValueError, match=r"lacks \['action_mask'\].*this one has.*state"):
        MCTSPlanner(env)(env.reset().exclude("action_mask"))
    with pytest.raises(ValueError, match=r"lacks \['state'\]"):
        MCTSPlanner(env)(env.reset().exclude("state"))


@pytest.mark.parametrize("key", ["th", ("params", "g")])
def test_a_state_that_is_not_finite_is_refused(key: Any) -> None:
    env = TransformedEnv(PendulumEnv(), ActionDiscretizer(num_intervals=3))
    td = env.reset()
    td.set(key, torch.full_like(td.get(key), float("nan")))
    with pytest.raises(ValueError, match="(?s)state to plan from has .* = nan.*not finite"):
        MCTSPlanner(env)(td)
    assert "plan_found" not in td.keys()


# ---------------------------------------------------------------------- other people's envs


@pytest.mark.parametrize("categorical", [True, False])
def test_a_discretised_pendulum_with_a_time_limit_is_planned_in(categorical: bool) -> None:
    discretizer = ActionDiscretizer(num_intervals=3, categorical=categorical)
    env = TransformedEnv(PendulumEnv(), Compose(discretizer, StepCounter(max_steps=4)))
    env.set_seed(0)
    planner = MCTSPlanner(env, backup="max", budget=expansions(200))
    assert planner.num_options == 3
    search = planner.search(env.reset())
    # 1 + 3 + 9 + 27 states are expanded, the 81 of the fourth step are truncated.
    assert search.num_expansions.tolist() == [40]
    assert search.tree.num_nodes.tolist() == [121]
    assert search.exhausted(np.array([0])).all()
    rollout = env.rollout(10, policy=planner)
    assert rollout.shape == (4,)
    # Once exhausted, max backup is the best of the 81 sequences, so each step keeps the promise.
    rewards, promised = rollout["next", "reward"].flatten(), rollout["root_value"].flatten()
    for i in range(3):
        assert promised[i].item() == pytest.approx(
            rewards[i].item() + 0.99 * promised[i + 1].item(), rel=1e-4
        )


def test_options_of_a_worker_are_planned_with_the_discount_they_were_made_with() -> None:
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    env = TransformedEnv(ChainEnv(9), OptionTransform(worker, 2, 3, gamma=0.5))
    planner = MCTSPlanner(env)
    assert planner.gamma == 0.5
    plan = planner.plan(env.reset())
    # Options of 3, 3 and 2 base steps to the right: 8 in all, the last one pays 1.
    assert plan.options.tolist() == [1, 1, 1]
    assert plan.durations.item() == 8
    assert plan.returns.item() == pytest.approx(0.5**7)
    rollout = env.rollout(10, policy=HierarchicalPolicy(planner))
    assert rollout["option"].tolist() == [1, 1, 1]
    assert rollout["next", "state"].tolist() == [3, 6, 8]


# ---------------------------------------------------------------------- as a policy


def test_elements_that_a_rollout_no_longer_steps_are_not_planned_for() -> None:
    # TorchRL fills them with zeros, whose action mask would forbid everything.
    env = CountingEnv({(s, 0): (s + 1, float(s == 5), 1) for s in range(6)}, terminal=[6])
    planner = MCTSPlanner(env, budget=SearchBudget(expansions=1))
    rollout = env.rollout(
        20,
        policy=planner,
        tensordict=at(env, [0, 4, 5]),
        auto_reset=False,
        break_when_all_done=True,
    )
    assert rollout["next", "done"][:, -1].all()
    # Calls alternate: one of the search, one of the rollout itself.
    assert [len(call) for call in env.calls] == [3, 3, 2, 2] + [1, 1] * 4
