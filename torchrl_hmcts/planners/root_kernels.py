"""Loops over the roots of a search: planted, counted from 0, and at the end of their budget."""

# numba compiles these functions; it does not read annotations as strings.
import numpy as np

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.planners.kernels import write_node
from torchrl_hmcts.planners.tree import CLOSED, MOST_VISITS, TERMINAL


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
