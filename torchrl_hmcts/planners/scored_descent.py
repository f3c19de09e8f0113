"""Descents by a tree policy that is written in Python.

All descents of a wave go down together, one level at a time, so that the policy is called once per
level with the statistics of every node they stand at.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.planners.settings import SearchSettings
from torchrl_hmcts.planners.tree import FORBIDDEN, TreeArrays
from torchrl_hmcts.planners.tree_policies import NodeStatistics, ScoreFunction


def select_by_scores(
    tree: TreeArrays, settings: SearchSettings, record: np.ndarray, wave: np.ndarray
) -> int:
    """Descend to the leaves of every active root; return how many outcomes to simulate.

    Python walks the trees down, one descent of each root at a time; :func:`kernels.select`
    continues.
    """
    from torchrl_hmcts.planners import kernels

    roots, count = tree.roots, 0
    active, scheduled = roots["active"].copy(), roots["scheduled"].copy()
    alone, gumbel = record.copy(), np.zeros((0, 0), np.float32)
    alone["leaves"] = 1
    try:
        for _ in range(settings.leaves_per_wave):
            revisits = roots["revisits"].copy()
            begin = roots["simulations"] + roots["scheduled"]
            _walk(tree, settings, record)
            found = kernels.select(tree.nodes, tree.edges, roots, alone, gumbel, wave[count:], True)
            np.add.at(roots["scheduled"], wave["root"][count : count + found], 1)
            count += found
            # Who has met what is being simulated, or has spent its simulations, waits.
            moved = roots["simulations"] + roots["scheduled"] > begin
            roots["active"] &= moved | (roots["revisits"] > revisits)
    finally:
        roots["active"], roots["scheduled"] = active, scheduled
    return count


def _walk(tree: TreeArrays, settings: SearchSettings, record: np.ndarray) -> None:
    """Take all active roots down; write their node, and the option to simulate, if any."""
    from torchrl_hmcts.planners.root_kernels import walk_on

    roots, scores = tree.roots, settings.tree_policy
    arrays = tree.nodes, tree.edges, roots, record
    assert callable(scores)
    rows = np.empty(len(roots), np.int64)
    count = walk_on(*arrays, True, rows)
    while count:
        b = rows[:count]
        n = roots["at"][b]
        edge = tree.edges[b, n]  # [d, A], a copy
        allowed = edge["closed"] != FORBIDDEN if settings.revisit else edge["closed"] == 0
        roots["choice"][b] = _best(scores, tree.nodes[b, n], edge, allowed)
        count = walk_on(*arrays, False, rows)


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
