"""Novelty tests: what they accept, and what a search makes of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_hmcts.envs import GridworldMazeEnv, generate_mazes, shortest_path
from torchrl_hmcts.planners import UCT, MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.testing import ChainEnv, TableEnv

PRUNED = 8


def features(*rows: float | tuple[float, ...]) -> np.ndarray:
    return np.array([row if isinstance(row, tuple) else (row,) for row in rows], np.float32)


# ---------------------------------------------------------------------- by itself


def test_the_first_of_two_close_states_is_accepted_and_the_second_is_not() -> None:
    novelty = RadiusNovelty("x", 1.0)
    novelty.start(1)
    accepted = novelty.accept(np.zeros(4, np.int64), features(0.0, 0.9, 1.5, 0.7))
    assert accepted.tolist() == [True, False, True, False]
    # 0.9 was refused, so it guards nothing: 2.6 is novel though 1.7 away from it, 2.4 is not.
    assert novelty.accept(np.zeros(2, np.int64), features(2.4, 2.6)).tolist() == [False, True]


def test_a_state_exactly_one_radius_away_is_accepted() -> None:
    novelty = RadiusNovelty("x", 0.5)
    novelty.start(1)
    assert novelty.accept(np.zeros(2, np.int64), features((0.0, 0.0), (0.3, 0.4))).all()


def test_roots_do_not_see_each_others_states() -> None:
    novelty = RadiusNovelty("x", 1.0)
    novelty.start(3)
    accepted = novelty.accept(np.array([0, 1, 0, 2, 1]), features(0.0, 0.0, 0.5, 0.5, 0.0))
    assert accepted.tolist() == [True, True, False, True, False]
    assert (novelty.num_tested, novelty.num_refused) == (5, 2)


def test_many_states_are_all_remembered() -> None:
    novelty = RadiusNovelty("x", 1.0)
    novelty.start(2)
    positions = np.arange(300, dtype=np.float32)[:, None]
    for part in np.split(positions, 10):
        assert novelty.accept(np.ones(30, np.int64), part).all()
    assert not novelty.accept(np.ones(300, np.int64), positions).any()
    assert novelty.accept(np.zeros(1, np.int64), positions[:1]).all()


def test_a_new_search_forgets_the_last() -> None:
    novelty = RadiusNovelty("x", 1.0)
    for _ in range(2):
        novelty.start(1)
        assert novelty.accept(np.zeros(1, np.int64), features(0.0)).all()
        novelty.relax(0)


def test_relaxing_shrinks_the_radius_of_one_root_a_limited_number_of_times() -> None:
    novelty = RadiusNovelty("x", 1.0, relaxation=0.5, max_relaxations=2)
    novelty.start(2)
    novelty.accept(np.array([0, 1]), features(0.0, 0.0))
    assert novelty.relax(1)
    assert novelty.accept(np.array([0, 1]), features(0.6, 0.6)).tolist() == [False, True]
    assert novelty.relax(1)
    assert not novelty.relax(1)
    assert novelty.relax(0)


def test_features_are_the_scaled_entries_side_by_side() -> None:
    novelty = RadiusNovelty(["position", ("agent", "heading")], 1.0, scale=[1.0, 0.5])
    td = TensorDict(
        {"position": torch.tensor([[1.0, 2.0], [3.0, 4.0]]), ("agent", "heading"): [[8], [6]]}, [2]
    )
    assert novelty.features(td).tolist() == [[1.0, 2.0, 4.0], [3.0, 4.0, 3.0]]
    assert novelty.features(td).dtype == np.float32


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan"), float("inf")])
def test_a_radius_that_is_not_positive_is_refused_with_its_value(radius: float) -> None:
    with pytest.raises(ValueError, match=f"radius > 0.*got {radius}.*novelty=None"):
        RadiusNovelty("position", radius)


def test_scales_must_match_the_keys() -> None:
    with pytest.raises(ValueError, match="one scale per key; got 1"):
        RadiusNovelty(["a", "b"], 1.0, scale=[1.0])


def test_a_key_that_the_simulator_does_not_have_is_named() -> None:
    with pytest.raises(
        ValueError, match=r"reads 'position', which ChainEnv does not have.*'state'"
    ):
        MCTSPlanner(ChainEnv(3), novelty=RadiusNovelty("position", 1.0))


# ---------------------------------------------------------------------- in a search


def test_a_search_expands_each_place_once() -> None:
    # On the chain a step moves by exactly the radius: the states of the tree are 0 ... 8, each
    # expanded once; stepping left comes back to an old place every time.
    planner = MCTSPlanner(ChainEnv(10), novelty=RadiusNovelty("state", 1.0))
    search = planner.search(ChainEnv(10).reset())
    assert search.num_expansions.tolist() == [9]
    assert search.best_node[0] > 0
    nodes = search.tree.nodes[0, : search.tree.num_nodes[0]]
    assert ((nodes["flags"] & PRUNED) != 0).sum() == 9
    assert search.statistics()["pruned"] == 9


def test_a_pruned_node_has_no_children_and_is_visited_once() -> None:
    planner = MCTSPlanner(
        ChainEnv(30),
        novelty=RadiusNovelty("state", 1.0),
        budget=SearchBudget(expansions=25, until_plan=False),
    )
    search = planner.search(ChainEnv(30).reset())
    tree = search.tree
    pruned = np.flatnonzero(tree.nodes[0]["flags"] & PRUNED)
    assert len(pruned) == 25
    assert (tree.nodes[0, pruned]["visits"] == 1).all()
    assert (tree.edges[0, pruned]["child"] == -1).all()


def test_an_exhausted_search_shrinks_its_radius_and_goes_on() -> None:
    # A step of 1 is within the radius of 3: both outcomes at the root are refused. Halved to 1.5:
    # still. Halved to 0.75: the step to the right is accepted again, and the search goes on.
    env = ChainEnv(6)
    planner = MCTSPlanner(env, novelty=RadiusNovelty("state", 3.0, relaxation=0.5))
    plan = planner.plan(env.reset())
    assert plan.found.item()
    assert plan.options.tolist() == [1] * 5


def test_a_terminal_state_is_never_pruned() -> None:
    env = ChainEnv(3)
    planner = MCTSPlanner(env, novelty=RadiusNovelty("state", 1.0, max_relaxations=0))
    td = env.reset().set("state", torch.tensor(1))
    plan = planner.plan(td)
    assert plan.found.item()
    assert plan.options.tolist() == [1]


def test_without_relaxation_an_exhausted_search_stops_and_has_no_plan() -> None:
    env = ChainEnv(6)
    planner = MCTSPlanner(env, novelty=RadiusNovelty("state", 1.5, max_relaxations=0))
    td = planner(env.reset())
    assert not td["plan_found"].item()
    assert td["num_expansions"].item() == 1
    assert not planner.plan(env.reset()).found.item()


def test_only_the_exhausted_root_is_relaxed() -> None:
    # Root 0 is at state 0, a step of 4 from its next state; root 1 at state 1, a step of 1 from it.
    table = {(s, 0): (s, 0.0, 1) for s in (3, 5, 6, 7, 8)}
    table |= {(0, 0): (4, 0.0, 1), (4, 0): (9, 1.0, 1), (1, 0): (2, 0.0, 1), (2, 0): (9, 1.0, 1)}
    env = TableEnv(table, terminal=[9])
    novelty = RadiusNovelty("state", 2.0, relaxation=0.5)
    planner = MCTSPlanner(env, novelty=novelty)
    td = env.reset(TensorDict({"state": torch.tensor([0, 1])}, [2]), set_state=True)
    assert planner.plan(td).found.tolist() == [True, True]
    assert novelty._radius.tolist() == [2.0, 1.0]


def test_reopened_nodes_are_searched_and_keep_their_values() -> None:
    # State 0 leads to 1 and 2, both within 5 of 0: refused. At a radius of 2.5 still; at 1.25 2
    # is accepted and searched, which exhausts the tree; at 0.625 state 1 as well.
    env = TableEnv(
        {(0, 0): (1, 0.5, 1), (0, 1): (2, 0.25, 1), (1, 0): (3, 0.0, 1), (2, 0): (3, 1.0, 1)},
        terminal=[3],
    )
    planner = MCTSPlanner(
        env,
        gamma=0.5,
        novelty=RadiusNovelty("state", 5.0),
        budget=SearchBudget(expansions=100, until_plan=False),
    )
    search = planner.search(env.reset())
    assert search.tree.states is not None
    assert search.tree.states["state"][0, :5].tolist() == [0, 1, 2, 3, 3]
    nodes = search.tree.nodes[0, :5]
    assert nodes["parent"].tolist() == [-1, 0, 0, 2, 1]
    assert nodes["visits"].tolist() == [5, 2, 2, 1, 1]
    # gains of the root: 0 (its own), 0.5, 0.25, 0.25 + 1/2, 0.5 + 0; of state 2: 0, 1
    assert nodes["value"].tolist() == pytest.approx([2.0 / 5, 0.0, 0.5, 0.0, 0.0])
    assert not (nodes["flags"] & PRUNED).any()
    assert search.exhausted(np.array([0])).all()


def test_siblings_reopened_together_are_both_searched() -> None:
    # Features (state, duration): root (0, 0), its outcomes (1, 8) and (9, 1), all within 16 of each
    # other and further apart than 8.
    table = {(s, 0): (10, 0.0, 1) for s in range(1, 10)}
    table |= {(0, 0): (1, 0.0, 8), (0, 1): (9, 0.0, 1)}
    env = TableEnv(table, terminal=[10])
    planner = MCTSPlanner(env, novelty=RadiusNovelty(["state", "duration"], 16.0))
    search = planner.search(env.reset())
    assert search.tree.states is not None
    assert search.tree.states["state"][0, :5].tolist() == [0, 1, 9, 10, 10]
    assert search.tree.num_nodes.tolist() == [5]


# ---------------------------------------------------------------------- mazes


def execute(env: GridworldMazeEnv, td: TensorDictBase, options: list[int]) -> list[TensorDictBase]:
    steps = []
    for option in options:
        td = env.step(td.set("action", torch.tensor(option)))["next"]
        steps.append(td)
    return steps


def test_plans_through_mazes_reach_the_target_when_executed() -> None:
    mazes = generate_mazes(6, seed=3)
    env = GridworldMazeEnv(mazes, seed=0)
    td = env.reset(TensorDict(batch_size=[12]))
    planner = MCTSPlanner(
        GridworldMazeEnv(mazes, observation=False),
        tree_policy=UCT(c=1.0),
        novelty=RadiusNovelty("position", 0.5),
    )
    plans = planner.plan(td)
    assert plans.found.all()
    for i in range(12):
        options = plans.options[i, : plans.lengths[i]].tolist()
        steps = execute(env, td[i].clone(), options)
        assert [step["terminated"].item() for step in steps] == [False] * (len(steps) - 1) + [True]
        assert steps[-1]["reward"].item() == 1.0
        tiles = [divmod(int(td[i][key]), env.width) for key in ("player_tile", "target_tile")]
        shortest = len(shortest_path(mazes[int(td[i]["maze_index"])], *tiles)) - 1
        assert len(options) >= shortest
        # No tile twice: with a radius of half a tile each is accepted once.
        visited = [int(td[i]["player_tile"])] + [int(step["player_tile"]) for step in steps]
        assert len(set(visited)) == len(visited)
        assert plans.states["player_tile"][i, : len(visited)].tolist() == visited
        assert plans.returns[i].item() == pytest.approx(0.99 ** (len(options) - 1), rel=1e-5)


def test_no_more_nodes_are_expanded_than_the_maze_has_free_tiles() -> None:
    mazes = generate_mazes(4, seed=5)
    env = GridworldMazeEnv(mazes, seed=1, observation=False)
    planner = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.5, max_relaxations=0))
    td = planner(env.reset(TensorDict(batch_size=[16])))
    assert td["plan_found"].all()
    assert int(td["num_expansions"].max()) <= 50


@pytest.mark.parametrize("relaxation", [0.0, 1.0, -0.5, float("nan")])
def test_a_relaxation_that_does_not_shrink_the_radius_is_refused(relaxation: float) -> None:
    with pytest.raises(ValueError, match=r"relaxation in \(0, 1\)"):
        RadiusNovelty("x", 1.0, relaxation=relaxation)
