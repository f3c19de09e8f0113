"""Transpositions: states that options reach by several ways are searched once.

Letters: ``B`` roots, ``m`` states, ``K`` bytes of a state.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_hmcts.checks import nested_keys


class Transpositions:
    """Recognises a state that equals one in the tree, bit for bit.

    The second node of a state is not searched. It takes its value from the first one, its twin, at
    once and each time a descent passes. The tree becomes a graph of distinct states. It is meant
    for discrete states in a deterministic simulator; for continuous ones see
    :class:`~torchrl_hmcts.planners.RadiusNovelty`.

    Args:
        key: entry or entries that make up the state, e.g. ``"player_tile"``. Entries that count
            time make no two states equal: leave them out.

    Raises:
        ValueError: if no key is given.

    Reference:
        Childs, Brodeur and Kocsis, "Transpositions and move groups in Monte Carlo tree search",
        2008.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner, SearchBudget, Transpositions
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=6)
        >>> planner = MCTSPlanner(env, transpositions=Transpositions("state"),
        ...     budget=SearchBudget(until_plan=False))
        >>> search = planner.search(env.reset())
        >>> search.statistics()["nodes"], search.statistics()["transposed"]
        (11, 5)
    """

    def __init__(self, key: NestedKey | Sequence[NestedKey]) -> None:
        self.in_keys = nested_keys("Transpositions", "key", key)
        self.start(0)

    def start(self, num_roots: int) -> None:
        """Forget everything: ``num_roots`` searches begin."""
        self._counts = np.zeros(num_roots, np.int64)
        self._seen = np.zeros((num_roots, 0, 0), np.uint8)  # [B, room, K]
        self._nodes = np.zeros((num_roots, 0), np.int32)
        self.num_tested = 0
        self._tally = np.zeros(1, np.int64)

    def _make_room(self, num_bytes: int) -> None:
        """Allocate for the first states, or double what there is."""
        from torchrl_hmcts.planners.novelty_kernels import find_equal, link_codes

        self._find_equal = find_equal
        num_roots, old = self._nodes.shape
        shape = (num_roots, max(64, 2 * old))
        seen, nodes = np.zeros((*shape, num_bytes), np.uint8), np.zeros(shape, np.int32)
        if old:
            seen[:, :old], nodes[:, :old] = self._seen, self._nodes
        self._seen, self._nodes = seen, nodes
        self._links, self._heads = np.empty(shape, np.int32), np.empty(shape, np.int32)
        link_codes(self._seen, self._links, self._heads, self._counts)

    def restart(self, root: int) -> None:
        """Forget the states of one root."""
        self._counts[root] = 0
        if self._seen.shape[1]:
            self._heads[root] = -1

    def codes(self, tensordict: TensorDictBase) -> np.ndarray:
        """Return the states as bytes, uint8 ``[m, K]``."""
        parts = []
        for key in self.in_keys:
            part = tensordict.get(key)
            part = part.reshape(len(part), part.shape[1:].numel()).contiguous().view(torch.uint8)
            parts.append(part.cpu().numpy())
        return parts[0] if len(parts) == 1 else np.concatenate(parts, -1)

    def find(self, roots: np.ndarray, codes: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return the node that holds the same state, int64 ``[m]``, or -1 where ``nodes[i]`` will.

        In order: a state that is new is remembered under its node.
        """
        if not self._seen.shape[1]:
            self._make_room(codes.shape[1])
        if codes.shape[1] != self._seen.shape[2]:
            raise ValueError(
                f"{self} has seen states of {self._seen.shape[2]} bytes; got {codes.shape[1]}. "
                f"Call start(num_roots) before looking others up."
            )
        codes = np.ascontiguousarray(codes)
        twins = np.empty(len(roots), np.int64)
        begin = 0
        while True:
            begin = self._find_equal(
                self._seen, self._nodes, self._links, self._heads, self._counts, self._tally,
                roots, codes, nodes, twins, begin,
            )  # fmt: skip
            if begin == len(roots):
                break
            self._make_room(codes.shape[1])
        self.num_tested += len(roots)
        return twins

    @property
    def num_found(self) -> int:
        """Number of the states that were looked up and known."""
        return int(self._tally[0])

    def statistics(self) -> dict[str, int]:
        """Return how many states were looked up, and how many were known."""
        return {"transpositions_tested": self.num_tested, "transpositions_found": self.num_found}

    def __repr__(self) -> str:
        return f"Transpositions({self.in_keys})"
