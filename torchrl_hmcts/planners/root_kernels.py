"""Loops over roots: planting, budgets, rollouts, reopening, re-rooting, descents by Python."""

# numba compiles these functions; it does not read annotations as strings.
import numba
import numpy as np

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.planners.kernels import schedule, write_node
from torchrl_hmcts.planners.tree import (
    CLOSED,
    EXPANDED,
    FORBIDDEN,
    MOST_VISITS,
    PRUNED,
    REWARDED,
    TERMINAL,
)
from torchrl_hmcts.planners.variant_kernels import (
    option_value,
    outcome,
    refresh_twins,
    wants_sample,
)


@njit(error_model="numpy", _nrt=False)
def add_roots(nodes, edges, roots, rows, values, closed, priors, masks):
    """Write node 0 of the roots ``rows`` and forget all that was known of them."""
    for i in range(rows.shape[0]):
        b = rows[i]
        write_node(nodes[b], edges[b], 0, -1, -1, values[i], priors, masks, i)
        node = nodes[b, 0]
        node["reward"] = 0.0
        node["discount"] = 1.0
        node["depth"] = 0
        node["base_steps"] = 0
        node["path_return"] = 0.0
        node["path_discount"] = 1.0
        if closed[i]:
            node["flags"] |= TERMINAL
        if closed[i] or node["open_options"] == 0:
            node["flags"] |= CLOSED
        root = roots[b]
        root["num_nodes"] = 1
        root["active"] = 1
        root["best_node"] = -1
        root["best_return"] = -np.inf
        root["expansions_to_plan"] = -1
        root["base_steps_to_plan"] = -1
        root["lowest"] = np.inf
        root["highest"] = -np.inf


@njit(error_model="numpy", _nrt=False)
def limit(roots, simulations):
    """Count what is spent from 0, up to a number of simulations."""
    for b in range(roots.shape[0]):
        root = roots[b]
        root["active"] = 1
        root["limit"] = simulations
        root["simulations"] = 0
        root["revisits"] = 0
        root["expansions"] = 0
        root["base_steps"] = 0
        found = root["best_node"] >= 0
        root["expansions_to_plan"] = 0 if found else -1
        root["base_steps_to_plan"] = 0 if found else -1


@njit(error_model="numpy", _nrt=False)
def still_active(
    nodes, roots, active, expansions, base_steps, num_nodes, until_plan, improve, kept, stuck
):
    """Split the roots ``active`` into those that continue and those that are exhausted.

    Writes them to ``kept`` and ``stuck``; returns how many there are. A root whose budget is spent
    is neither.
    """
    num_kept, num_stuck = 0, 0
    for i in range(active.shape[0]):
        root = roots[active[i]]
        over = root["simulations"] >= root["limit"]
        over = over or root["expansions"] >= expansions or root["base_steps"] >= base_steps
        over = over or root["num_nodes"] >= num_nodes
        over = over or nodes[active[i], 0]["visits"] >= MOST_VISITS
        if until_plan and root["expansions_to_plan"] >= 0:
            over = over or root["expansions"] - root["expansions_to_plan"] >= improve
        if over:
            continue
        if nodes[active[i], 0]["flags"] & CLOSED:
            stuck[num_stuck] = active[i]
            num_stuck += 1
        else:
            kept[num_kept] = active[i]
            num_kept += 1
    return num_kept, num_stuck


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def is_untried(edge):
    return not edge["closed"] and edge["child"] < 0 and edge["in_flight"] == 0


@njit(error_model="numpy", _nrt=False)
def extend(nodes, edges, roots, record, ended, draws, wave):
    """Schedule an option of each new node ``ended``, by its prior; return how many there are.

    ``ended`` are records of the last wave, inserted; ``draws`` [len(ended)] in [0, 1).
    """
    s = record[0]
    count = 0
    for i in range(ended.shape[0]):
        b, n = ended[i]["root"], ended[i]["new_node"]
        root, tree, links = roots[b], nodes[b], edges[b]
        scheduled = root["scheduled"]
        for j in range(count):
            scheduled += wave[j]["root"] == b
        if tree[n]["flags"] & (TERMINAL | PRUNED | CLOSED):
            continue
        if root["simulations"] + scheduled >= root["limit"]:
            continue
        total = 0.0
        for a in range(edges.shape[-1]):
            if is_untried(links[n, a]):
                total += links[n, a]["prior"]
        left, chosen = draws[i] * total, -1
        for a in range(edges.shape[-1]):
            if is_untried(links[n, a]):
                chosen = a
                left -= links[n, a]["prior"]
                if left < 0.0:
                    break
        if chosen < 0:  # an outcome that was known before, none of whose options is untried
            continue
        if s["mark"]:
            links[n, chosen]["in_flight"] += 1
            up = n
            while tree[up]["parent"] >= 0:
                links[tree[up]["parent"], tree[up]["option"]]["in_flight"] += 1
                up = tree[up]["parent"]
        schedule(wave, count, b, n, chosen)
        count += 1
    return count


@njit(error_model="numpy", _nrt=False)
def reopen(trees, links, b, n):
    """Undo the pruning of node ``n``: it and its ancestors may be searched again."""
    nodes, edges = trees[b], links[b]
    nodes[n]["flags"] &= ~PRUNED
    nodes[n]["twin"] = -1
    if nodes[n]["open_options"] == 0:
        return
    while nodes[n]["flags"] & CLOSED:
        nodes[n]["flags"] &= ~CLOSED
        parent = nodes[n]["parent"]
        if parent < 0:
            return
        edges[parent, nodes[n]["option"]]["closed"] = 0
        nodes[parent]["open_options"] += 1
        n = parent


