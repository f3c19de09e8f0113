"""The search tree for users: tensors, text, graphs and pictures of the kernels' records."""

from __future__ import annotations

import torch
from tensordict import TensorClass, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_hmcts import notebook
from torchrl_hmcts.planners import drawing, export
from torchrl_hmcts.planners.tree import TreeArrays


class TreeView(TensorClass, metaclass=notebook.KeepsDocstring):
    """A search tree as tensors that share the memory of the kernels' records.

    Only the first ``num_nodes[b]`` nodes of root ``b`` are in use. Node 0 is the root. Make a new
    view after the tree has grown.

    Attributes:
        num_nodes (Tensor): ``[B]`` nodes in use.
        node_visits (Tensor): ``[B, N]`` backups through a node, its own evaluation included.
        node_values (Tensor): ``[B, N]`` value V of a node.
        raw_values (Tensor): ``[B, N]`` the leaf evaluator's value of a node.
        rewards, discounts (Tensor): ``[B, N]`` reward R and discount D of the option that led here.
        parents, parent_options (Tensor): ``[B, N]`` node above and that option, -1 for the root.
        siblings (Tensor): ``[B, N]`` next outcome of the same option, -1 for the last.
        samples (Tensor): ``[B, N]`` how often the simulator gave this outcome.
        twins (Tensor): ``[B, N]`` node of the same state that is searched in its place, else -1.
        depths, base_steps (Tensor): ``[B, N]`` options and base steps from the root.
        path_returns (Tensor): ``[B, N]`` discounted reward collected from the root.
        flags (Tensor): ``[B, N]`` bits EXPANDED ... REWARDED of this module.
        children (Tensor): ``[B, N, A]`` first outcome of an option, -1 if not simulated.
        children_visits, children_values (Tensor): ``[B, N, A]`` backups through an option, and its
            value Q = R + D V.
        children_priors (Tensor): ``[B, N, A]`` prior probability of an option, 0 if forbidden.
        children_closed (Tensor): ``[B, N, A]`` 0 open, SOLVED or FORBIDDEN.
        states (TensorDictBase): ``[B, N]`` what the simulator needs to continue from a node.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> view = MCTSPlanner(env).search(env.reset()).tree.view()
        >>> view.children[0, 0].tolist()  # the nodes that the two options of the root led to
        [1, 2]
        >>> view.parents[0, 1:3].tolist()
        [0, 0]
    """

    num_nodes: Tensor
    node_visits: Tensor
    node_values: Tensor
    raw_values: Tensor
    rewards: Tensor
    discounts: Tensor
    parents: Tensor
    parent_options: Tensor
    siblings: Tensor
    samples: Tensor
    twins: Tensor
    depths: Tensor
    base_steps: Tensor
    path_returns: Tensor
    flags: Tensor
    children: Tensor
    children_visits: Tensor
    children_values: Tensor
    children_priors: Tensor
    children_closed: Tensor
    states: TensorDictBase


class SearchTree(TreeArrays):
    """The trees of ``B`` roots in preallocated arrays that grow by doubling.

    Args:
        num_roots: B.
        num_options: A.
        capacity: nodes per root to make room for at first.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> tree = MCTSPlanner(env).search(env.reset()).tree
        >>> tree.path(root=0, node=1), tree.path(root=0, node=2)
        ([0, 1], [0, 2])
        >>> tree.options(root=0, node=2)
        [1]
    """

    summary = export.summary
    to_networkx = export.to_networkx
    to_torchrl = export.to_torchrl
    plot = drawing.plot_tree
    plot_positions = drawing.plot_positions

    def __repr__(self) -> str:
        nodes = f"{int(self.num_nodes.sum()):,} nodes"
        return f"SearchTree({nodes}, roots={self.num_roots}, options={self.num_options})"

    def _repr_html_(self) -> str:
        text = self.summary() if self.num_roots == 1 else repr(self)
        return notebook.shown(text, lambda axes: self.plot(ax=axes, max_nodes=100), figsize=(8, 4))

    def view(self) -> TreeView:
        """Return the trees as tensors; nothing is copied."""
        states = self.states
        if states is None:
            states = TensorDict({}, batch_size=[self.num_roots, self.capacity])
        arrays = [self.roots["num_nodes"], *(self.nodes[name] for name in _OF_NODES)]
        arrays += [self.edges[name] for name in _OF_EDGES]
        tensors = dict(zip(TreeView.__annotations__, map(torch.from_numpy, arrays), strict=False))
        return TreeView(**tensors, states=states, batch_size=[self.num_roots])


# Fields of the records in the order of the view's.
_OF_NODES = (
    *("visits", "value", "raw_value", "reward", "discount", "parent", "option", "sibling"),
    *("samples", "twin", "depth", "base_steps", "path_return", "flags"),
)
_OF_EDGES = ("child", "visits", "value", "prior", "closed")
