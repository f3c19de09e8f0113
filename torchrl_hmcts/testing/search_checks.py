"""Checks of what a search is made of: tree policies, evaluators, priors, novelty, planners.

Letters: d nodes, A options, m states, F features.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_hmcts.planners.budget import SearchBudget
from torchrl_hmcts.planners.mcts import MCTSPlanner
from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.planners.tree_policies import PUCT, UCT, Gumbel, NodeStatistics, TreePolicy
from torchrl_hmcts.testing.contract import (
    asked,
    during,
    require,
    require_action,
    require_alone,
    require_read,
    require_same,
)
from torchrl_hmcts.testing.solvable_envs import ChainEnv


def check_tree_policy(tree_policy: TreePolicy) -> None:
    """Check that a tree policy can lead a search.

    A callable is shown random nodes, unvisited and forbidden options among them: it gives each
    allowed option a score, which may be infinite but is a number, changes nothing, and judges a
    node by its own statistics. Then a search with it, one option or all of them at a time, must
    find the end of a short chain.

    Args:
        tree_policy: :class:`~torchrl_hmcts.planners.UCT` and its like, or a callable over
            :class:`~torchrl_hmcts.planners.NodeStatistics`.

    Raises:
        ContractError: if it cannot.

    Examples:
        >>> from torchrl_hmcts.testing import check_tree_policy
        >>> check_tree_policy(lambda nodes: nodes.option_values + 1 / (1 + nodes.option_visits))
    """
    name = _name(tree_policy)
    gumbel = isinstance(tree_policy, Gumbel)
    if not isinstance(tree_policy, (UCT, PUCT, Gumbel)):
        require(
            callable(tree_policy),
            f"{name} is no tree policy. Pass UCT(), PUCT(), Gumbel() or a callable "
            "policy(nodes) -> scores [d, A].",
        )
        _check_scores(name, tree_policy)
    ways: tuple[Literal["one", "all"], ...] = ("one",) if gumbel else ("one", "all")
    for expand in ways:
        budget = SearchBudget(simulations=200, until_plan=not gumbel)
        env = ChainEnv(length=5)
        with during(name, f"leading a search with expand={expand!r}"):
            planner = MCTSPlanner(
                env, tree_policy=tree_policy, expand=expand, budget=budget, seed=0
            )
            out = planner(env.reset())
        require(
            out.get("plan_found").item(),
            f"{name} does not find the end of a chain of 5 states within 200 simulations with "
            f"expand={expand!r}. Let the score of an option fall with its visits.",
        )


def _check_scores(name: str, tree_policy: Any) -> None:
    d, num_options = 6, 3
    g = torch.Generator().manual_seed(0)
    visits = torch.randint(0, 4, (d, num_options), generator=g).float()
    visits[0] = 0.0
    values = torch.rand(d, num_options, generator=g) * (visits > 0)
    allowed = torch.rand(d, num_options, generator=g) < 0.7
    allowed[:, 0] = True
    nodes = NodeStatistics(
        node_visits=1.0 + visits.sum(-1),
        node_values=torch.rand(d, generator=g),
        depths=torch.arange(d),
        option_visits=visits,
        option_values=values,
        option_squares=visits * values.square(),
        priors=torch.full((d, num_options), 1.0 / num_options),
        allowed=allowed,
        batch_size=[d],
    )

    def score(nodes: NodeStatistics) -> Tensor:
        return asked(name, tree_policy, nodes, "scoring nodes")

    scores = score(nodes)
    _require_tensor(name, scores, [d, num_options], f"{d} nodes of {num_options} options")
    bad = torch.isnan(scores) & allowed
    if bad.any():
        n, a = (int(i) for i in bad.nonzero()[0])
        require(
            False,
            f"{name} gives NaN for an option with {int(visits[n, a])} visits in a node with "
            f"{int(visits[n].sum())}. Give options without visits a score, e.g. torch.inf.",
        )
    require_alone(
        name,
        lambda rows: score(rows).masked_fill(~rows.allowed, 0.0),
        nodes,
        scores.masked_fill(~allowed, 0.0),
        "the scores of node",
        "Judge a node by its own row: others are of other trees.",
    )


def _require_tensor(name: str, value: object, shape: list[int], whats: str) -> None:
    got = list(value.shape) if isinstance(value, Tensor) else type(value).__name__
    require(got == shape, f"{name} gives {got} for {whats}; it must give a tensor {shape}.")


def check_evaluator(evaluator: Callable[[TensorDictBase], Tensor], states: TensorDictBase) -> None:
    """Check that a function can evaluate the leaves of a search.

    One finite value per state, without a gradient, which does not depend on the other states.
    (:class:`~torchrl_hmcts.planners.RolloutEvaluator` and its like need a planner first.)

    Args:
        evaluator (callable): ``evaluator(td) -> values [m]`` or ``[m, 1]``.
        states (TensorDictBase): states ``[m]``.

    Raises:
        ContractError: if it cannot.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.testing import check_evaluator
        >>> states = TensorDict(state=torch.arange(5), batch_size=[5])
        >>> check_evaluator(lambda td: 0.9 ** (4 - td["state"]), states)
    """
    _check_function(evaluator, states, "value", [len(states)])


def check_option_prior(
    option_prior: Callable[[TensorDictBase], Tensor], states: TensorDictBase, num_options: int
) -> None:
    """Check that a function can be the prior of the options in a search.

    Finite weights that are not negative, one at least positive, for each state, without a gradient,
    which do not depend on the other states.

    Args:
        option_prior (callable): ``option_prior(td) -> probabilities [m, A]``.
        states (TensorDictBase): states ``[m]``.
        num_options (int): A.

    Raises:
        ContractError: if it cannot.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.testing import check_option_prior
        >>> states = TensorDict(state=torch.arange(5), batch_size=[5])
        >>> check_option_prior(lambda td: torch.full((len(td), 2), 0.5), states, num_options=2)
    """
    prior = _check_function(option_prior, states, "prior", [len(states), num_options])
    wrong = (prior < 0).any(-1) | (prior.sum(-1) <= 0)
    require(
        not wrong.any(),
        f"{_name(option_prior)} gives the prior {prior[wrong][:1].tolist()}; probabilities are not "
        "negative and not all 0. Of logits take the softmax.",
    )


def _name(function: object) -> str:
    name: str = getattr(function, "__name__", type(function).__name__)
    return name


def _check_function(
    function: Callable[[TensorDictBase], Tensor],
    states: TensorDictBase,
    what: str,
    shape: list[int],
) -> Tensor:
    """Ask a function about states, together and one by one; return what it says of all."""
    name = _name(function)
    require_read(name, function, states, "a state")

    def ask(states: TensorDictBase) -> Tensor:
        return asked(name, function, states, "evaluating states")

    found = ask(states)
    if isinstance(found, Tensor) and list(found.shape) == [*shape, 1] and len(shape) == 1:
        found = found.squeeze(-1)
    _require_tensor(name, found, shape, f"{len(states)} states, as {what}")
    require(
        torch.isfinite(found).all(),
        f"{name} gives the {what} {found[~torch.isfinite(found)][:1].tolist()}, which is not "
        "finite. Find the state it comes from, or clamp it.",
    )
    require_alone(
        name, lambda row: ask(row).reshape(1, *shape[1:]), states, found, f"the {what} of state"
    )
    return found


def check_planner(planner: TensorDictModuleBase, env: EnvBase) -> None:
    """Check that a module can be the manager of a macro environment: a policy that plans.

    It reads what the env has and writes an option of its action spec, and all its ``out_keys``, for
    a root and for a batch of them; it leaves the rest of the tensordict as it was; and it acts in a
    rollout.

    Args:
        planner (TensorDictModuleBase): e.g. an :class:`~torchrl_hmcts.planners.MCTSPlanner`.
        env (EnvBase): the env to act in. If it is stateless (``batch_locked`` is False), batches
            are tried.

    Raises:
        ContractError: if it cannot.

    Examples:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv, check_planner
        >>> env = ChainEnv(length=4)
        >>> check_planner(MCTSPlanner(env), env)
    """
    name = type(planner).__name__
    roots = [env.reset()]
    if not env.batch_locked and not env.batch_size:
        roots += [env.reset(TensorDict(batch_size=[2])), env.reset(TensorDict(batch_size=[2, 1]))]
    for root in roots:
        require_read(name, planner, root, "a reset of the env")
        td = root.clone()
        with during(name, f"planning for roots {list(root.batch_size)}"):
            td = planner(td)
        require_action(name, env, td)
        absent = [key for key in planner.out_keys if td.get(key, None) is None]
        require(not absent, f"{name} announces {absent} in out_keys and writes none of them.")
        message = "changed <key> of the state it planned from. Plan in a copy."
        require_same(root, td, f"{name} {message}")
    with during(name, "acting in a rollout"):
        env.rollout(2, planner)


_MANY = 10_000
_MEMBERS = ("in_keys", "start", "restart", "features", "accept", "relax")


def check_novelty(novelty: NoveltyTest, states: TensorDictBase) -> None:
    """Check that a novelty test can decide which nodes are worth searching.

    It has the members of :class:`~torchrl_hmcts.planners.NoveltyTest`; its features are numbers,
    one row per state, and of that state only; in an empty tree the first state is novel, and is so
    no more when it comes again; roots know nothing of each other, and forget when they are
    restarted; a search has a copy of its own; relaxing it comes to an end.

    Args:
        novelty (NoveltyTest): the test; it is started again.
        states (TensorDictBase): states ``[m]`` with its ``in_keys``, at least two that differ.

    Raises:
        ValueError: if there are not two states.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.planners import RadiusNovelty
        >>> from torchrl_hmcts.testing import check_novelty
        >>> states = TensorDict(position=torch.rand(5, 2), batch_size=[5])
        >>> check_novelty(RadiusNovelty("position", 0.1), states)
    """
    name = type(novelty).__name__
    if len(states.batch_size) != 1 or len(states) < 2:
        raise ValueError(
            f"check_novelty needs states [m], two at least; got batch size "
            f"{list(states.batch_size)}."
        )
    missing = [member for member in _MEMBERS if not hasattr(novelty, member)]
    require(
        not missing,
        f"{name} lacks {missing}. A novelty test has the members of "
        "torchrl_hmcts.planners.NoveltyTest.",
    )
    require_read(name, novelty, states, "a state")
    with during(name, "reading features"):
        novelty.start(1)
        features = novelty.features(states.clone())
    _require_array(f"{name}.features", features, (len(states), -1), "biuf")
    require_alone(
        f"{name}.features",
        lambda rows: novelty.features(rows.clone()),
        states,
        features,
        "state",
        "Let them depend on their own state only.",
    )
    _check_accept(name, novelty, features)
    _check_relax(name, novelty)
    statistics: Any = getattr(novelty, "statistics", dict)()
    good = isinstance(statistics, dict) and all(
        isinstance(count, (int, float)) for count in statistics.values()
    )
    require(good, f"{name}.statistics gives {statistics!r}; it must give a dict of numbers.")


def _require_array(what: str, array: Any, shape: tuple[int, ...], kinds: str) -> None:
    """Require a NumPy array of a shape, in which -1 is any number, and of kinds of types."""
    found = isinstance(array, np.ndarray)
    got = f"{array.dtype} {list(array.shape)}" if found else type(array).__name__
    good = found and array.dtype.kind in kinds and array.ndim == len(shape)
    good = good and all(want in (-1, n) for want, n in zip(shape, array.shape, strict=True))
    kind = "bool" if kinds == "b" else "numeric"
    require(good, f"{what} gives {got}; it must give a {kind} array {list(shape)}, -1 for any.")


def _check_accept(name: str, novelty: NoveltyTest, features: np.ndarray) -> None:
    m = len(features)

    def ask(test: NoveltyTest, root: int, at: int = 0) -> np.ndarray:
        with during(name, "asked about new states"):
            accepted = test.accept(np.full(m, root), features, np.arange(m) + at)
        _require_array(f"{name}.accept", accepted, (m,), "b")
        return accepted

    novelty.start(3)
    first = ask(novelty, 0)
    require(first[0], f"{name} refuses the first state of an empty tree. Nothing is known there.")
    twice = np.flatnonzero(ask(novelty, 0, at=m) & first)
    require(
        not len(twice),
        f"{name} accepts state {twice[:1]} a second time. Remember what was accepted, or a search "
        "visits the same states again and again.",
    )
    require(
        np.array_equal(ask(novelty, 1), first),
        f"{name}: what root 0 has seen counts for root 1. Keep what is known per root.",
    )
    with during(name, "restarting a root"):
        novelty.restart(0)
    require(
        np.array_equal(ask(novelty, 0), first),
        f"{name}.restart(0) does not forget the states of root 0.",
    )
    require(
        not ask(novelty, 1, at=m)[first].any(),
        f"{name}.restart(0) forgot the states of root 1 too. Forget those of one root.",
    )
    twin = copy.copy(novelty)
    twin.start(3)
    ask(twin, 2)
    require(
        np.array_equal(ask(novelty, 2), first),
        f"{name}: a copy that was started shares what it knows with the original. Assign new "
        "arrays in start(): each search starts a shallow copy.",
    )


def _check_relax(name: str, novelty: NoveltyTest) -> None:
    for _ in range(_MANY):
        with during(name, "relaxed"):
            relaxed = novelty.relax(0)
        require(
            isinstance(relaxed, (bool, np.bool_)),
            f"{name}.relax gives {relaxed!r}; it must give True, or False if it cannot.",
        )
        if not relaxed:
            return
    require(
        False,
        f"{name}.relax(0) was True {_MANY} times. Give False at last, or an exhausted search never "
        "ends.",
    )
