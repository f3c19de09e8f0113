"""The search tree: packed records that the kernels write, seen as tensors.

Letters, here and in the rest of the package: ``B`` roots searched at once, ``N`` nodes a root has
room for, ``A`` options, ``m`` outcomes of one wave, ``F`` novelty features.

An edge is one option taken in one node. It keeps the SMDP's numbers: the reward ``R`` (discounted
sum over the option), its own discount ``D`` (``gamma ** duration``, 0 after a terminal state) and
the value ``V`` of the node it leads to; its value is ``Q = R + D * V``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorClass, TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

NODE = np.dtype(
    [
        ("visits", np.int32),
        ("in_flight", np.int32),
        ("value", np.float32),
        ("raw_value", np.float32),
        ("parent", np.int32),
        ("option", np.int32),
        ("depth", np.int32),
        ("open_options", np.int32),
        ("base_steps", np.int32),
        ("path_return", np.float32),
        ("path_discount", np.float32),
        ("flags", np.int32),
    ]
)  # 48 bytes
EDGE = np.dtype(
    [
        ("child", np.int32),
        ("visits", np.int32),
        ("in_flight", np.int32),
        ("value", np.float32),
        ("reward", np.float32),
        ("discount", np.float32),
        ("prior", np.float32),
        ("closed", np.int32),
    ]
)  # 32 bytes

# Bits of a node's flags. The compiled kernels hold their values: after changing one, delete the
# __pycache__ of this folder, since numba looks at kernels.py only.
EXPANDED = 1  # its options have been simulated
PENDING = 2  # its options are being simulated in this wave
TERMINAL = 4  # the episode ends here, by termination or truncation
PRUNED = 8  # the novelty test refused it
CLOSED = 16  # no simulation below it can add anything
REWARDED = 32  # the option that led here earned a positive reward


class TreeView(TensorClass):
    """A search tree as tensors that share the memory of the kernels' records.

    Only the first ``num_nodes[b]`` nodes of root ``b`` have a meaning. Node 0 is the root.
    """

    num_nodes: Tensor  # [B] nodes in use
    node_visits: Tensor  # [B, N] backups through a node, its own evaluation included
    node_values: Tensor  # [B, N] value V of a node
    raw_values: Tensor  # [B, N] the leaf evaluator's value of a node
    parents: Tensor  # [B, N] node above, -1 for the root
    parent_options: Tensor  # [B, N] option that led here, -1 for the root
    depths: Tensor  # [B, N] options from the root
    base_steps: Tensor  # [B, N] base steps from the root
    path_returns: Tensor  # [B, N] discounted reward collected from the root
    flags: Tensor  # [B, N] bits EXPANDED ... REWARDED of this module
    children: Tensor  # [B, N, A] node an option leads to, -1 if not simulated
    children_visits: Tensor  # [B, N, A] backups through an option
    children_values: Tensor  # [B, N, A] value V of the node an option leads to
    children_rewards: Tensor  # [B, N, A] reward R of an option
    children_discounts: Tensor  # [B, N, A] discount D of an option
    children_priors: Tensor  # [B, N, A] prior probability of an option
    states: TensorDictBase  # [B, N] what the simulator needs to go on from a node


class SearchTree:
    """The trees of ``B`` roots in preallocated arrays that grow by doubling.

    Args:
        num_roots: B.
        num_options: A.
        num_features: F, 0 without a novelty test.
        capacity: nodes per root to make room for at first.
    """

    def __init__(
        self, num_roots: int, num_options: int, num_features: int = 0, capacity: int = 64
    ) -> None:
        self.num_roots = num_roots
        self.num_options = num_options
        self.capacity = capacity
        self.nodes = np.zeros((num_roots, capacity), NODE)
        self.edges = np.zeros((num_roots, capacity, num_options), EDGE)
        self.features = np.zeros((num_roots, capacity, num_features), np.float32)
        self.num_nodes = np.zeros(num_roots, np.int64)
        self.states: TensorDictBase | None = None

    def reserve(self, num_nodes: int) -> None:
        """Make room for ``num_nodes`` nodes per root; nothing that is stored changes."""
        if num_nodes <= self.capacity:
            return
        capacity = self.capacity
        while capacity < num_nodes:
            capacity *= 2
        extra = capacity - self.capacity

        def grow(array: np.ndarray) -> np.ndarray:
            room = np.zeros((self.num_roots, extra, *array.shape[2:]), array.dtype)
            return np.concatenate((array, room), 1)

        self.nodes, self.edges = grow(self.nodes), grow(self.edges)
        self.features = grow(self.features)
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
        where = (torch.from_numpy(roots), torch.from_numpy(nodes))
        for key, value in states.items(True, True):
            self.states.get(key).index_put_(where, value)

    def get_states(
        self, roots: np.ndarray, nodes: np.ndarray, keys: Sequence[NestedKey]
    ) -> TensorDict:
        """Return the states ``[m]`` of nodes ``[m]``."""
        assert self.states is not None
        where = (torch.from_numpy(roots), torch.from_numpy(nodes))
        out = TensorDict({}, batch_size=[len(roots)], device=self.states.device)
        for key in keys:
            out.set(key, self.states.get(key)[where])
        return out

    def path(self, root: int, node: int) -> list[int]:
        """Return the nodes from the root to ``node``, both included."""
        nodes = [node]
        while self.nodes[root, nodes[-1]]["parent"] >= 0:
            nodes.append(int(self.nodes[root, nodes[-1]]["parent"]))
        return nodes[::-1]

    def options(self, root: int, node: int) -> list[int]:
        """Return the options that lead from the root to ``node``."""
        return [int(self.nodes[root, n]["option"]) for n in self.path(root, node)[1:]]

    def view(self) -> TreeView:
        """Return the trees as tensors; nothing is copied."""

        def tensor(array: np.ndarray, field: str) -> Tensor:
            return torch.from_numpy(array[field])

        nodes, edges = self.nodes, self.edges
        states = self.states
        if states is None:
            states = TensorDict({}, batch_size=[self.num_roots, self.capacity])
        return TreeView(
            num_nodes=torch.from_numpy(self.num_nodes),
            node_visits=tensor(nodes, "visits"),
            node_values=tensor(nodes, "value"),
            raw_values=tensor(nodes, "raw_value"),
            parents=tensor(nodes, "parent"),
            parent_options=tensor(nodes, "option"),
            depths=tensor(nodes, "depth"),
            base_steps=tensor(nodes, "base_steps"),
            path_returns=tensor(nodes, "path_return"),
            flags=tensor(nodes, "flags"),
            children=tensor(edges, "child"),
            children_visits=tensor(edges, "visits"),
            children_values=tensor(edges, "value"),
            children_rewards=tensor(edges, "reward"),
            children_discounts=tensor(edges, "discount"),
            children_priors=tensor(edges, "prior"),
            states=states,
            batch_size=[self.num_roots],
        )
