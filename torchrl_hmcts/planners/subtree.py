"""Trees that are searched further: rollouts in them, reopened nodes, roots that move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_hmcts.planners.novelty import ask
from torchrl_hmcts.planners.search import Search, Wave
from torchrl_hmcts.planners.settings import SearchSettings
from torchrl_hmcts.planners.tree import PRUNED, TERMINAL, TreeArrays
from torchrl_hmcts.planners.tree_policies import CompiledPolicy


def extend(search: Search, wave: Wave) -> Wave:
    """Choose an option, by its prior, of every node that a wave has added and that continues."""
    from torchrl_hmcts.planners import root_kernels

    draws = np.empty(len(wave))
    for root in sorted(set(wave.roots.tolist())):
        if root not in search.rollouts:
            search.rollouts[root] = search.generator(root, "rollout")
        rows = wave.roots == root
        draws[rows] = search.rollouts[root].random(int(rows.sum()))
    tree, ended, further = search.tree, wave.records.copy(), wave.records.copy()
    count = root_kernels.extend(
        tree.nodes, tree.edges, tree.roots, search.record, ended, draws, further
    )
    return Wave(further[:count])


def relax(search: Search, root: int) -> bool:
    """Make the novelty test less strict for an exhausted root; return whether it opened."""
    if search.novelty is None:
        return False
    tree = search.tree
    while search.novelty.relax(root):
        flags = tree.nodes["flags"][root, : tree.num_nodes[root]]
        pruned = np.flatnonzero(flags & PRUNED)
        pruned = pruned[tree.nodes["twin"][root, pruned] < 0]
        if not len(pruned):
            return False
        _reopen(search, root, pruned)
        if not search.exhausted(np.array([root]))[0]:
            return True
    return False


def _reopen(search: Search, root: int, pruned: np.ndarray) -> None:
    """Put nodes that were refused to the novelty test again."""
    from torchrl_hmcts.planners import root_kernels

    again = np.ones(len(pruned), np.bool_)
    if search.novelty is not None:
        again = ask(search.novelty, *_tested(search.tree, root, pruned))
    for node in pruned[again]:
        root_kernels.reopen(search.tree.nodes, search.tree.edges, root, node)


def _tested(tree: TreeArrays, root: int, nodes: np.ndarray) -> tuple[np.ndarray, ...]:
    """What a novelty test is asked about nodes of one root."""
    steps = tree.nodes["base_steps"][root, nodes].astype(np.int64)
    return np.full(len(nodes), root), np.ascontiguousarray(tree.features[root, nodes]), steps


def solve(search: Search, root: int, tolerance: float = 1e-7) -> None:
    """Make the values of an exhausted tree exact, where equal states share what is known.

    With a max backup only; without transpositions they are exact already.
    """
    if search.settings.backup == "max" and search.transpositions is not None:
        from torchrl_hmcts.planners import root_kernels

        tree = search.tree
        root_kernels.solve(tree.nodes, tree.edges, tree.roots, root, tolerance, 10_000)


def reroot(search: Search, root: int, node: int) -> None:
    """Make a node the new root: its subtree stays, with all values, the rest is dropped."""
    from torchrl_hmcts.planners import root_kernels

    tree = search.tree
    if not (0 <= root < search.num_roots and 0 <= node < tree.num_nodes[root]):
        raise ValueError(f"Root {root} of {search.num_roots} has no node {node} to move to.")
    kept = np.empty(tree.num_nodes[root], np.int64)
    count = root_kernels.reroot(tree.nodes, tree.edges, tree.roots, root, node, kept)
    kept = kept[:count]
    tree.features[root, :count] = tree.features[root, kept]
    tree.codes[root, :count] = tree.codes[root, kept]
    if tree.states is not None:
        rows = tree.states[root]
        rows[:count] = rows[kept]
    flags = tree.nodes["flags"][root, :count]
    further = np.flatnonzero((flags & (PRUNED | TERMINAL)) == 0)
    pruned = np.flatnonzero((flags & PRUNED) != 0)
    if search.transpositions is not None:
        search.transpositions.restart(root)
        twins = [
            search.transpositions.find(
                np.full(len(nodes), root), np.ascontiguousarray(tree.codes[root, nodes]), nodes
            )
            for nodes in (further, pruned)
        ][1]
        tree.nodes["twin"][root, pruned] = twins
        pruned = pruned[twins < 0]
    if search.novelty is not None:
        search.novelty.restart(root)
        search.novelty.accept(*_tested(tree, root, further))
    if len(pruned):  # what refused them may be gone
        _reopen(search, root, pruned)


def find_state(
    tree: TreeArrays,
    root: int,
    nodes: Sequence[int],
    state: TensorDictBase,
    done: bool,
    keys: Sequence[NestedKey],
) -> int:
    """Return the first of the nodes that has exactly this state, or -1."""
    assert tree.states is not None
    for node in nodes:
        if bool(tree.nodes["flags"][root, node] & TERMINAL) == done and all(
            torch.equal(tree.states.get(key)[root, node], state.get(key)) for key in keys
        ):
            return node
    return -1


def find_end(
    tree: TreeArrays,
    root: int,
    path: Sequence[int],
    state: TensorDictBase,
    done: bool,
    keys: Sequence[NestedKey],
) -> int:
    """Return the outcome of the options ``path`` of a root with exactly this state, or -1."""
    reached = [0]
    for option in path:
        outcomes = [n for above in reached for n in tree.outcomes(root, option, above)]
        twins = [int(tree.nodes["twin"][root, n]) for n in outcomes]
        # Where an equal state is searched in its place.
        reached = [t if t >= 0 else n for n, t in zip(outcomes, twins, strict=True)]
    return find_state(tree, root, reached, state, done, keys)


def find_merges(
    tree: TreeArrays, wave: Wave, after: TensorDictBase, done: np.ndarray, keys: Sequence[NestedKey]
) -> np.ndarray:
    """Return known outcomes of the same option with the same state, or -1, int64 ``[m]``."""
    merges = np.full(len(wave), -1, np.int64)
    for i, (root, node, option, _) in enumerate(wave.records.tolist()):
        outcomes = tree.outcomes(root, option, node)
        if outcomes:
            merges[i] = find_state(tree, root, outcomes, after[i], bool(done[i]), keys)
    return merges


def keep_subtrees(
    search: Search,
    rows: np.ndarray,
    options: Sequence[Sequence[int]],
    states: TensorDictBase,
    done: np.ndarray,
    keys: Sequence[NestedKey],
) -> np.ndarray:
    """Move roots to where options led, if the tree holds that state; return which, bool ``[B]``."""
    kept = np.zeros(search.num_roots, np.bool_)
    for i, root in enumerate(rows.tolist()):
        path = [option for option in options[i] if option >= 0]
        if not path or search.settings.is_gumbel:  # halving starts from zero visits
            continue
        node = find_end(search.tree, root, path, states[i], bool(done[i]), keys)
        if node >= 0:
            reroot(search, root, node)
            kept[root] = True
    return kept


def check_successor(old: SearchSettings, new: SearchSettings) -> None:
    """Refuse settings with which a search that was planted with others cannot continue."""
    for name in (part.name for part in fields(old)):
        one, other = getattr(old, name), getattr(new, name)
        if name in ("leaves_per_wave", "waves_in_flight", "rollout"):
            continue
        if name == "tree_policy" and isinstance(one, CompiledPolicy):
            same = one.continues(other)
        elif name == "tree_policy":
            same = not isinstance(other, CompiledPolicy)
        else:
            same = _is_same(one, other)
        if not same:
            raise ValueError(
                f"This search was planted with {name}={one!r}; the planner now has "
                f"{name}={other!r}. What the tree holds does not fit it: plant a new one, "
                f"or resume it with a planner like the first."
            )


def _is_same(one: Any, other: Any) -> bool:
    """Whether two parts do the same; a copy of a search holds copies of them."""
    if one is other or type(one) is not type(other):
        return one is other
    return type(one).__repr__ is object.__repr__ or one == other or repr(one) == repr(other)
