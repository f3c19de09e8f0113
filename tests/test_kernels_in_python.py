"""Compiled functions do the same as plain Python, in which coverage sees their lines."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest
import torch
from search_parts import least_visited

from torchrl_hmcts import planners
from torchrl_hmcts.envs import LabMazeEnv, SharedMLP
from torchrl_hmcts.envs.lab.first_person import draw_first_person
from torchrl_hmcts.envs.mazes.layouts import _compiled_grow_walls, _grow_walls
from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    DirichletNoise,
    Gumbel,
    MCTSPlanner,
    ProgressiveWidening,
    RadiusNovelty,
    Root,
    Search,
    SearchBudget,
    Transition,
    Transpositions,
    TreeRollout,
    WidthNovelty,
    tree_search,
)
from torchrl_hmcts.planners.tree import PENDING
from torchrl_hmcts.testing import ChainEnv, TableEnv

PLANNERS, ENVS = "torchrl_hmcts.planners", "torchrl_hmcts.envs"
Arrays = dict[str, np.ndarray]


KERNELS = (
    *("number_kernels", "variant_kernels", "kernels", "root_kernels", "batch_kernels"),
    *("subtree_kernels", "novelty_kernels"),
)


def in_python(name: str) -> ModuleType:
    """A module once more, of which nothing is compiled."""
    spec = importlib.util.find_spec(name)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba.config, "DISABLE_JIT", 1)
        spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def kernels() -> dict[str, ModuleType]:
    """The kernels once more; each imports those before it."""
    found: dict[str, ModuleType] = {}
    for name in KERNELS:
        importlib.import_module(f"{PLANNERS}.{name}")
    for name in KERNELS:
        with used(found):
            found[name] = in_python(f"{PLANNERS}.{name}")
    return found


@contextmanager
def used(kernels: dict[str, ModuleType]) -> Iterator[None]:
    """Searches that begin inside use these."""
    with pytest.MonkeyPatch.context() as patch:
        for name, module in kernels.items():
            patch.setitem(sys.modules, f"{PLANNERS}.{name}", module)
            patch.setattr(planners, name, module)
        yield


def check_equal(plain: Arrays, compiled: Arrays) -> None:
    assert plain.keys() == compiled.keys()
    for name, array in compiled.items():
        np.testing.assert_allclose(plain[name], array, rtol=1e-4, atol=1e-5, err_msg=name)


def fields(search: Search) -> Arrays:
    """All that a search knows of its nodes, options and roots."""
    tree, found = search.tree, {}
    used = np.arange(tree.capacity) < tree.num_nodes[:, None]
    for name in tree.nodes.dtype.names:
        found[f"node {name}"] = tree.nodes[name][used]
    for name in tree.edges.dtype.names:
        found[f"edge {name}"] = tree.edges[name][used]
    for name in search.roots.dtype.names:
        if name not in ("at", "choice", "queue"):  # room to work in
            found[f"root {name}"] = search.roots[name]
    return {name: array.astype(np.float64) for name, array in found.items()}


# ---------------------------------------------------------------------- searches in an env

# A walk on a ring of seven with a short cut: it pays at state 6, and option 2 of state 3 ends it.
RING = {
    (s, a): ((s + a + 1) % 8, float(s == 6) - 0.25 * a, 1 + a) for s in range(8) for a in (0, 1)
}
RING |= {(s, 2): (8 if s == 3 else s, 0.5 * (s == 3), 1) for s in range(8)}


def search_of(simulations: int, roots: int = 2, **kwargs: Any) -> Search:
    env = TableEnv(RING, terminal=[8])
    budget = SearchBudget(simulations=simulations, until_plan=False)
    planner = MCTSPlanner(env, gamma=0.9, budget=budget, seed=0, **kwargs)
    return planner.search(env.reset().expand(roots).clone())


def prior(td: Any) -> torch.Tensor:
    return torch.tensor([0.25, 0.5, 0.25]).expand(len(td), 3)


def half(td: Any) -> torch.Tensor:
    return 0.5 * torch.ones(len(td))


SEARCHES: dict[str, dict[str, Any]] = {
    "uct": {"tree_policy": UCT(), "expand": "one"},
    "uct, max, waves of 3": {"backup": "max", "leaves_per_wave": 3},
    "puct over siblings": {"tree_policy": PUCT.mctx(), "expand": "one", "option_prior": prior},
    "puct over the tree": {"tree_policy": PUCT(normalize="tree"), "option_prior": prior},
    "gumbel": {"tree_policy": Gumbel(max_considered=2), "expand": "one", "leaf_evaluator": half},
    "revisits": {"expand": "one", "exhausted": "revisit", "leaves_per_wave": 2},
    "root noise": {"tree_policy": PUCT(), "root_noise": DirichletNoise(), "expand": "one"},
    "radius": {"novelty": RadiusNovelty("state", 1.5), "backup": "max"},
    "width": {"novelty": WidthNovelty("state")},
    "transpositions": {
        "transpositions": Transpositions("state"),
        "backup": "max",
        "expand": "one",
    },
    "chance": {"chance": ProgressiveWidening(), "expand": "one", "leaves_per_wave": 2},
    "rollouts": {"rollout": TreeRollout(max_options=4), "expand": "one", "leaves_per_wave": 2},
    "waves in flight": {
        "chance": ProgressiveWidening(),
        "expand": "one",
        "rollout": TreeRollout(max_options=4),
        "waves_in_flight": 3,
    },
    "python": {"tree_policy": least_visited, "expand": "one", "leaves_per_wave": 2},
    "python, all": {"tree_policy": least_visited, "leaves_per_wave": 2, "exhausted": "revisit"},
    "python, chance": {
        "tree_policy": least_visited,
        "expand": "one",
        "chance": ProgressiveWidening(),
    },
    "python, transpositions": {
        "tree_policy": least_visited,
        "expand": "one",
        "transpositions": Transpositions("state"),
    },
}


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_grows_the_same_trees(name: str, kernels: dict[str, ModuleType]) -> None:
    compiled = fields(search_of(40, **SEARCHES[name]))
    with used(kernels):
        plain = fields(search_of(40, **SEARCHES[name]))
    check_equal(plain, compiled)
    assert len(plain["node visits"]) > 5


def test_a_tree_whose_root_moves_on_keeps_the_same_nodes(kernels: dict[str, ModuleType]) -> None:
    def moved() -> Arrays:
        env = ChainEnv(9)
        budget = SearchBudget(simulations=25, until_plan=False)
        planner = MCTSPlanner(
            env, novelty=RadiusNovelty("state", 0.5), expand="one", budget=budget, seed=0
        )
        td = env.reset().expand(2).clone()
        search = planner.search(td)
        after = env.step(td.set("action", torch.tensor([1, 1])))["next"]
        planner.advance(search, torch.tensor([1, 1]), after)
        return fields(planner.resume(search))

    compiled = moved()
    with used(kernels):
        check_equal(moved(), compiled)


def test_a_wave_that_a_simulator_broke_is_forgotten(kernels: dict[str, ModuleType]) -> None:
    class Breaks(TableEnv):
        calls = 0

        def _step(self, tensordict: Any) -> Any:
            self.calls += 1
            if self.calls == 3:
                raise OSError("the third call")
            return super()._step(tensordict)

    for expand in ("one", "all"):
        with used(kernels):
            env = Breaks(RING, terminal=[8])
            budget = SearchBudget(simulations=30, until_plan=False)
            planner = MCTSPlanner(env, expand=expand, leaves_per_wave=2, budget=budget)
            with pytest.raises(OSError, match="third call"):
                planner.search(env.reset())
        search = planner.last_search
        assert search is not None
        assert not search.tree.edges["in_flight"].any()
        assert not (search.tree.nodes["flags"] & PENDING).any()


# ---------------------------------------------------------------------- searches over arrays


def ladder(state: np.ndarray, option: np.ndarray) -> Transition:
    """Up by one or two; the sixth rung is the end, and pays."""
    after = state + option.astype(np.int64) + 1
    reward = (after >= 6).astype(np.float32)
    value = np.float32(0.1) * after.astype(np.float32)
    prior = np.tile(np.array([[0.75, 0.25]], np.float32), (len(state), 1))
    return Transition(reward, np.float32(0.9) * (after < 6), prior, value, after)


def climb(num_roots: int, **kwargs: Any) -> Arrays:
    prior = np.tile(np.array([[0.5, 0.5]], np.float32), (num_roots, 1))
    state = np.arange(num_roots) % 5
    return fields(
        tree_search(Root(prior, np.zeros(num_roots, np.float32), state), ladder, **kwargs)
    )


@pytest.mark.parametrize("num_roots", [2, 70])
@pytest.mark.parametrize("exhausted", ["revisit", "skip"])
def test_a_search_over_arrays_grows_the_same_trees(
    num_roots: int, exhausted: Any, kernels: dict[str, ModuleType]
) -> None:
    # From 64 roots on, the trees go down together.
    kwargs: dict[str, Any] = {"num_simulations": 12, "exhausted": exhausted}
    compiled = climb(num_roots, **kwargs)
    with used(kernels):
        check_equal(climb(num_roots, **kwargs), compiled)


@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("reward", np.zeros(7, np.float32), "returned reward as float32 \\[7\\]"),
        ("value", np.full(1, np.nan, np.float32), "returned the value nan"),
    ],
)
def test_a_transition_function_that_goes_wrong_later_is_refused(
    name: str, wrong: np.ndarray, message: str, kernels: dict[str, ModuleType]
) -> None:
    calls: list[int] = []

    def broken(state: np.ndarray, option: np.ndarray) -> Transition:
        calls.append(len(state))
        answer = ladder(state, option)
        return answer if len(calls) < 3 else answer._replace(**{name: wrong})

    root = Root(np.ones((1, 2), np.float32) / 2, np.zeros(1, np.float32), np.zeros(1, np.int64))
    with used(kernels), pytest.raises(ValueError, match=message):
        tree_search(root, broken, 12)
    assert len(calls) == 3


# ---------------------------------------------------------------------- novelty by itself


def accepted(make: Callable[[], Any], states: np.ndarray, steps: np.ndarray) -> Arrays:
    test = make()
    test.start(2)
    roots = np.arange(len(states)) % 2
    found = [test.accept(roots, states, steps) for _ in range(2)]
    test.restart(1)
    found.append(test.accept(roots, states, steps))
    return {str(i): array.copy() for i, array in enumerate(found)}


@pytest.mark.parametrize("num_features", [1, 2, 3, 5])
@pytest.mark.parametrize("shorter_paths", [False, True])
def test_the_radius_test_accepts_the_same_states(
    num_features: int, shorter_paths: bool, kernels: dict[str, ModuleType]
) -> None:
    # 160 states of a root: a scan up to the 48th accepted one, a grid after it.
    rng = np.random.default_rng(0)
    states = rng.uniform(0.0, 30.0, (320, num_features)).astype(np.float32)
    states[7, 0], states[300, 0] = np.nan, np.inf
    steps = rng.integers(1, 50, 320)

    def make() -> RadiusNovelty:
        return RadiusNovelty("x", 0.3, shorter_paths=shorter_paths)

    compiled = accepted(make, states, steps)
    with used(kernels):
        check_equal(accepted(make, states, steps), compiled)


@pytest.mark.parametrize("dtype", [np.uint8, np.int64])
def test_the_width_test_accepts_the_same_states(dtype: Any, kernels: dict[str, ModuleType]) -> None:
    rng = np.random.default_rng(0)
    states = rng.integers(0, 60, (150, 3)).astype(dtype)
    steps = np.zeros(150, np.int64)
    compiled = accepted(lambda: WidthNovelty("x"), states, steps)
    with used(kernels):
        check_equal(accepted(lambda: WidthNovelty("x"), states, steps), compiled)


def test_the_same_states_are_found_equal(kernels: dict[str, ModuleType]) -> None:
    codes = np.random.default_rng(0).integers(0, 12, (200, 2)).astype(np.uint8)

    def twins() -> Arrays:
        known = Transpositions("x")
        known.start(2)
        return {"twins": known.find(np.arange(200) % 2, codes, np.arange(200)).copy()}

    compiled = twins()
    with used(kernels):
        check_equal(twins(), compiled)
    assert (compiled["twins"] >= 0).any()


# ---------------------------------------------------------------------- environments

# The players bump into walls, corners and ends of walls; one of them starts beside the goal.
LEVEL = ["*********", "*P  *   *", "* A     *", "*   *  G*", "*********"]


def walk(frames: int) -> Arrays:
    """Players that turn and run by a fixed script, some of them into the goal again and again."""
    env = LabMazeEnv([LEVEL], clock="exact", terminate_on_goal=False, actions=None, num_steps=2)
    position = [[150.0, 350.0], [150.0, 250.0], [720.0, 250.0], [350.0, 250.0]]
    td = env.make_state(0, torch.tensor(position), torch.tensor([0.0, 45.0, -90.0, 10.0]))
    rng = np.random.default_rng(0)
    found: dict[str, list[np.ndarray]] = {}
    for frame in range(frames):
        action = torch.zeros(4, 7, dtype=torch.int64)
        action[:, 0] = torch.from_numpy(rng.integers(-60, 61, 4)) if frame % 8 == 0 else 0
        action[:, 2] = torch.from_numpy(rng.integers(-1, 2, 4))
        action[:, 3] = 0 if frame % 20 > 16 else 1
        td = env.step(td.set("action", action))["next"]
        for key, value in td.items(include_nested=True, leaves_only=True):
            found.setdefault(str(key), []).append(value.double().numpy())
        td = td.exclude("reward")
    return {key: np.stack(values) for key, values in found.items()}


def test_players_of_the_lab_move_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = walk(90)
    plain = in_python("torchrl_hmcts.envs.lab.kernels")
    for module, names in (
        ("lab.maze_env", ("advance", "read_out")),
        ("lab.states", ("overlaps_wall",)),
    ):
        for name in names:
            monkeypatch.setattr(sys.modules[f"{ENVS}.{module}"], name, getattr(plain, name))
    check_equal(walk(90), compiled)
    assert (compiled["reward"] > 5.0).sum() >= 2  # the goal, twice


def test_the_view_of_a_player_is_the_same() -> None:
    plain = in_python("torchrl_hmcts.envs.lab.first_person")
    env = LabMazeEnv([LEVEL])
    state = env.make_state(0, (350.0, 250.0), heading=0.4)
    size = {"width": 40, "height": 30}
    np.testing.assert_array_equal(
        plain.draw_first_person(env, state, **size), draw_first_person(env, state, **size)
    )


def test_the_same_walls_grow() -> None:
    seeds = [np.array([7], np.uint64) for _ in range(2)]
    compiled = _compiled_grow_walls()(3, 11, 13, 40, 12, seeds[0])
    with np.errstate(over="ignore"):
        plain = _grow_walls(3, 11, 13, 40, 12, seeds[1])
    np.testing.assert_array_equal(plain, compiled)
    np.testing.assert_array_equal(*seeds)


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_network_takes_the_same_actions(deterministic: bool) -> None:
    plain = in_python("torchrl_hmcts.envs.gym.shared_network")
    rng = np.random.default_rng(0)
    worker = SharedMLP(2, 4, hidden=(5, 6), deterministic=deterministic)
    worker.weights.copy_(torch.from_numpy(rng.normal(size=len(worker.weights))))
    logits, draws = np.zeros(4, np.float32), [np.random.default_rng(1) for _ in range(2)]
    for _ in range(20):
        ram = (rng.integers(0, 256, 128) * (rng.random(128) < 0.3)).astype(np.uint8)
        for option in range(2):
            draw = -1.0 if deterministic else draws[0].random()
            arrays = worker._array, worker._sizes, worker._heads[option], logits
            action = plain.choose(ram, *arrays, draw, 255.0)
            assert action == worker.act(ram, option, draws[1])
            np.testing.assert_allclose(logits, worker._logits, rtol=1e-4, atol=1e-4)
