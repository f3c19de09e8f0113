"""The inner loops of the search, compiled by numba: select, insert, back up, close and reopen.

All of them work in place on the records of :mod:`torchrl_hmcts.planners.tree` and cost O(depth) per
simulation. This module is imported when the first search starts, since numba takes a second to
load. Fields are read as ``record["field"]``, not ``record.field``, so that the kernels also run as
plain Python under ``NUMBA_DISABLE_JIT=1``, for a debugger.
"""

# numba compiles these functions; it does not read annotations as strings.
import math

import numba
import numpy as np

from torchrl_hmcts.planners.tree import CLOSED, EXPANDED, PENDING, PRUNED, REWARDED, TERMINAL

UCT_SCORE, PUCT_SCORE = 0, 1
MEAN_BACKUP, MAX_BACKUP = 0, 1


@numba.njit(cache=True)
def _best_option(nodes, edges, b, n, score, c, unvisited_value):
    """The open option with the highest score; ties go to the higher prior, then the lower index."""
    num_options = edges.shape[2]
    visits = nodes[b, n]["visits"] + nodes[b, n]["in_flight"] - 1  # without this very descent
    total = 0
    if score == PUCT_SCORE:
        for a in range(num_options):
            total += edges[b, n, a]["visits"] + edges[b, n, a]["in_flight"]
    log_visits = math.log(visits) if visits > 1 else 0.0
    best, best_score, best_prior = -1, -np.inf, -np.inf
    for a in range(num_options):
        edge = edges[b, n, a]
        if edge["closed"]:
            continue
        tried = edge["visits"] + edge["in_flight"]
        if edge["visits"] > 0:
            q = edge["reward"] + edge["discount"] * edge["value"]
        else:
            q = unvisited_value
        if score == PUCT_SCORE:
            value = q + c * edge["prior"] * math.sqrt(total) / (1.0 + tried)
        elif tried == 0:
            value = np.inf
        else:
            value = q + c * math.sqrt(log_visits / tried)
        if value > best_score or (value == best_score and edge["prior"] > best_prior):
            best, best_score, best_prior = a, value, edge["prior"]
    return best


@numba.njit(cache=True)
def _release(nodes, edges, b, n):
    """Take back the in-flight counts from node ``n`` up to its root."""
    while True:
        nodes[b, n]["in_flight"] -= 1
        parent = nodes[b, n]["parent"]
        if parent < 0:
            return
        edges[b, parent, nodes[b, n]["option"]]["in_flight"] -= 1
        n = parent


@numba.njit(cache=True)
def select(
    nodes, edges, active, leaves, expand_all, score, c, unvisited_value, roots, leaf_nodes, options
):
    """Descend from each active root to ``leaves`` leaves; return how many outcomes to simulate.

    Writes (root, node, option) triples to ``roots``, ``leaf_nodes``, ``options``. In-flight counts
    let several descents of a wave spread; :func:`insert` takes them back.
    """
    count = 0
    num_options = edges.shape[2]
    for b in active:
        for _ in range(leaves):
            if nodes[b, 0]["flags"] & CLOSED:
                break
            n = 0
            nodes[b, n]["in_flight"] += 1
            found = False
            while True:
                flags = nodes[b, n]["flags"]
                if expand_all and not flags & EXPANDED:
                    if not flags & PENDING:
                        nodes[b, n]["flags"] |= PENDING
                        for a in range(num_options):
                            if not edges[b, n, a]["closed"]:
                                roots[count], leaf_nodes[count], options[count] = b, n, a
                                count += 1
                        found = True
                    break
                a = _best_option(nodes, edges, b, n, score, c, unvisited_value)
                if a < 0:
                    break
                edge = edges[b, n, a]
                if edge["child"] < 0:
                    if edge["in_flight"] == 0:
                        edge["in_flight"] += 1
                        roots[count], leaf_nodes[count], options[count] = b, n, a
                        count += 1
                        found = True
                    break
                edge["in_flight"] += 1
                n = edge["child"]
                nodes[b, n]["in_flight"] += 1
            if not found:  # it ran into a leaf that this wave simulates already
                _release(nodes, edges, b, n)
                break
    return count


@numba.njit(cache=True)
def add_root(nodes, edges, num_nodes, b, value, closed, priors, masks):
    """Write node 0 of root ``b``."""
    _write_node(nodes, edges, b, 0, -1, -1, value, priors, masks, b)
    nodes[b, 0]["path_discount"] = 1.0
    nodes[b, 0]["visits"] = 1
    num_nodes[b] = 1
    if closed or nodes[b, 0]["open_options"] == 0:
        nodes[b, 0]["flags"] |= CLOSED
        if closed:
            nodes[b, 0]["flags"] |= TERMINAL


@numba.njit(cache=True)
def _write_node(nodes, edges, b, n, parent, option, value, priors, masks, i):
    num_options = edges.shape[2]
    node = nodes[b, n]
    node["visits"] = 0
    node["in_flight"] = 0
    node["value"] = value
    node["raw_value"] = value
    node["parent"] = parent
    node["option"] = option
    node["flags"] = 0
    opened = 0
    for a in range(num_options):
        edge = edges[b, n, a]
        edge["child"] = -1
        edge["visits"] = 0
        edge["in_flight"] = 0
        edge["value"] = 0.0
        edge["reward"] = 0.0
        edge["discount"] = 0.0
        edge["prior"] = priors[i, a] if priors.shape[0] else 1.0 / num_options
        allowed = masks[i, a] if masks.shape[0] else True
        edge["closed"] = 0 if allowed else 1
        opened += 1 if allowed else 0
    node["open_options"] = opened


