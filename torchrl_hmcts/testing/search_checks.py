"""Checks of what a search is made of: tree policies, evaluators, priors, planners.

Letters: d nodes, A options, m states.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_hmcts.planners.budget import SearchBudget
from torchrl_hmcts.planners.mcts import MCTSPlanner
from torchrl_hmcts.planners.tree_policies import PUCT, UCT, Gumbel, NodeStatistics, TreePolicy
from torchrl_hmcts.testing.claims import ContractError, different, during, leaves, require, seeded
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
    name = getattr(tree_policy, "__name__", type(tree_policy).__name__)
    built_in = isinstance(tree_policy, (UCT, PUCT, Gumbel))
    if not built_in:
        if not callable(tree_policy):
            raise ContractError(
                f"{name} is no tree policy. Pass UCT(), PUCT(), Gumbel() or a callable "
                "policy(nodes) -> scores [d, A]."
            )
        _check_scores(name, tree_policy)
    env = ChainEnv(length=5)
    for expand in ("one", "all"):
        if isinstance(tree_policy, Gumbel) and expand == "all":
            continue
        until_plan = not isinstance(tree_policy, Gumbel)
        budget = SearchBudget(simulations=200, until_plan=until_plan)
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


def _check_scores(name: str, tree_policy: Callable[[NodeStatistics], Tensor]) -> None:
    num_nodes, num_options = 6, 3
    g = torch.Generator().manual_seed(0)
    visits = torch.randint(0, 4, (num_nodes, num_options), generator=g).float()
    visits[0] = 0.0
    values = torch.rand(num_nodes, num_options, generator=g) * (visits > 0)
    allowed = torch.rand(num_nodes, num_options, generator=g) < 0.7
    allowed[:, 0] = True
    nodes = NodeStatistics(
        node_visits=1.0 + visits.sum(-1),
        node_values=torch.rand(num_nodes, generator=g),
        depths=torch.arange(num_nodes),
        option_visits=visits,
        option_values=values,
        option_squares=visits * values.square(),
        priors=torch.full((num_nodes, num_options), 1.0 / num_options),
        allowed=allowed,
        batch_size=[num_nodes],
    )
    given = nodes.clone()
    with during(name, "scoring nodes"), seeded(0):
        scores = tree_policy(given)
    good = isinstance(scores, Tensor) and scores.shape == visits.shape
    if not good:
        got = list(scores.shape) if isinstance(scores, Tensor) else type(scores).__name__
        raise ContractError(
            f"{name} gives {got} for {num_nodes} nodes of {num_options} options; it must give a "
            f"tensor {[num_nodes, num_options]}, the score of each option."
        )
    bad = torch.isnan(scores) & allowed
    if bad.any():
        n, a = (int(i) for i in bad.nonzero()[0])
        raise ContractError(
            f"{name} gives NaN for an option with {int(visits[n, a])} visits in a node with "
            f"{int(visits[n].sum())}. Give options without visits a score, e.g. torch.inf."
        )
    where = different(nodes.to_tensordict(), given.to_tensordict(), leaves(nodes.to_tensordict()))
    require(
        where is None, f"{name} changed {where and where[0]!r} of the nodes. Compute on copies."
    )
    for n in range(num_nodes):
        with during(name, "scoring a single node"), seeded(0):
            alone = tree_policy(nodes[n : n + 1].clone())
        close = torch.isclose(alone[0].double(), scores[n].double(), rtol=1e-4, atol=1e-6)
        require(
            (close | ~allowed[n]).all(),
            f"{name} scores a node {alone[0].tolist()} alone and {scores[n].tolist()} among "
            "others. Judge a node by its own row: others are of other trees.",
        )


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
    name = getattr(evaluator, "__name__", type(evaluator).__name__)
    m = len(states)
    values = _evaluate(name, evaluator, states)
    require(
        values.shape in (torch.Size([m]), torch.Size([m, 1])),
        f"{name} gives values {list(values.shape)} for {m} states; it must give [{m}] or [{m}, 1].",
    )
    _check_rows(name, evaluator, states, values, "value")


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
    name = getattr(option_prior, "__name__", type(option_prior).__name__)
    m = len(states)
    prior = _evaluate(name, option_prior, states)
    require(
        prior.shape == torch.Size([m, num_options]),
        f"{name} gives {list(prior.shape)} for {m} states of {num_options} options; it must give "
        f"[{m}, {num_options}].",
    )
    _check_rows(name, option_prior, states, prior, "prior")
    require(
        (prior >= 0).all() and (prior.sum(-1) > 0).all(),
        f"{name} gives the prior {prior[((prior < 0).any(-1) | (prior.sum(-1) <= 0))][:1].tolist()}"
        "; probabilities are not negative and not all 0. Of logits take the softmax.",
    )


def _evaluate(
    name: str, function: Callable[[TensorDictBase], Tensor], states: TensorDictBase
) -> Tensor:
    for key in getattr(function, "in_keys", ()):
        require(
            states.get(key, None) is not None,
            f"{name} reads {key!r}, which the states do not have. Add it, or correct in_keys.",
        )
    given = states.clone()
    with during(name, "evaluating states"), torch.no_grad(), seeded(0):
        out = function(given)
    if not isinstance(out, Tensor):
        raise ContractError(f"{name} gives {type(out).__name__}; it must give a tensor.")
    where = different(states, given, leaves(states))
    require(
        where is None, f"{name} changed {where and where[0]!r} of the states. Compute on copies."
    )
    return out


def _check_rows(
    name: str,
    function: Callable[[TensorDictBase], Tensor],
    states: TensorDictBase,
    values: Tensor,
    what: str,
) -> None:
    require(
        torch.isfinite(values).all(),
        f"{name} gives the {what} {values[~torch.isfinite(values)][:1].tolist()}, which is not "
        "finite. Find the state it comes from, or clamp it.",
    )
    for i in range(len(states)):
        alone = _evaluate(name, function, states[i : i + 1])
        require(
            torch.allclose(alone[0].double(), values[i].double(), rtol=1e-4, atol=1e-6),
            f"{name} gives state {i} the {what} {alone[0].tolist()} alone and "
            f"{values[i].tolist()} among others. Judge each state by itself (no batch statistics).",
        )


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
        for key in planner.in_keys:
            require(
                root.get(key, None) is not None,
                f"{name} reads {key!r}, which a reset of the env does not give: it gives "
                f"{sorted(map(str, leaves(root)))}. Correct its in_keys, or the env.",
            )
        td = root.clone()
        with during(name, f"planning for roots {list(root.batch_size)}"):
            td = planner(td)
        for key in map(unravel_key, env.action_keys):
            option = td.get(key, None)
            require(option is not None, f"{name} wrote no {key!r}, the action of the env.")
            leaf = env.full_action_spec_unbatched[key]
            spec = leaf.expand((*root.batch_size, *leaf.shape))
            require(
                option.shape == spec.shape and option.dtype == spec.dtype and spec.is_in(option),
                f"{name} wrote {key!r} = {option.dtype} {list(option.shape)} {option!s:.100} for "
                f"roots {list(root.batch_size)}, which does not fit {spec}.",
            )
        absent = [key for key in planner.out_keys if td.get(key, None) is None]
        require(not absent, f"{name} announces {absent} in out_keys and writes none of them.")
        where = different(root, td, leaves(root))
        require(
            where is None,
            f"{name} changed {where and where[0]!r} of the state it planned from. Plan in a copy.",
        )
    with during(name, "acting in a rollout"):
        env.rollout(2, planner)
