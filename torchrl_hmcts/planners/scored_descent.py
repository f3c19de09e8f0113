"""Descents by a tree policy that is written in Python.

All descents of a wave go down together, one level at a time, so that the policy is called once per
level with the statistics of every node they stand at.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.planners.settings import SearchSettings
from torchrl_hmcts.planners.tree import (
    CLOSED,
    EXPANDED,
    FORBIDDEN,
    PENDING,
    PRUNED,
    TERMINAL,
    TreeArrays,
)
from torchrl_hmcts.planners.tree_policies import NodeStatistics, ScoreFunction


def select_by_scores(
    tree: TreeArrays, settings: SearchSettings, record: np.ndarray, wave: np.ndarray
) -> int:
    """Descend to the leaves of every active root; return how many outcomes to simulate.

    Does what :func:`kernels.select` does, with one difference: a root whose descent ends in a leaf
    that is known already has it backed up and adds nothing to this wave.
    """
    from torchrl_hmcts.planners import subtree_kernels as kernels

    nodes, edges, roots = tree.nodes, tree.edges, tree.roots
    revisit, scores = settings.revisit, settings.tree_policy
    assert callable(scores)
    scheduled = roots["scheduled"].copy()
    waits = np.zeros(len(roots), np.bool_)  # ran into a leaf that is being simulated
    count = 0

    def schedule(b: np.ndarray, n: np.ndarray, a: np.ndarray) -> None:
        nonlocal count
        rows = wave[count : count + len(b)]
        rows["root"], rows["node"], rows["option"] = b, n, a
        np.add.at(scheduled, b, 1)
        count += len(b)

    def give_up(b: np.ndarray, n: np.ndarray) -> None:
        waits[b] = True
        kernels.release_all(nodes, edges, b, n)

    for _ in range(settings.leaves_per_wave):
        room = roots["simulations"] + scheduled < roots["limit"]
        open_ = (nodes["flags"][:, 0] & CLOSED) == 0
        if revisit:
            open_ |= roots["limit"] != np.iinfo(np.int64).max
        b = np.flatnonzero((roots["active"] != 0) & room & open_ & ~waits)
        n = np.zeros_like(b)
        while len(b):
            flags = nodes["flags"][b, n]
            known = (flags & (TERMINAL | PRUNED)) != 0
            fresh = np.zeros(len(b), np.bool_)
            if settings.expand == "all":
                fresh = ~known & ((flags & EXPANDED) == 0) & (nodes["open_options"][b, n] > 0)
                pending = fresh & ((flags & PENDING) != 0)
                give_up(b[pending], n[pending])
                leaves = fresh & ~pending
                nodes["flags"][b[leaves], n[leaves]] |= PENDING
                which, options = np.nonzero(edges["closed"][b[leaves], n[leaves]] != FORBIDDEN)
                schedule(b[leaves][which], n[leaves][which], options)
            # With chance, what is in flight keeps options above from being drawn again.
            early = known & (settings.chance is not None) & (scheduled[b] > 0)
            give_up(b[early], n[early])
            late = known & ~early
            kernels.revisit_all(nodes, edges, roots, record, b[late], n[late])
            stays = known | fresh
            b, n = b[~stays], n[~stays]
            if not len(b):
                break
            edge = edges[b, n]  # [d, A], a copy
            allowed = edge["closed"] != FORBIDDEN if revisit else edge["closed"] == 0
            stuck = ~allowed.any(-1)
            if stuck.any():
                if revisit:
                    kernels.revisit_all(nodes, edges, roots, record, b[stuck], n[stuck])
                else:
                    give_up(b[stuck], n[stuck])
                b, n, edge, allowed = b[~stuck], n[~stuck], edge[~stuck], allowed[~stuck]
                if not len(b):
                    break
            if settings.transpositions is not None:
                kernels.refresh_all(nodes, edges, b, n)
                edge = edges[b, n]
            a = _best(scores, nodes[b, n], edge, allowed)
            taken = edge[np.arange(len(b)), a]
            wants = (taken["child"] < 0) | kernels.wants_samples(edges, record, b, n, a)
            busy = wants & (taken["in_flight"] > 0)
            give_up(b[busy], n[busy])
            edges["in_flight"][b[~busy], n[~busy], a[~busy]] += 1
            new = wants & ~busy
            schedule(b[new], n[new], a[new])
            b, child = b[~wants], taken["child"][~wants].astype(np.int64)
            n = kernels.outcomes(nodes, b, child)
    return count


def _best(
    scores: ScoreFunction, node: np.ndarray, edge: np.ndarray, allowed: np.ndarray
) -> np.ndarray:
    """The options of highest score; ties go to the higher prior, then to the lower index."""

    def tensor(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values.astype(np.float32))

    option_visits = edge["visits"].astype(np.float32) + edge["in_flight"]
    statistics = NodeStatistics(
        node_visits=tensor(1.0 + option_visits.sum(-1)),
        node_values=tensor(node["value"]),
        depths=torch.from_numpy(node["depth"].astype(np.int64)),
        option_visits=tensor(option_visits),
        option_values=tensor(np.where(edge["visits"] > 0, edge["value"], 0.0)),
        option_squares=tensor(edge["squares"]),
        priors=tensor(edge["prior"]),
        allowed=torch.from_numpy(allowed.copy()),  # the policy may write into it
        batch_size=[len(node)],
    )
    result = scores(statistics)
    if not isinstance(result, Tensor) or tuple(result.shape) != allowed.shape:
        got = list(result.shape) if isinstance(result, Tensor) else type(result).__name__
        raise ValueError(
            f"The tree policy returned {got}; it must give one score per node and option, a tensor "
            f"{list(allowed.shape)}."
        )
    values: np.ndarray = result.detach().to(torch.float64).cpu().numpy()
    if np.isnan(values[allowed]).any():
        where = np.argwhere(np.isnan(values) & allowed)[0]
        raise ValueError(
            f"The tree policy returned NaN for option {where[1]}, visited "
            f"{int(option_visits[where[0], where[1]])} times. Give options without visits a score; "
            f"for torchrl.modules.mcts wrap it in TorchRLScore."
        )
    values = np.where(allowed, values, -np.inf)
    ties = (values == values.max(-1, keepdims=True)) & allowed
    best: np.ndarray = np.where(ties, edge["prior"], -1.0).argmax(-1)
    return best
