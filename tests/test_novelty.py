"""Novelty tests: what they accept, and what a search makes of it."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from search_parts import expansions
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Categorical

from torchrl_hmcts.envs import GridworldMazeEnv, generate_mazes, shortest_path_lengths
from torchrl_hmcts.planners import UCT, MCTSPlanner, RadiusNovelty, WidthNovelty
from torchrl_hmcts.testing import ChainEnv, TableEnv

PRUNED = 8


class PairEnv(TableEnv):
    """Two counters from 0 below a size, of which option 0 and 1 raise one each, to their ends."""

    def __init__(self, size: int) -> None:
        table = {}
        for x in range(size):
            for y in range(size):
                table[x * size + y, 0] = (min(x + 1, size - 1) * size + y, 0.0, 1)
                table[x * size + y, 1] = (x * size + min(y + 1, size - 1), 0.0, 1)
        super().__init__(table)
        self.size = size
        for name in ("x", "y"):
            self.observation_spec[name] = Categorical(size, shape=())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._read_out(super()._step(tensordict))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self._read_out(super()._reset(tensordict, **kwargs))

    def _read_out(self, td: TensorDictBase) -> TensorDictBase:
        return td.set("x", td["state"] // self.size).set("y", td["state"] % self.size)


def accept(test: RadiusNovelty | WidthNovelty, roots: object, states: np.ndarray) -> np.ndarray:
    """Tests states whose base steps do not matter."""
    roots = np.broadcast_to(np.asarray(roots, np.int64), len(states)).copy()
    return test.accept(roots, states, np.zeros(len(states), np.int64))


def features(*rows: float | tuple[float, ...]) -> np.ndarray:
    return np.array([row if isinstance(row, tuple) else (row,) for row in rows], np.float32)


# ---------------------------------------------------------------------- by itself


def test_a_state_exactly_one_radius_away_is_accepted() -> None:
    novelty = RadiusNovelty("x", 0.5)
    novelty.start(1)
    assert accept(novelty, 0, features((0.0, 0.0), (0.3, 0.4))).all()


def test_roots_do_not_see_each_others_states() -> None:
    novelty = RadiusNovelty("x", 1.0)
    novelty.start(3)
    accepted = accept(novelty, [0, 1, 0, 2, 1], features(0.0, 0.0, 0.5, 0.5, 0.0))
    assert accepted.tolist() == [True, True, False, True, False]
    assert (novelty.num_tested, novelty.num_refused) == (5, 2)


def test_a_new_search_forgets_the_last() -> None:
    novelty = RadiusNovelty("x", 1.0)
    for _ in range(2):
        novelty.start(1)
        assert accept(novelty, 0, features(0.0)).all()
        novelty.relax(0)


def test_relaxing_shrinks_the_radius_of_one_root_a_limited_number_of_times() -> None:
    novelty = RadiusNovelty("x", 1.0, relaxation=0.5, max_relaxations=2)
    novelty.start(2)
    accept(novelty, [0, 1], features(0.0, 0.0))
    assert novelty.relax(1)
    assert accept(novelty, [0, 1], features(0.6, 0.6)).tolist() == [False, True]
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


def test_scales_must_match_the_keys() -> None:
    with pytest.raises(ValueError, match="one scale per key; got"):
        RadiusNovelty(["a", "b"], 1.0, scale=[1.0])


def test_a_key_that_the_simulator_does_not_have_is_named() -> None:
    with pytest.raises(
        ValueError, match=r"reads 'position', which ChainEnv does not have.*'state'"
    ):
        MCTSPlanner(ChainEnv(3), novelty=RadiusNovelty("position", 1.0))


# ---------------------------------------------------------------------- against a plain scan


class Scan:
    """RadiusNovelty as its docstring defines it: each state against all accepted ones."""

    def __init__(self, radius: float, shorter_paths: bool, num_roots: int) -> None:
        self.shorter_paths = shorter_paths
        self.radii = [radius] * num_roots
        self.seen: list[list[tuple[np.ndarray, int]]] = [[] for _ in range(num_roots)]

    def accept(self, roots: np.ndarray, states: np.ndarray, steps: np.ndarray) -> list[bool]:
        accepted = []
        for root, state, k in zip(
            roots.tolist(), states.astype(float), steps.tolist(), strict=True
        ):
            seen = self.seen[root]
            with np.errstate(invalid="ignore"):
                apart = [float(((state - other) ** 2).sum()) for other, _ in seen]
            limit = self.radii[root] ** 2
            near = [j for (_, j), d in zip(seen, apart, strict=True) if d < limit]
            novel = not near or (self.shorter_paths and k < min(near))
            if novel:
                seen.append((state, k))
            accepted.append(novel)
        return accepted


def random_states(rng: np.random.Generator, count: int, num_features: int) -> np.ndarray:
    """Points of several kinds: spread out, on a lattice, far off, all but constant, not finite."""
    kind = rng.integers(5)
    states = rng.normal(size=(count, num_features)) * rng.choice([1.0, 5.0, 20.0])
    if kind == 1:
        states = np.round(states)
    elif kind == 2:
        states = states + rng.choice([1e4, -1e6, 1e9])
    elif kind == 3:
        states[:, : num_features - 1] = 0.5
    elif kind == 4:
        odd = rng.random(states.shape) < 0.02
        states[odd] = rng.choice([np.nan, np.inf, -np.inf, 3e38, -3e38], size=odd.sum())
    return states.astype(np.float32)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    num_features=st.integers(1, 6),
    num_roots=st.integers(1, 3),
    shorter_paths=st.booleans(),
)
def test_the_grid_accepts_what_a_scan_of_all_states_accepts(
    seed: int, num_features: int, num_roots: int, shorter_paths: bool
) -> None:
    rng = np.random.default_rng(seed)
    radius = float(rng.choice([0.25, 1.0, 1.005, 1.5]))  # points of the lattice lie 1 apart
    novelty = RadiusNovelty("x", radius, relaxation=0.6, shorter_paths=shorter_paths)
    novelty.start(num_roots)
    scan = Scan(radius, shorter_paths, num_roots)
    for _ in range(8):
        count = int(rng.choice([0, 1, 30, 120]))
        roots = rng.integers(num_roots, size=count)
        states = random_states(rng, count, num_features)
        steps = rng.integers(1, 40, size=count)
        expected = scan.accept(roots, states, steps)
        assert novelty.accept(roots, states, steps).tolist() == expected
        event, root = rng.integers(6), int(rng.integers(num_roots))
        if event < 3:
            assert novelty.relax(root)
            scan.radii[root] = float(novelty.radii[root])
        elif event == 3:
            novelty.restart(root)
            scan.radii[root], scan.seen[root] = radius, []


def test_a_test_costs_the_same_among_a_hundred_thousand_states_as_among_a_thousand() -> None:
    # A scan of all would take a hundred times as long; the bound leaves room for a busy machine.
    rng = np.random.default_rng(0)
    seconds = []
    for count in (1_000, 100_000):
        novelty = RadiusNovelty("x", 1e-3)
        novelty.start(1)
        accept(novelty, 0, rng.random((count, 2), np.float32) * np.float32(count**0.5))
        states = rng.random((2_000, 2), np.float32) * np.float32(count**0.5)
        times = []
        for _ in range(5):
            begin = time.perf_counter()
            accept(novelty, 0, states)
            times.append(time.perf_counter() - begin)
        seconds.append(min(times))
    assert seconds[1] < 10.0 * seconds[0]


# ---------------------------------------------------------------------- shorter paths


def test_a_shorter_path_to_a_known_place_is_accepted_and_a_longer_one_is_not() -> None:
    novelty = RadiusNovelty("x", 1.0, shorter_paths=True)
    novelty.start(1)
    states = features(0.0, 0.5, 0.5, 0.5, 0.5, 0.9)
    steps = np.array([10, 10, 9, 9, 8, 9])
    # 10 base steps are not fewer than 10; 9 are; 9 are not fewer than 9; the last is near 8.
    accepted = novelty.accept(np.zeros(6, np.int64), states, steps)
    assert accepted.tolist() == [True, False, True, False, True, False]
    assert novelty.statistics() == {
        "novelty_tested": 6,
        "novelty_refused": 3,
        "novelty_shorter": 2,
    }


def test_shorter_paths_improve_the_plan_after_the_first() -> None:
    # 0 -> 1 by an option of 9 base steps, or over 2 by two of 1; 1 -> 3 earns 1 and ends.
    # Breadth first the search knows 1 by the long way; the short one is refused, or replaces it.
    table = {(0, 0): (1, 0.0, 9), (0, 1): (2, 0.0, 1), (2, 0): (1, 0.0, 1), (1, 0): (3, 1.0, 1)}
    env = TableEnv(table, terminal=[3])
    returns = []
    for shorter_paths in (False, True):
        planner = MCTSPlanner(
            env,
            gamma=0.5,
            novelty=RadiusNovelty("state", 0.5, shorter_paths=shorter_paths, max_relaxations=0),
            budget=expansions(50),
        )
        search = planner.search(env.reset())
        returns.append(float(search.best_return[0]))
        assert search.exhausted(np.array([0])).all()
    assert returns == [0.5**9, 0.5**2]


# ---------------------------------------------------------------------- new values


def test_a_state_is_novel_if_one_of_its_values_is() -> None:
    novelty = WidthNovelty("ram")
    novelty.start(2)
    states = np.array([[0, 0], [0, 1], [1, 0], [1, 1], [0, 1]], np.uint8)
    assert accept(novelty, 0, states).tolist() == [True, True, True, False, False]
    assert accept(novelty, 1, states[3:]).tolist() == [True, True]
    assert novelty.statistics() == {"novelty_tested": 7, "novelty_refused": 2}


def test_relaxing_accepts_a_value_once_more_for_one_root() -> None:
    novelty = WidthNovelty("x", max_relaxations=2)
    novelty.start(2)
    same = np.zeros((3, 4), np.uint8)
    for root in (0, 1):
        assert accept(novelty, root, same).tolist() == [True, False, False]
    assert novelty.relax(1)
    assert accept(novelty, 1, same).tolist() == [True, False, False]
    assert novelty.relax(1)
    assert accept(novelty, 1, same).tolist() == [True, False, False]
    assert not novelty.relax(1)
    assert not accept(novelty, 0, same).any()
    novelty.restart(1)
    assert accept(novelty, 1, same).tolist() == [True, False, False]


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    dtype=st.sampled_from([np.uint8, np.int8, np.int16, np.int32, np.int64, np.uint64]),
    num_features=st.integers(1, 40),
)
def test_width_novelty_accepts_what_sets_of_values_accept(
    seed: int, dtype: type[np.generic], num_features: int
) -> None:
    rng = np.random.default_rng(seed)
    stages = sorted(rng.choice(num_features - 1, size=min(2, num_features - 1), replace=False) + 1)
    novelty = WidthNovelty("x", stages=[int(n) for n in stages])
    novelty.start(2)
    counts: list[Counter[tuple[int, int]]] = [Counter(), Counter()]
    limits, compared = [1, 1], [[*stages, num_features] for _ in range(2)]
    ends = np.iinfo(dtype)
    spread = int(rng.choice([3, 100]))
    for _ in range(5):
        roots = rng.integers(2, size=100)
        states = rng.integers(spread, size=(100, num_features)).astype(dtype)
        states[rng.random(states.shape) < 0.01] = (ends.min, ends.max)[rng.integers(2)]
        expected = []
        for root, state in zip(roots.tolist(), states.tolist(), strict=True):
            values = list(enumerate(state))
            some = values[: compared[root][0]]
            novel = any(counts[root][value] < limits[root] for value in some)
            counts[root].update(values if novel else [])
            expected.append(novel)
        assert accept(novelty, roots, states).tolist() == expected
        if rng.random() < 0.5:
            root = int(rng.integers(2))
            assert novelty.relax(root)
            if len(compared[root]) > 1:
                compared[root].pop(0)
            else:
                limits[root] += 1
        elif rng.random() < 0.3:
            novelty.restart(1)
            counts[1].clear()
            limits[1], compared[1] = 1, [*stages, num_features]


def test_stages_compare_more_features_before_values_may_repeat() -> None:
    novelty = WidthNovelty("x", stages=[1, 2], max_relaxations=1)
    novelty.start(2)
    states = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1]], np.int64)
    assert accept(novelty, 0, states).tolist() == [True, False, False]  # column 0 alone
    assert novelty.relax(0)
    # What was accepted is known in all columns; the second state is new in column 1.
    assert accept(novelty, 0, states).tolist() == [False, True, False]
    assert novelty.relax(0)
    assert accept(novelty, 0, states).tolist() == [False, False, True]  # new in column 2
    assert novelty.relax(0)
    # Twice now: the zero in column 0 was accepted three times, the others less often.
    assert accept(novelty, 0, states).tolist() == [True, False, True]
    assert not novelty.relax(0)
    assert accept(novelty, 1, states).tolist() == [True, False, False]
    novelty.restart(0)
    assert accept(novelty, 0, states).tolist() == [True, False, False]
    assert repr(novelty) == "WidthNovelty(['x'], stages=(1, 2))"


def test_stages_that_do_not_fit_are_refused() -> None:
    for stages in ([2, 2], [3, 1]):
        with pytest.raises(ValueError, match="compares more features in each stage; got stages="):
            WidthNovelty("x", stages=stages)
    with pytest.raises(ValueError, match=r"stages .*0"):
        WidthNovelty("x", stages=[0])
    novelty = WidthNovelty("x", stages=[3])
    novelty.start(1)
    with pytest.raises(ValueError, match=r"stages=\(3,\)\) needs more than 3 features; .* have 3"):
        accept(novelty, 0, np.zeros((1, 3), np.int64))


def test_features_keep_their_integer_type_in_the_tree() -> None:
    for dtype in (torch.uint8, torch.int16, torch.int64):
        td = TensorDict({"ram": torch.arange(6, dtype=dtype).view(2, 3)}, [2])
        got = WidthNovelty("ram").features(td)
        assert got.dtype == torch.zeros(0, dtype=dtype).numpy().dtype
        assert got.tolist() == [[0, 1, 2], [3, 4, 5]]
    search = MCTSPlanner(ChainEnv(10), novelty=WidthNovelty("state")).search(ChainEnv(10).reset())
    assert search.tree.features.dtype == np.int64
    flags = TensorDict({"a": torch.tensor([True, False]), "b": torch.tensor([300, -1])}, [2])
    assert WidthNovelty(["a", "b"]).features(flags).tolist() == [[1, 300], [0, -1]]


def test_features_that_are_not_discrete_are_refused_with_a_way_out() -> None:
    env = GridworldMazeEnv(generate_mazes(1, seed=0), seed=0)
    planner = MCTSPlanner(env, novelty=WidthNovelty("position"))
    with pytest.raises(TypeError, match=r"'position' is of type torch.float32.*RadiusNovelty"):
        planner.plan(env.reset())


def test_states_of_another_width_are_refused() -> None:
    for novelty, dtype in ((RadiusNovelty("x", 1.0), np.float32), (WidthNovelty("x"), np.int64)):
        novelty.start(1)
        accept(novelty, 0, np.zeros((1, 2), dtype))
        with pytest.raises(ValueError, match="states with 2 features; got 3"):
            accept(novelty, 0, np.zeros((1, 3), dtype))


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
    planner = MCTSPlanner(ChainEnv(30), novelty=RadiusNovelty("state", 1.0), budget=expansions(25))
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
    assert planner.last_search is not None
    assert isinstance(planner.last_search.novelty, RadiusNovelty)
    assert planner.last_search.novelty.radii.tolist() == [2.0, 1.0]


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
        budget=expansions(100),
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


def test_an_exhausted_width_search_relaxes_and_reaches_all_states() -> None:
    env = PairEnv(5)
    planner = MCTSPlanner(env, novelty=WidthNovelty(["x", "y"]), budget=expansions(400))
    search = planner.search(env.reset())
    tree = search.tree
    assert tree.states is not None
    used = int(tree.num_nodes[0])
    assert set(tree.states["state"][0, :used].tolist()) == set(range(25))


@pytest.mark.parametrize("novelty", [RadiusNovelty("state", 1.0), WidthNovelty("state")])
def test_a_search_that_is_resumed_after_another_remembers_its_own_states(
    novelty: RadiusNovelty | WidthNovelty,
) -> None:
    env = ChainEnv(40)
    budget = expansions(10)
    planner = MCTSPlanner(env, novelty=novelty, budget=budget)
    first = planner.search(TensorDict({"state": torch.tensor([0, 20, 30])}, [3]))
    planner.search(env.reset().set("state", torch.tensor(12)))
    planner.resume(first)
    alone = MCTSPlanner(env, novelty=novelty, budget=budget)
    expected = alone.search(TensorDict({"state": torch.tensor([0, 20, 30])}, [3]))
    alone.resume(expected)
    assert first.tree.num_nodes.tolist() == expected.tree.num_nodes.tolist()
    for b, n in enumerate(first.tree.num_nodes.tolist()):
        assert (first.tree.nodes[b, :n] == expected.tree.nodes[b, :n]).all()
    assert first.statistics() == expected.statistics()


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
        start, goal = (divmod(int(td[i][key]), env.width) for key in ("player_tile", "target_tile"))
        lengths = shortest_path_lengths(mazes[int(td[i]["maze_index"])], goal)
        assert len(options) >= lengths[start]
        # No tile twice: with a radius of half a tile each is accepted once.
        visited = [int(td[i]["player_tile"])] + [int(step["player_tile"]) for step in steps]
        assert len(set(visited)) == len(visited)
        assert plans.states["player_tile"][i, : len(visited)].tolist() == visited
        assert plans.returns[i].item() == pytest.approx(0.99 ** (len(options) - 1), rel=1e-5)
