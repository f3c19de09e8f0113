"""Waves that are simulated at a time: their order, their budget, their errors."""

from __future__ import annotations

import pickle
import random
from typing import Any

import numpy as np
import pytest
import torch
from search_parts import assert_nothing_in_flight, least_visited, trees
from tensordict import TensorDictBase
from torchrl.envs import RewardScaling, TransformedEnv

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    MCTSPlanner,
    NodeStatistics,
    ProgressiveWidening,
    Search,
    SearchBudget,
    SearchProgress,
    Transpositions,
    TreeRollout,
    WidthNovelty,
)
from torchrl_hmcts.testing import TableEnv

# Three options in each of 40 states, to a random state; two of ten rewards are not zero.
_RNG = random.Random(0)
MAZE = {
    (s, a): (_RNG.randrange(40), _RNG.choice([0.0] * 4 + [0.5]), _RNG.randint(1, 3))
    for s in range(40)
    for a in range(3)
}


class Beside(TableEnv):
    """Works beside the planner: a step is taken when it is waited for, and both are noted."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.events: list[tuple[str, int]] = []
        self.under_way: dict[int, TensorDictBase] = {}
        self.fails_at: tuple[str, int] | None = None

    def _note(self, event: str, number: int) -> None:
        self.events.append((event, number))
        if (event, number) == self.fails_at:
            raise OSError(f"{event} {number}")

    def step_async(self, tensordict: TensorDictBase) -> int:
        number = sum(event == "sent" for event, _ in self.events)
        self._note("sent", number)
        self.under_way[number] = tensordict
        return number

    def step_wait(self, ticket: int) -> TensorDictBase:
        self._note("waited", ticket)
        return self._step(self.under_way.pop(ticket))

    def step_abandon(self, ticket: int) -> None:
        self.under_way.pop(ticket, None)


def planner_of(env: Any, simulations: int = 60, **kwargs: Any) -> MCTSPlanner:
    budget = SearchBudget(simulations=simulations, until_plan=False)
    return MCTSPlanner(env, **{"gamma": 0.9, "budget": budget, "seed": 0, **kwargs})


SEARCHES: dict[str, dict[str, Any]] = {
    "one": {"expand": "one"},
    "all": {"expand": "all"},
    "waves of three": {"expand": "one", "leaves_per_wave": 3},
    "rollouts": {"expand": "one", "rollout": TreeRollout(4), "leaves_per_wave": 2},
    "revisits": {"expand": "one", "exhausted": "revisit"},
    "novelty": {"novelty": WidthNovelty("state"), "expand": "one"},
    "transpositions": {"transpositions": Transpositions("state"), "backup": "max"},
    "chance": {"chance": ProgressiveWidening(), "expand": "one"},
    "python": {"tree_policy": least_visited, "expand": "one", "leaves_per_wave": 2},
}


def test_the_next_wave_is_sent_before_the_one_before_it_is_waited_for() -> None:
    env = Beside(MAZE)
    planner_of(env, simulations=5, expand="one", waves_in_flight=2).search(env.reset())
    s, w = "sent", "waited"
    assert env.events == [
        (s, 0), (s, 1), (w, 0), (s, 2), (w, 1), (s, 3), (w, 2), (s, 4), (w, 3), (w, 4),
    ]  # fmt: skip


def test_a_rollout_goes_on_while_another_wave_is_simulated() -> None:
    env = Beside(MAZE)
    planner = planner_of(env, 6, expand="one", waves_in_flight=2, rollout=TreeRollout(2))
    search = planner.search(env.reset())
    s, w = "sent", "waited"
    assert env.events == [
        (s, 0), (s, 1), (w, 0), (s, 2), (w, 1), (s, 3), (w, 2), (s, 4), (w, 3), (s, 5), (w, 4),
        (w, 5),
    ]  # fmt: skip
    # Two chains of three options, each a node below the one before.
    assert sorted(search.tree.nodes["depth"][0, :7].tolist()) == [0, 1, 1, 2, 2, 3, 3]


@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.parametrize("waves", [1, 2, 5])
def test_the_tree_is_the_same_on_a_simulator_that_works_beside(name: str, waves: int) -> None:
    found = []
    for kind in (TableEnv, Beside):
        env = kind(MAZE)
        planner = planner_of(env, waves_in_flight=waves, **SEARCHES[name])
        search = planner.search(env.reset().expand(2).clone())
        assert_nothing_in_flight(search)
        found.append(trees(search))
    assert found[0] == found[1]


@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.parametrize("waves", [2, 7])
def test_a_number_of_simulations_is_kept_to_exactly(name: str, waves: int) -> None:
    env = Beside(MAZE)
    search = planner_of(env, 50, waves_in_flight=waves, **SEARCHES[name]).search(env.reset())
    simulations, revisits = int(search.num_simulations[0]), int(search.roots["revisits"][0])
    if SEARCHES[name].get("expand") == "one" and name != "novelty":
        assert simulations == 50
    else:  # all options of a node at once; with novelty nothing may be left
        assert simulations <= 52
    if name != "chance":  # where equal outcomes are one node
        assert int(search.tree.num_nodes[0]) == 1 + simulations - revisits
    if name in ("revisits", "chance"):  # of what is known, only where nothing else can be done
        assert revisits < 10


@pytest.mark.parametrize("waves", [1, 3])
@pytest.mark.parametrize("event", ["sent", "waited"])
@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize("name", ["waves of three", "all", "rollouts", "chance", "python"])
def test_an_error_leaves_nothing_in_flight_and_the_search_goes_on(
    name: str, number: int, event: str, waves: int
) -> None:
    env = Beside(MAZE)
    env.fails_at = (event, number)
    planner = planner_of(env, 50, waves_in_flight=waves, **SEARCHES[name])
    with pytest.raises(OSError, match=f"{event} {number}"):
        planner.search(env.reset())
    search = planner.last_search
    assert_nothing_in_flight(search)
    assert not env.under_way, "a step was neither waited for nor given up"
    env.fails_at = None
    planner.resume(search)
    assert_nothing_in_flight(search)
    assert 50 <= search.num_simulations[0] <= 52


def test_an_error_of_the_progress_display_or_the_tree_policy_gives_up_what_is_under_way() -> None:
    calls = 0

    def raises(*args: Any) -> torch.Tensor:
        nonlocal calls
        calls += 1
        if calls > 5:
            raise KeyboardInterrupt
        return -args[0].option_visits if isinstance(args[0], NodeStatistics) else torch.zeros(0)

    for keywords in ({"progress": raises}, {"tree_policy": raises}):
        env, calls = Beside(MAZE), 0
        planner = planner_of(env, waves_in_flight=3, expand="one", **keywords)
        with pytest.raises(KeyboardInterrupt):
            planner.search(env.reset())
        assert_nothing_in_flight(planner.last_search)
        assert not env.under_way
        assert env.events


def test_a_copy_made_while_waves_are_in_flight_goes_on() -> None:
    copies: list[Search] = []
    env = Beside(MAZE)
    planner = planner_of(
        env,
        waves_in_flight=3,
        expand="one",
        progress=lambda told: copies.append(pickle.loads(pickle.dumps(told.search))),
    )
    planner.search(env.reset())
    copied = copies[10]
    assert copied.tree.edges["in_flight"].any()
    planner.progress = None
    assert planner.resume(copied).num_simulations.tolist() == [60]
    assert_nothing_in_flight(copied)


def test_a_search_goes_on_after_an_interruption_between_selecting_and_sending() -> None:
    env = Beside(MAZE)
    planner = planner_of(env, waves_in_flight=2, expand="one")
    search = planner.search(env.reset())
    search.select(np.array([0]))  # a wave that never gets further
    search.growing = True
    assert planner.resume(search).num_simulations.tolist() == [60]
    assert_nothing_in_flight(search)


def test_a_search_that_was_interrupted_while_it_inserted_does_not_go_on() -> None:
    env = TableEnv(MAZE)
    planner = planner_of(env, expand="one")
    search = planner.plant(env.reset())

    def interrupted(*args: Any) -> None:
        raise KeyboardInterrupt

    whole, search.tree.set_states = search.tree.set_states, interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        planner.resume(search)
    search.tree.set_states = whole  # type: ignore[method-assign]
    with pytest.raises(RuntimeError, match=r"interrupted while outcomes were inserted.*again"):
        planner.resume(search)


def test_rollouts_do_not_take_an_option_that_is_in_flight() -> None:
    # With chance a rollout may come to a node that is known, where another wave tries an option.
    def check(told: SearchProgress) -> None:
        edges = told.search.tree.edges
        assert edges["in_flight"][edges["child"] < 0].max() <= 1

    for seed in range(10):
        planner = planner_of(
            TableEnv(MAZE),
            200,
            expand="one",
            chance=ProgressiveWidening(),
            rollout=TreeRollout(6),
            waves_in_flight=6,
            progress=check,
        )
        search = planner.search(planner.simulator.env.reset(), seed=seed)
        assert search.num_simulations.tolist() == [200]


def test_an_evaluator_that_fails_is_heard_and_its_wave_is_not_given_up_twice() -> None:
    class Strict(Beside):
        def step_abandon(self, ticket: int) -> None:
            del self.under_way[ticket]

    def fails(td: TensorDictBase) -> torch.Tensor:
        if len(td) and td["state"][0] != 0:
            raise ZeroDivisionError("no value")
        return torch.zeros(len(td))

    env = Strict(MAZE)
    planner = planner_of(env, expand="one", waves_in_flight=3, leaf_evaluator=fails)
    with pytest.raises(ZeroDivisionError, match="no value"):
        planner.search(env.reset())
    assert not env.under_way


def test_when_time_is_up_what_is_under_way_is_finished_and_kept() -> None:
    env = Beside(MAZE)
    planner = planner_of(
        env,
        expand="one",
        waves_in_flight=3,
        rollout=TreeRollout(20),
        budget=SearchBudget(seconds=0.02, until_plan=False),
    )
    search = planner.search(env.reset())
    assert_nothing_in_flight(search)
    sent = sum(event == "sent" for event, _ in env.events)
    assert int(search.num_simulations[0]) == sent == len(env.events) - sent
    assert sent > 3


def test_transforms_of_a_simulator_that_works_beside_are_not_passed_by() -> None:
    # A TransformedEnv hands step_async of its base env on.
    env = TransformedEnv(Beside({(0, 0): (1, 1.0, 1)}, terminal=[1]), RewardScaling(0.0, 3.0))
    planner = planner_of(env, 4, expand="one", waves_in_flight=2)
    assert planner(env.reset())["root_value"].item() == pytest.approx(3.0 / 2)


@pytest.mark.parametrize("policy", [UCT(1.0), PUCT(c=1.0, normalize="tree")])
def test_counts_in_flight_spread_the_waves_over_the_options_of_a_root(policy: Any) -> None:
    # Three waves of one leaf are chosen before anything is known: one for each option.
    env = Beside(MAZE)
    planner = planner_of(env, 3, expand="one", waves_in_flight=3, tree_policy=policy)
    assert planner(env.reset())["root_visits"].tolist() == [1, 1, 1]
    assert [event for event, _ in env.events] == ["sent"] * 3 + ["waited"] * 3
    assert np.array_equal(planner.last_search.tree.nodes["depth"][0, :4], [0, 1, 1, 1])
