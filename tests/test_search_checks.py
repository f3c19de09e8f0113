"""The checks of a search's parts refuse those that are broken on purpose, and say what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from test_testing_checks import broken
from torch import Tensor

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    Gumbel,
    MCTSPlanner,
    NodeStatistics,
    RadiusNovelty,
    TorchRLScore,
    WidthNovelty,
)
from torchrl_hmcts.testing import (
    ChainEnv,
    ContractError,
    check_evaluator,
    check_novelty,
    check_option_prior,
    check_planner,
    check_tree_policy,
)

# ---------------------------------------------------------------------------------- search


def ucb(nodes: NodeStatistics) -> Tensor:
    return nodes.option_values + (nodes.node_visits[:, None] / (1 + nodes.option_visits)).sqrt()


@pytest.mark.parametrize("policy", [UCT(), PUCT(), Gumbel(scale=0.0), ucb])
def test_a_tree_policy_that_works_passes(policy: Any) -> None:
    check_tree_policy(policy)


def test_a_score_of_torchrl_passes() -> None:
    scores = pytest.importorskip("torchrl.modules.mcts.scores")
    check_tree_policy(TorchRLScore(scores.PUCTScore(c=1.25)))


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (
            lambda nodes: nodes.option_values / nodes.option_visits,
            "NaN for an option with 0 visits",
        ),
        (lambda nodes: nodes.node_values, r"gives \[6\] for 6 nodes of 3 options"),
        (
            lambda nodes: nodes.option_values - nodes.option_values.mean(0) - nodes.option_visits,
            "Judge a node by its own row",
        ),
        (lambda nodes: nodes.option_visits.zero_(), "changed 'option_visits' of its input"),
        (7, "int is no tree policy"),
    ],
)
def test_a_tree_policy_that_is_broken_is_refused(policy: Any, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_tree_policy(policy)


class Novelty(RadiusNovelty):
    """A test that works, to be broken by the classes below."""

    def __init__(self) -> None:
        super().__init__("x", 0.1)


class OneMemory(Novelty):
    def accept(self, roots: np.ndarray, features: np.ndarray, base_steps: np.ndarray) -> np.ndarray:
        return super().accept(np.zeros_like(roots), features, base_steps)


class NeverForgets(Novelty):
    def restart(self, root: int) -> None:
        pass


AcceptsAll = broken(Novelty, accept=lambda out, *_: np.ones_like(out))("AcceptsAll")
RelaxesForEver = broken(Novelty, relax=lambda *_: True)("RelaxesForEver")
MixesFeatures = broken(Novelty, features=lambda x, *_: x - x.mean(0))("MixesFeatures")


class SharesItsMemory(Novelty):
    """A copy that is started writes into the memory of the original."""

    def start(self, num_roots: int) -> None:
        if not hasattr(self, "known"):
            self.known: dict[int, set] = {}
        self.known.clear()

    def restart(self, root: int) -> None:
        self.known.pop(root, None)

    def accept(self, roots: np.ndarray, features: np.ndarray, base_steps: np.ndarray) -> np.ndarray:
        out = []
        for root, row in zip(roots.tolist(), features.tolist(), strict=True):
            seen = self.known.setdefault(root, set())
            out.append(tuple(row) not in seen)
            seen.add(tuple(row))
        return np.array(out)


STATES = TensorDict(x=torch.tensor([[0.0], [1.0], [2.0]]), batch_size=[3])


def test_novelty_tests_that_work_pass() -> None:
    check_novelty(Novelty(), STATES)
    check_novelty(RadiusNovelty("x", 0.1, shorter_paths=True), STATES)
    check_novelty(WidthNovelty("x"), STATES.to(torch.int64))


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (AcceptsAll, "AcceptsAll accepts state .0. a second time"),
        (OneMemory, "what root 0 has seen counts for root 1"),
        (NeverForgets, r"restart\(0\) does not forget"),
        (RelaxesForEver, "was True 10000 times"),
        (MixesFeatures, "features gives state 0 .* alone"),
        (SharesItsMemory, "a copy that was started shares what it knows"),
    ],
)
def test_a_novelty_test_that_is_broken_is_refused(cls: type, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_novelty(cls(), STATES)


def test_what_lacks_the_members_of_a_novelty_test_is_refused() -> None:
    with pytest.raises(ContractError, match="object lacks .*'accept'"):
        check_novelty(object(), STATES)  # type: ignore[arg-type]
    with pytest.raises(ContractError, match="reads 'y'"):
        check_novelty(RadiusNovelty("y", 1.0), STATES)


@pytest.mark.parametrize(
    ("evaluator", "message"),
    [
        (lambda td: td["x"].expand(-1, 2), r"gives \[3, 2\] for 3 states, as value"),
        (lambda td: td["x"].log(), "which is not finite"),
        (lambda td: td["x"] - td["x"].mean(), "gives the value of state 0"),
        (lambda td: td["x"].zero_(), "changed 'x' of its input"),
        (lambda td: 0.0, "gives float for 3 states"),
    ],
)
def test_an_evaluator_that_is_broken_is_refused(evaluator: Callable, message: str) -> None:
    check_evaluator(lambda td: td["x"], STATES)
    with pytest.raises(ContractError, match=message):
        check_evaluator(evaluator, STATES.clone())


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (lambda td: td["x"], r"gives \[3, 1\] for 3 states, as prior"),
        (lambda td: torch.cat([td["x"], -td["x"]], -1), "probabilities are not negative"),
        (lambda td: torch.cat([td["x"], td["x"]], -1), "not all 0"),
    ],
)
def test_an_option_prior_that_is_broken_is_refused(prior: Callable, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_option_prior(prior, STATES.clone(), 2)


def moved(key: str, by: int) -> Callable[..., TensorDictBase]:
    return lambda out, *_: out.set(key, out[key] + by)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda out, *_: out.exclude("action"), "Planner wrote no 'action'"),
        (moved("action", 9), "Planner wrote 'action' .* does not fit"),
        (moved("state", 1), "Planner changed 'state'"),
    ],
)
def test_a_planner_that_is_broken_is_refused(change: Callable, message: str) -> None:
    env = ChainEnv(length=4)
    with pytest.raises(ContractError, match=message):
        check_planner(broken(MCTSPlanner, forward=change)("Planner")(env), env)
