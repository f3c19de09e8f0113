"""The search itself, on arrays: it asks for outcomes of options and grows the trees with them.

A wave is :meth:`Search.select`, the simulation of the triples it returns by whoever runs the
search, and :meth:`Search.insert`. Nothing here knows tensordicts or environments.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from torchrl_hmcts.planners.backups import Backup, MaxBackup
from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.planners.tree import CLOSED, PRUNED, REWARDED, SearchTree
from torchrl_hmcts.planners.tree_policies import PUCT, TreePolicy


class Wave(NamedTuple):
    """What to simulate next: take ``options[i]`` in node ``nodes[i]`` of root ``roots[i]``."""

    roots: np.ndarray  # [m] int64
    nodes: np.ndarray  # [m] int64
    options: np.ndarray  # [m] int64


class Outcomes(NamedTuple):
    """What came of a wave's triples."""

    rewards: np.ndarray  # [m] float32, R
    discounts: np.ndarray  # [m] float32, D: gamma ** duration, 0 after a terminal state
    durations: np.ndarray  # [m] int64, base steps
    done: np.ndarray  # [m] bool: terminated or truncated
    values: np.ndarray  # [m] float32, the leaf evaluator's
    priors: np.ndarray  # [m, A] float32, or [0, A] for uniform
    masks: np.ndarray  # [m, A] bool: options that may be taken, or [0, A] for all