@numba.njit(cache=True)
def _back_up(nodes, edges, b, n, backup):
    """Carry the value of the new node ``n`` up to its root."""
    num_options = edges.shape[2]
    gain = nodes[b, n]["value"]
    nodes[b, n]["visits"] += 1
    while nodes[b, n]["parent"] >= 0:
        parent, a = nodes[b, n]["parent"], nodes[b, n]["option"]
        edge = edges[b, parent, a]
        edge["value"] = nodes[b, n]["value"]
        edge["visits"] += 1
        gain = edge["reward"] + edge["discount"] * gain
        node = nodes[b, parent]
        node["visits"] += 1
        if backup == MEAN_BACKUP:
            node["value"] += (gain - node["value"]) / node["visits"]
        else:
            best = -np.inf
            for other in range(num_options):
                o = edges[b, parent, other]
                if o["visits"] > 0:
                    best = max(best, o["reward"] + o["discount"] * o["value"])
            node["value"] = best
        n = parent


@numba.njit(cache=True)
def _close(nodes, edges, b, n):
    """Close node ``n`` and every ancestor whose last open option that was."""
    while True:
        nodes[b, n]["flags"] |= CLOSED
        parent = nodes[b, n]["parent"]
        if parent < 0:
            return
        edge = edges[b, parent, nodes[b, n]["option"]]
        if edge["closed"]:
            return
        edge["closed"] = 1
        nodes[b, parent]["open_options"] -= 1
        if nodes[b, parent]["open_options"] > 0:
            return
        n = parent


@numba.njit(cache=True)
def insert(
    nodes,
    edges,
    num_nodes,
    count,
    roots,
    leaf_nodes,
    options,
    rewards,
    discounts,
    durations,
    done,
    novel,
    values,
    priors,
    masks,
    expand_all,
    backup,
    new_nodes,
):
    """Append the outcomes of a wave as nodes and back each of them up, in order."""
    for i in range(count):  # in-flight counts are of the wave: gone before any value is written
        b, n, a = roots[i], leaf_nodes[i], options[i]
        if expand_all:
            if nodes[b, n]["flags"] & PENDING:
                nodes[b, n]["flags"] = (nodes[b, n]["flags"] & ~PENDING) | EXPANDED
                _release(nodes, edges, b, n)
        else:
            edges[b, n, a]["in_flight"] -= 1
            nodes[b, n]["flags"] |= EXPANDED
            _release(nodes, edges, b, n)
    for i in range(count):
        b, n, a = roots[i], leaf_nodes[i], options[i]
        new = num_nodes[b]
        num_nodes[b] += 1
        new_nodes[i] = new
        _write_node(nodes, edges, b, new, n, a, values[i], priors, masks, i)
        parent, node, edge = nodes[b, n], nodes[b, new], edges[b, n, a]
        node["depth"] = parent["depth"] + 1
        node["base_steps"] = parent["base_steps"] + durations[i]
        node["path_return"] = parent["path_return"] + parent["path_discount"] * rewards[i]
        node["path_discount"] = parent["path_discount"] * discounts[i]
        if rewards[i] > 0.0:
            node["flags"] |= REWARDED
        edge["child"] = new
        edge["reward"] = rewards[i]
        edge["discount"] = discounts[i]
        _back_up(nodes, edges, b, new, backup)
        if done[i]:
            node["flags"] |= TERMINAL
        elif not novel[i]:
            node["flags"] |= PRUNED
        if done[i] or not novel[i] or node["open_options"] == 0:
            _close(nodes, edges, b, new)


@numba.njit(cache=True)
def reopen(nodes, edges, b, n):
    """Undo the pruning of node ``n``: it and its ancestors may be searched again."""
    nodes[b, n]["flags"] &= ~PRUNED
    while nodes[b, n]["flags"] & CLOSED:
        nodes[b, n]["flags"] &= ~CLOSED
        parent = nodes[b, n]["parent"]
        if parent < 0:
            return
        edges[b, parent, nodes[b, n]["option"]]["closed"] = 0
        nodes[b, parent]["open_options"] += 1
        n = parent


@numba.njit(cache=True)
def accept_distant(seen, num_seen, radius, roots, features, accepted):
    """Accept, in order, the features that lie outside the radius of every accepted one."""
    for i in range(roots.shape[0]):
        b = roots[i]
        limit = radius[b] * radius[b]
        novel = True
        for j in range(num_seen[b]):
            distance = 0.0
            for f in range(features.shape[1]):
                delta = features[i, f] - seen[b, j, f]
                distance += delta * delta
            if distance < limit:
                novel = False
                break
        accepted[i] = novel
        if novel:
            for f in range(features.shape[1]):
                seen[b, num_seen[b], f] = features[i, f]
            num_seen[b] += 1
