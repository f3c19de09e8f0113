"""Examples from finished searches: states with the options and values it found for them.

Letters: B roots, N nodes a root has room for, A options, K examples, r rewarded nodes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.planners.search import Search
from torchrl_hmcts.planners.tree import EXPANDED, FORBIDDEN, PRUNED, REWARDED, TERMINAL


def best_plans_below(search: Search) -> tuple[np.ndarray, np.ndarray]:
    r"""Return the discounted return of the best plan from every node, and its first option.

    .. math:: G(s) = \max_o R(s, o) + D(s, o)\, \max(0, G(s'))

    over the options that lead to a node whose option earned a reward, in a deterministic simulator:
    float64 ``[B, N]``, -inf where no plan is known, and int64 ``[B, N]``, -1 there.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)  # the fourth place pays 1
        >>> returns, options = best_plans_below(MCTSPlanner(env, gamma=0.5).search(env.reset()))
        >>> returns[0, 0].item(), options[0, 0].item()
        (0.25, 1)
    """
    tree = search.tree
    nodes = tree.nodes
    used = np.arange(tree.capacity) < tree.num_nodes[:, None]
    returns = np.full(nodes.shape, -np.inf)
    roots, below = np.nonzero(used & ((nodes["flags"] & REWARDED) != 0))
    steps = []
    gained = np.zeros(len(roots))  # what a plan earns after the node
    while True:  # one option up, for all plans at once
        node = nodes[roots, below]
        going = node["parent"] >= 0
        if not going.any():
            break
        roots, below, node = roots[going], below[going], node[going]
        gained = node["reward"] + node["discount"].astype(np.float64) * gained[going]
        below = node["parent"].astype(np.int64)
        np.maximum.at(returns, (roots, below), gained)
        steps.append((roots, below, node["option"].astype(np.int64), gained))
    options = np.full(nodes.shape, -1, np.int64)
    for roots, below, option, gained in reversed(steps):  # of equal plans the shortest
        best = gained == returns[roots, below]
        options[roots[best], below[best]] = option[best]
    return returns, options


def search_examples(
    search: Search,
    *,
    roots: bool = True,
    plans: bool = True,
    min_visits: int | None = None,
    plan_share: float = 1.0,
    tree_values: bool = False,
    keys: Sequence[NestedKey] | None = None,
) -> TensorDict:
    r"""Turn finished searches into examples for a policy and a value: one step of expert iteration.

    The policy target of a node is

    .. math:: \pi(a) = w\, [a = a_{plan}] + (1 - w)\, N(s, a) / \textstyle\sum_b N(s, b)

    with :math:`w` = ``plan_share`` where the tree holds a plan from the node, and 0 elsewhere. The
    value target is the discounted return of the best plan from there, :math:`G(s)` of
    :func:`best_plans_below`; where none is known the example has no weight for the value, or, with
    ``tree_values``, the node's value :math:`V(s)` by the backup as its target.

    Args:
        search: as a planner's ``search(td)`` returns it.
        roots: take all roots, also those from which nothing was found. Default True.
        plans: take every node from which the tree holds a plan, those of the best plan among them.
            Default True.
        min_visits: take all expanded nodes visited so often, too. Default: none.
        plan_share: :math:`w` in [0, 1]. Default 1: a search that stops at its first plan has spent
            most visits elsewhere. 0 is AlphaZero's target.
        tree_values: use the tree's values where no plan is known. Default False: without a leaf
            evaluator they are 0 there, which means only that nothing was found yet.
        keys: entries of the states to take. Default: all that the search stored.

    Returns:
        Examples ``[K]`` of nodes that are not terminal, in their order: the states' entries,
        ``"policy_target"`` (float32 ``[K, A]``) and ``"policy_weight"`` (float32 ``[K]``, 0 without
        visits and plan), ``"value_target"`` (float32 ``[K, 1]``) and ``"value_weight"`` (float32
        ``[K]``), ``"action_mask"`` (bool ``[K, A]``), ``"root"`` and ``"node"`` (int64 ``[K]``).

    Raises:
        ValueError: if ``plan_share`` is outside [0, 1] or ``min_visits`` is below 1.

    Reference:
        Anthony, Tian and Barber, "Thinking fast and slow with deep learning and tree search", 2017,
        arXiv 1705.08439; Silver et al., "Mastering the game of Go without human knowledge", 2017.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner, search_examples
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> examples = search_examples(MCTSPlanner(env, gamma=0.5).search(env.reset()))
        >>> examples["state"].reshape(-1).tolist(), examples["value_target"].reshape(-1).tolist()
        ([0, 1, 2], [0.25, 0.5, 1.0])
        >>> examples["policy_target"].argmax(-1).tolist()
        [1, 1, 1]
    """
    if not 0.0 <= plan_share <= 1.0:
        raise ValueError(f"search_examples needs plan_share in [0, 1]; got {plan_share}.")
    if min_visits is not None and min_visits < 1:
        raise ValueError(
            f"search_examples needs min_visits >= 1, or None for no such nodes; got {min_visits}."
        )
    tree = search.tree
    assert tree.states is not None
    flags = tree.nodes["flags"]
    used = np.arange(tree.capacity) < tree.num_nodes[:, None]
    returns, planned = best_plans_below(search)
    taken = np.zeros(flags.shape, np.bool_)
    taken[:, 0] = roots
    if plans:
        taken |= planned >= 0
    if min_visits is not None:
        inner = ((flags & EXPANDED) != 0) & ((flags & PRUNED) == 0)
        taken |= inner & (tree.nodes["visits"] >= min_visits)
    taken &= used & ((flags & TERMINAL) == 0)
    root, node = np.nonzero(taken)

    edges = tree.edges[root, node]  # [K, A]
    visits = edges["visits"].astype(np.float32)
    total = visits.sum(-1, keepdims=True)
    policy = visits / np.maximum(total, 1.0)
    option, known = planned[root, node], planned[root, node] >= 0
    rows = np.flatnonzero(known)
    share = np.where(total[rows, 0] > 0, np.float32(plan_share), np.float32(1.0))
    policy[rows] *= 1.0 - share[:, None]
    policy[rows, option[rows]] += share
    values = np.where(known, returns[root, node], tree.nodes["value"][root, node])
    has_policy = known | (total[:, 0] > 0)
    has_value = known | tree_values

    states = tree.states[torch.from_numpy(root), torch.from_numpy(node)]
    examples = (states if keys is None else states.select(*keys)).to_tensordict()

    def tensor(array: np.ndarray, dtype: type) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, dtype)).to(states.device or "cpu")

    examples.update(
        {
            "policy_target": tensor(policy, np.float32),
            "policy_weight": tensor(has_policy, np.float32),
            "value_target": tensor(values[:, None], np.float32),
            "value_weight": tensor(has_value, np.float32),
            "action_mask": tensor(edges["closed"] != FORBIDDEN, np.bool_),
            "root": tensor(root, np.int64),
            "node": tensor(node, np.int64),
        }
    )
    return examples