class Search:
    """The trees of ``B`` roots under one tree policy, backup and novelty test.

    Args:
        num_roots: B.
        num_options: A.
        tree_policy: see :mod:`~torchrl_hmcts.planners.tree_policies`.
        backup: see :mod:`~torchrl_hmcts.planners.backups`.
        novelty: see :mod:`~torchrl_hmcts.planners.novelty`, or None.
        expand: ``"all"`` simulates every option of a leaf, ``"one"`` the option the tree policy
            chooses.
        leaves_per_wave: leaves each root contributes to a wave.
    """

    def __init__(
        self,
        num_roots: int,
        num_options: int,
        *,
        tree_policy: TreePolicy,
        backup: Backup,
        novelty: NoveltyTest | None,
        expand: Literal["all", "one"] = "all",
        leaves_per_wave: int = 1,
    ) -> None:
        from torchrl_hmcts.planners import kernels

        self._kernels = kernels
        self.tree_policy = tree_policy
        self.novelty = novelty
        self.num_options = num_options
        self.num_roots = num_roots
        self.expand_all = expand == "all"
        self.leaves_per_wave = leaves_per_wave
        is_puct = isinstance(tree_policy, PUCT)
        self._score = kernels.PUCT_SCORE if is_puct else kernels.UCT_SCORE
        self._unvisited_value = (
            tree_policy.unvisited_value if isinstance(tree_policy, PUCT) else 0.0
        )
        self._backup = kernels.MAX_BACKUP if isinstance(backup, MaxBackup) else kernels.MEAN_BACKUP
        self.tree = SearchTree(num_roots, num_options)
        self.num_expansions = np.zeros(num_roots, np.int64)
        self.num_base_steps = np.zeros(num_roots, np.int64)
        self.best_node = np.full(num_roots, -1, np.int64)  # end of the best plan so far
        self.best_return = np.full(num_roots, -np.inf)
        self.expansions_to_plan = np.full(num_roots, -1, np.int64)
        self.base_steps_to_plan = np.full(num_roots, -1, np.int64)

    def start(
        self,
        values: np.ndarray,
        done: np.ndarray,
        priors: np.ndarray,
        masks: np.ndarray,
        features: np.ndarray | None,
    ) -> None:
        """Plant the roots: values and done ``[B]``, priors and masks as in :class:`Outcomes`."""
        tree = self.tree
        if features is not None:
            assert self.novelty is not None
            tree.features = np.zeros((self.num_roots, tree.capacity, features.shape[1]), np.float32)
            tree.features[:, 0] = features
            self.novelty.start(self.num_roots)
            self.novelty.accept(np.arange(self.num_roots), features)
        for b in range(self.num_roots):
            self._kernels.add_root(
                tree.nodes, tree.edges, tree.num_nodes, b, values[b], done[b], priors, masks
            )

    def select(self, active: np.ndarray) -> Wave:
        """Choose the options to simulate for the roots ``active``; none for a closed root."""
        size = len(active) * self.leaves_per_wave * (self.num_options if self.expand_all else 1)
        roots, nodes, options = (np.empty(size, np.int64) for _ in range(3))
        tree = self.tree
        count = self._kernels.select(
            tree.nodes,
            tree.edges,
            active,
            self.leaves_per_wave,
            self.expand_all,
            self._score,
            self.tree_policy.c,
            self._unvisited_value,
            roots,
            nodes,
            options,
        )
        return Wave(roots[:count], nodes[:count], options[:count])

    def insert(self, wave: Wave, outcomes: Outcomes, features: np.ndarray | None) -> np.ndarray:
        """Append the outcomes of a wave and back them up; return their nodes, int64 ``[m]``."""
        tree, m = self.tree, len(wave.roots)
        per_root = np.bincount(wave.roots, minlength=self.num_roots)
        tree.reserve(int((tree.num_nodes + per_root).max()))
        novel = np.ones(m, np.bool_)
        if features is not None:
            assert self.novelty is not None
            open_ended = np.flatnonzero(~outcomes.done)
            novel[open_ended] = self.novelty.accept(wave.roots[open_ended], features[open_ended])
        new_nodes = np.empty(m, np.int64)
        self._kernels.insert(
            tree.nodes,
            tree.edges,
            tree.num_nodes,
            m,
            wave.roots,
            wave.nodes,
            wave.options,
            outcomes.rewards,
            outcomes.discounts,
            outcomes.durations,
            outcomes.done,
            novel,
            outcomes.values,
            outcomes.priors,
            outcomes.masks,
            self.expand_all,
            self._backup,
            new_nodes,
        )
        if features is not None:
            tree.features[wave.roots, new_nodes] = features
        self._count(wave, outcomes, new_nodes)
        return new_nodes

    def _count(self, wave: Wave, outcomes: Outcomes, new_nodes: np.ndarray) -> None:
        if self.expand_all:
            leaves = np.unique(np.stack((wave.roots, wave.nodes)), axis=1)[0]
        else:
            leaves = wave.roots
        self.num_expansions += np.bincount(leaves, minlength=self.num_roots)
        steps = np.bincount(wave.roots, weights=outcomes.durations, minlength=self.num_roots)
        self.num_base_steps += steps.astype(np.int64)
        for i in np.flatnonzero(outcomes.rewards > 0.0):
            b = wave.roots[i]
            total = self.tree.nodes[b, new_nodes[i]]["path_return"]
            if total > self.best_return[b]:
                self.best_return[b], self.best_node[b] = total, new_nodes[i]
            if self.expansions_to_plan[b] < 0:
                self.expansions_to_plan[b] = self.num_expansions[b]
                self.base_steps_to_plan[b] = self.num_base_steps[b]

    def exhausted(self, roots: np.ndarray) -> np.ndarray:
        """Return which of the roots have nothing left to simulate, bool ``[len(roots)]``."""
        return (self.tree.nodes[roots, 0]["flags"] & CLOSED) != 0

    def relax(self, root: int) -> bool:
        """Make the novelty test less strict for an exhausted root; return whether it opened."""
        if self.novelty is None:
            return False
        tree = self.tree
        while self.novelty.relax(root):
            flags = tree.nodes[root, : tree.num_nodes[root]]["flags"]
            pruned = np.flatnonzero(flags & PRUNED)
            if not len(pruned):
                return False
            again = self.novelty.accept(
                np.full(len(pruned), root), np.ascontiguousarray(tree.features[root, pruned])
            )
            for node in pruned[again]:
                if tree.nodes[root, node]["open_options"] > 0:
                    self._kernels.reopen(tree.nodes, tree.edges, root, node)
            if not self.exhausted(np.array([root]))[0]:
                return True
        return False

    def statistics(self) -> dict[str, Any]:
        """Return counts of the whole search, for logs."""
        used = np.arange(self.tree.capacity) < self.tree.num_nodes[:, None]
        flags = self.tree.nodes["flags"]
        return {
            "nodes": int(self.tree.num_nodes.sum()),
            "pruned": int(((flags & PRUNED) != 0)[used].sum()),
            "rewarded": int(((flags & REWARDED) != 0)[used].sum()),
            "expansions": int(self.num_expansions.sum()),
            "base_steps": int(self.num_base_steps.sum()),
        }
