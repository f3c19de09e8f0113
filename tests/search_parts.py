"""Parts that tests of the search share: small tables, envs that count, trees as bytes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_hmcts.planners import NodeStatistics, Search, SearchBudget
from torchrl_hmcts.planners.tree import PENDING
from torchrl_hmcts.testing import TableEnv

FOREVER = SearchBudget(expansions=10_000, until_plan=False)
Table = dict[tuple[int, int], tuple[int, float, int]]


def binary_tree(slower: int = 0) -> Table:
    """A tree of depth 3 in which every state is reached in one way only.

    The children of s are 2 s + 1 and 2 s + 2, the second after ``slower`` base steps more; the
    leaves 7 to 14 are terminal and pay s - 10.
    """
    return {
        (s, a): (2 * s + 1 + a, 2 * s + 1 + a - 10.0 if s >= 3 else 0.0, 1 + a * slower)
        for s in range(7)
        for a in range(2)
    }


BINARY_TREE, LEAVES = binary_tree(), list(range(7, 15))
# Forward from 0 to 5, which pays 1; beside the way lies 6, which option 0 leaves for 3.
ROAD: Table = {(s, 1): (s + 1, float(s == 4), 1) for s in range(5)}
ROAD.update({(s, 0): (s, 0.0, 1) for s in range(5)})
ROAD.update({(6, 0): (3, 0.0, 1), (6, 1): (6, 0.0, 1)})
SLIPPERY_ROAD = {**ROAD, (2, 1): (6, 0.0, 1)}  # the same, but from 2 the road leads off to 6


def simulations(n: int) -> SearchBudget:
    return SearchBudget(simulations=n, until_plan=False)


def expansions(n: int) -> SearchBudget:
    return SearchBudget(expansions=n, until_plan=False)


class CountingEnv(TableEnv):
    """A table that records the states and options that it is asked to simulate."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.calls: list[list[tuple[int, int]]] = []

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        states, options = (tensordict[key].flatten().tolist() for key in ("state", "action"))
        self.calls.append(list(zip(states, options, strict=True)))
        return super()._step(tensordict)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """All of them, call after call."""
        return [pair for call in self.calls for pair in call]


class DeadEnd(CountingEnv):
    """No action may be taken in state 1."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = super()._step(tensordict)
        after["action_mask"][after["state"] == 1] = False
        return after


def at(env: Any, states: Any) -> TensorDictBase:
    """The state of an env at the given table states, any shape."""
    state = torch.as_tensor(states)
    return env.reset(TensorDict({"state": state}, state.shape), set_state=True)


def trees(search: Search) -> list[tuple[bytes, bytes]]:
    """All that a search knows of its nodes, byte for byte."""
    tree = search.tree
    used = enumerate(tree.num_nodes)
    return [(tree.nodes[b, :n].tobytes(), tree.edges[b, :n].tobytes()) for b, n in used]


def assert_nothing_in_flight(search: Search | None) -> None:
    assert search is not None
    assert not search.tree.edges["in_flight"].any()
    assert not (search.tree.nodes["flags"] & PENDING).any()
    assert not search.roots["scheduled"].any()


def least_visited(statistics: NodeStatistics) -> Tensor:
    return -statistics.option_visits


def uct_in_python(c: float) -> Callable[[NodeStatistics], Tensor]:
    """UCT in double precision, as the compiled one."""

    def scores(statistics: NodeStatistics) -> Tensor:
        n, n_j = statistics.node_visits.double().unsqueeze(-1), statistics.option_visits.double()
        scores = statistics.option_values.double() + c * (n.log() / n_j.clamp_min(1.0)).sqrt()
        return torch.where(n_j > 0, scores, torch.inf)

    return scores