@njit(error_model="numpy")
def reroot(trees, links, roots, b, root, kept):
    """Make node ``root`` the root and move its subtree to the front, in place; return its size.

    The old index of every node that stays goes to ``kept``. Parents come before their children.
    """
    nodes, edges = trees[b], links[b]
    num_options = edges.shape[-1]
    moved = np.full(roots[b]["num_nodes"], -1, np.int64)
    count = 0
    for old in range(root, roots[b]["num_nodes"]):
        if old != root and (nodes[old]["parent"] < root or moved[nodes[old]["parent"]] < 0):
            continue
        moved[old] = count
        kept[count] = old
        if count != old:
            nodes[count] = nodes[old]
            for a in range(num_options):
                edges[count, a] = edges[old, a]
        count += 1
    best, best_return, first_steps = -1, -np.inf, 0
    for n in range(count):
        node = nodes[n]
        for a in range(num_options):
            child = edges[n, a]["child"]
            if child >= 0:
                edges[n, a]["child"] = moved[child]
        if node["twin"] >= 0:
            node["twin"] = moved[node["twin"]] if node["twin"] >= root else -1
        if n == 0:
            node["parent"], node["option"], node["sibling"], node["samples"] = -1, -1, -1, 1
            node["reward"], node["discount"] = 0.0, 1.0
            node["path_return"], node["path_discount"], node["depth"] = 0.0, 1.0, 0
            first_steps = node["base_steps"]
            node["base_steps"] = 0
            continue
        if node["sibling"] >= 0:
            node["sibling"] = moved[node["sibling"]]
        node["parent"] = moved[node["parent"]]
        above = nodes[node["parent"]]
        node["depth"] = above["depth"] + 1
        node["base_steps"] -= first_steps
        node["path_return"] = above["path_return"] + above["path_discount"] * node["reward"]
        node["path_discount"] = above["path_discount"] * node["discount"]
        if node["flags"] & REWARDED and node["path_return"] > best_return:
            best, best_return = n, node["path_return"]
    roots[b]["num_nodes"] = count
    roots[b]["best_node"] = best
    roots[b]["best_return"] = best_return
    roots[b]["lowest"], roots[b]["highest"] = np.inf, -np.inf
    for n in range(count):
        for a in range(num_options):
            if edges[n, a]["visits"] > 0:
                roots[b]["lowest"] = min(roots[b]["lowest"], edges[n, a]["value"])
                roots[b]["highest"] = max(roots[b]["highest"], edges[n, a]["value"])
    return count


@njit(error_model="numpy", _nrt=False)
def solve(trees, links, roots, b, tolerance, max_sweeps):
    """Sweep over a finished tree with twins until every value is that of its best option."""
    nodes, edges = trees[b], links[b]
    for _ in range(max_sweeps):
        change = 0.0
        for n in range(roots[b]["num_nodes"] - 1, -1, -1):
            if nodes[n]["twin"] >= 0:
                value = nodes[nodes[n]["twin"]]["value"]
            elif not nodes[n]["flags"] & EXPANDED:
                continue
            else:
                value = -np.inf
                for a in range(edges.shape[-1]):
                    edge = edges[n, a]
                    if edge["child"] >= 0:
                        edge["value"] = option_value(nodes, edge["child"])
                        value = max(value, edge["value"])
            change = max(change, abs(value - nodes[n]["value"]))
            nodes[n]["value"] = value
        if change <= tolerance:
            return True
    return False


# ------------------------------------------------------- for descents that are controlled by Python


@njit(error_model="numpy", _nrt=False)
def walk_on(nodes, edges, roots, record, begins, rows):
    """Go from the node of every root to what it chose; return how many have to choose again.

    Writes those to ``rows``. If the walk ``begins``, every active root with simulations left goes
    to its node 0. A root has ended where its choice is to be simulated, or -1 at a leaf.
    """
    s = record[0]
    count = 0
    for b in range(roots.shape[0]):
        root, tree, links = roots[b], nodes[b], edges[b]
        n, a = root["at"], root["choice"]
        if begins:
            n = 0
            known = tree[0]["flags"] & CLOSED
            endless = root["limit"] == np.iinfo(np.int64).max
            spent = root["simulations"] + root["scheduled"] >= root["limit"]
            walks = root["active"] and not spent
            root["queue"] = walks and (not known or (s["revisit"] > 0 and not endless))
        elif root["queue"]:
            child = links[n, a]["child"]
            if child < 0 or wants_sample(links[n, a], s):
                root["queue"] = 0
                continue
            links[n, a]["in_flight"] += 1
            n = outcome(tree, child) if tree[child]["sibling"] >= 0 else child
        else:
            continue
        root["at"], root["choice"] = n, -1
        flags = tree[n]["flags"]
        if flags & (TERMINAL | PRUNED):
            root["queue"] = 0
        elif s["expand_all"] and not flags & EXPANDED and tree[n]["open_options"] > 0:
            root["queue"] = 0
        if not root["queue"]:
            continue
        if s["twins"]:
            refresh_twins(tree, links, n)
        root["queue"] = 0
        for option in range(edges.shape[-1]):
            closed = links[n, option]["closed"]
            if not closed or (s["revisit"] > 0 and closed != FORBIDDEN):
                root["queue"] = 1
        if root["queue"]:
            rows[count] = b
            count += 1
    return count
