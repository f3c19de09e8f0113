"""Transpositions: states that options reach by several ways are searched once.

Letters: ``m`` states, ``K`` bytes of a state.
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
        self._nodes: list[dict[bytes, int]] = [{} for _ in range(num_roots)]  # by state
        self.num_tested = self.num_found = 0

    def restart(self, root: int) -> None:
        """Forget the states of one root."""
        self._nodes[root] = {}

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
        twins = np.full(len(roots), -1, np.int64)
        for i, (root, node) in enumerate(zip(roots.tolist(), nodes.tolist(), strict=True)):
            twin = self._nodes[root].setdefault(codes[i].tobytes(), node)
            if twin != node:
                twins[i] = twin
        self.num_tested += len(roots)
        self.num_found += int((twins >= 0).sum())
        return twins

    def statistics(self) -> dict[str, int]:
        """Return how many states were looked up, and how many were known."""
        return {"transpositions_tested": self.num_tested, "transpositions_found": self.num_found}

    def __repr__(self) -> str:
        return f"Transpositions({self.in_keys})"
