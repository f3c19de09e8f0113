"""The search tree: packed records that the kernels write, and the states of its nodes.

Letters, here and in the rest of the package: ``B`` roots searched at once, ``N`` nodes a root has
room for, ``A`` options, ``m`` outcomes of one wave, ``F`` novelty features.

An edge is one option taken in one node, a node is one outcome of it, with the reward ``R``, the
discount ``D`` (``gamma ** duration``, 0 after a terminal state) and its value ``V``. The edge's
value is ``Q = R + D * V``, the mean over several outcomes, which are linked by ``sibling``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.direct_calls import entry

NODE = np.dtype(
    [
        ("visits", np.int32),
        ("value", np.float32),
        ("rest", np.float32),  # what float32 cannot hold of a mean over very many visits
        ("raw_value", np.float32),
        ("reward", np.float32),
        ("discount", np.float32),
        ("parent", np.int32),
        ("option", np.int32),
        ("sibling", np.int32),
        ("samples", np.int16),
        ("flags", np.int16),
        ("twin", np.int32),
        ("depth", np.int32),
        ("open_options", np.int32),
        ("base_steps", np.int32),
        ("path_return", np.float32),
        ("path_discount", np.float32),
    ],
    align=True,
)  # 64 bytes, a cache line
EDGE = np.dtype(
    [
        ("child", np.int32),
        ("visits", np.int32),
        ("value", np.float32),
        ("prior", np.float32),
        ("squares", np.float32),
        ("samples", np.uint16),
        ("in_flight", np.uint8),
        ("closed", np.uint8),
    ],
    align=True,
)  # 24 bytes
ROOT = np.dtype(
    [
        ("num_nodes", np.int64),
        ("active", np.int64),
        ("simulations", np.int64),
        ("limit", np.int64),
        ("scheduled", np.int64),  # simulations of waves that are detached and not yet inserted
        ("revisits", np.int64),
        ("expansions", np.int64),
        ("base_steps", np.int64),
        ("best_node", np.int64),
        ("best_return", np.float64),
        ("expansions_to_plan", np.int64),
        ("base_steps_to_plan", np.int64),
        ("lowest", np.float64),
        ("highest", np.float64),
        ("at", np.int64),  # the descent: the node reached, the option chosen there, ...
        ("choice", np.int64),
        ("queue", np.int64),  # ... and, in row i, the i-th root that is still going down
    ],
    align=True,
)
WAVE = np.dtype(
    [("root", np.int64), ("node", np.int64), ("option", np.int64), ("new_node", np.int64)],
    align=True,
)
MANY_ROOTS = 64  # from which on trees are walked down in step
FACTORS = 256  # visits of a node up to which its exploration factor is looked up
# What the kernels read of a search's settings: one record instead of a dozen arguments, which cost
# 0.1 us each a call.
RECORD = np.dtype(
    [
        ("score", np.int64),  # UCT_SCORE ... PYTHON_SCORE
        ("c", np.float64),
        ("c_base", np.float64),  # 0: a constant c
        ("c_scale", np.float64),
        ("unvisited_value", np.float64),
        ("normalize", np.int64),  # RAW_VALUES ... WHOLE_TREE
        ("backup", np.int64),  # MEAN_BACKUP or MAX_BACKUP
        ("expand_all", np.int64),
        ("leaves", np.int64),
        ("mark", np.int64),  # whether options on the way down are marked as in flight
        ("revisit", np.int64),
        ("twins", np.int64),
        ("widening", np.float64),  # 0: one outcome per option
        ("widening_exponent", np.float64),
        ("factors", np.float64, FACTORS),
    ],
    align=True,
)
UCT_SCORE, PUCT_SCORE, GUMBEL_SCORE, PYTHON_SCORE = 0, 1, 2, 3
RAW_VALUES, SIBLINGS, WHOLE_TREE = 0, 1, 2
MEAN_BACKUP, MAX_BACKUP = 0, 1

# Bits of a node's flags.
EXPANDED = 1  # its options have been simulated
PENDING = 2  # its options are being simulated
TERMINAL = 4  # the episode ends here, by termination or truncation
PRUNED = 8  # the novelty test refused it
CLOSED = 16  # no simulation below it can add anything
REWARDED = 32  # the option that led here earned a positive reward

# Nodes, base steps of a path and visits of one root are int32. A planner's search ends at
# MOST_VISITS: what one wave adds to them does not wrap.
MOST_NODES = MOST_BASE_STEPS = np.iinfo(np.int32).max
MOST_VISITS = MOST_NODES - 2**24
MOST_SAMPLES = np.iinfo(np.int16).max  # outcomes drawn of one option
# Rewards and values are smaller than this: no sum of them along a path overflows in float32.
LARGEST = 1e30
_MOST_EDGES = 2**48

# An edge's ``closed``: 0, or one of these.
SOLVED = 1  # nothing is left to simulate behind it
FORBIDDEN = 2  # the mask does not allow the option


class TreeArrays:
    """The arrays of a :class:`SearchTree`, without its views."""

    draw_map: Callable[[Any, TensorDictBase], None] | None = None  # of the env that is searched

    def __init__(self, num_roots: int, num_options: int, capacity: int = 64) -> None:
        self.num_roots = whole_number("A search", "num_roots", num_roots)
        self.num_options = whole_number("A search", "num_options", num_options, least=1)
        self.capacity = whole_number("A search", "capacity", capacity, least=1)
        if self.num_roots * self.num_options * self.capacity > _MOST_EDGES:
            raise ValueError(
                f"A search of num_roots={num_roots} with num_options={num_options} and room for "
                f"capacity={capacity} nodes each is too large for any memory."
            )
        self.nodes = np.zeros((num_roots, capacity), NODE)
        self.edges = np.zeros((num_roots, capacity, num_options), EDGE)
        self.roots = np.zeros(num_roots, ROOT)
        # [B, N, F] of the novelty test, and [B, N, K] states as bytes; empty without their reader
        self.features = np.zeros((num_roots, capacity, 0), np.float32)
        self.codes = np.zeros((num_roots, capacity, 0), np.uint8)
        self.states: TensorDictBase | None = None
        self._flat: tuple[TensorDictBase, dict[NestedKey, Any]] | None = None

    def __getstate__(self) -> dict[str, Any]:  # a copy of the columns would not share memory
        return {**self.__dict__, "_flat": None, "draw_map": None}

    @property
    def num_nodes(self) -> np.ndarray:
        """Nodes in use, int64 ``[B]``."""
        return self.roots["num_nodes"]

    def reserve(self, num_nodes: int) -> None:
        """Make room for ``num_nodes`` nodes per root; nothing that is stored changes."""
        if num_nodes <= self.capacity:
            return
        if num_nodes > MOST_NODES:
            raise ValueError(
                f"A tree has at most {MOST_NODES:,} nodes; this search asks for {num_nodes:,}. "
                f"Limit it, e.g. by SearchBudget(nodes=...)."
            )
        capacity = self.capacity
        while capacity < num_nodes:
            capacity = min(2 * capacity, MOST_NODES)
        extra = capacity - self.capacity

        def grow(array: np.ndarray) -> np.ndarray:
            room = np.zeros((self.num_roots, extra, *array.shape[2:]), array.dtype)
            return np.concatenate((array, room), 1)

        self.nodes, self.edges = grow(self.nodes), grow(self.edges)
        self.features, self.codes = grow(self.features), grow(self.codes)
        if self.states is not None:
            room = self.states[:, :1].expand(self.num_roots, extra).clone()
            self.states = torch.cat((self.states, room), 1)
        self.capacity = capacity

    def set_states(self, roots: np.ndarray, nodes: np.ndarray, states: TensorDictBase) -> None:
        """Store the states ``[m]`` of nodes ``[m]``."""
        if self.states is None:
            shape = (self.num_roots, self.capacity)
            self.states = TensorDict(
                {
                    key: value.new_zeros((*shape, *value.shape[1:]))
                    for key, value in states.items(True, True)
                },
                batch_size=shape,
                device=states.device,
            )
        rows = roots * self.capacity + nodes
        for key, column in self._columns().items():
            value: Any = entry(states, key)
            if isinstance(column, np.ndarray):
                column[rows] = value.detach().numpy()
            else:
                column.index_copy_(0, torch.from_numpy(rows).to(column.device), value)

    def get_states(
        self, roots: np.ndarray, nodes: np.ndarray, keys: Sequence[NestedKey]
    ) -> TensorDict:
        """Return the states ``[m]`` of nodes ``[m]``."""
        assert self.states is not None
        rows, columns = roots * self.capacity + nodes, self._columns()
        entries = {}
        for key in keys:
            column = columns[key]
            if isinstance(column, np.ndarray):
                entries[key] = torch.from_numpy(column[rows])
            else:
                entries[key] = column.index_select(0, torch.from_numpy(rows).to(column.device))
        size = torch.Size([len(roots)])
        if all(isinstance(key, str) for key in keys):  # the constructor's checks cost more
            return TensorDict._new_unsafe(entries, size, device=self.states.device)
        return TensorDict(entries, size, device=self.states.device)

    def _columns(self) -> dict[NestedKey, Tensor | np.ndarray]:
        """The states' entries ``[B * N, ...]``; NumPy arrays are indexed at half the cost."""
        if self._flat is None or self._flat[0] is not self.states:
            assert self.states is not None
            columns: dict[NestedKey, Tensor | np.ndarray] = {}
            for key, value in self.states.items(True, True):
                flat = value.flatten(0, 1)
                plain = flat.device.type == "cpu" and flat.dtype != torch.bfloat16
                columns[key] = flat.numpy() if plain else flat
            self._flat = (self.states, columns)
        return self._flat[1]

    def remember(
        self,
        roots: np.ndarray,
        nodes: np.ndarray,
        features: np.ndarray | None,
        codes: np.ndarray | None,
    ) -> None:
        """Store what novelty tests and transpositions read of nodes, for when they forget it."""
        if features is not None:
            self.features[roots, nodes] = features
        if codes is not None:
            self.codes[roots, nodes] = codes

    def path(self, root: int, node: int) -> list[int]:
        """Return the nodes from the root to ``node``, both included."""
        nodes = [node]
        while self.nodes[root, nodes[-1]]["parent"] >= 0:
            nodes.append(int(self.nodes[root, nodes[-1]]["parent"]))
        return nodes[::-1]

    def options(self, root: int, node: int) -> list[int]:
        """Return the options that lead from the root to ``node``."""
        return [int(self.nodes[root, n]["option"]) for n in self.path(root, node)[1:]]

    def outcomes(self, root: int, option: int, node: int = 0) -> list[int]:
        """Return the nodes that an option of a node, the root by default, has led to."""
        nodes, child = [], int(self.edges["child"][root, node, option])
        while child >= 0:
            nodes.append(child)
            child = int(self.nodes["sibling"][root, child])
        return nodes
