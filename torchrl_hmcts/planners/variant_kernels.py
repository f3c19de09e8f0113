"""What the loops of ``kernels`` call: checks of numbers, Gumbel, chance and transpositions."""

# numba compiles these functions; it does not read annotations as strings.
import math

import numba
import numpy as np

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.planners.tree import FORBIDDEN, LARGEST, MOST_SAMPLES

GOOD, MISFIT = -1, -2  # what becomes of a wave's outcomes, if not the row of one that is bad


@njit(error_model="numpy", _nrt=False)
def first_bad(rewards, discounts, values, priors):
    """The first outcome that is not finite, not below LARGEST or no probability, or GOOD."""
    for i in range(rewards.shape[0]):
        good = (abs(rewards[i]) < LARGEST) & (0.0 <= discounts[i]) & (discounts[i] <= 1.0)
        if values.shape[0]:
            good &= abs(values[i]) < LARGEST
        if priors.shape[0]:
            least, total = priors[i, 0], priors[i, 0]
            for a in range(1, priors.shape[1]):
                least = min(least, priors[i, a])
                total += priors[i, a]
            good &= (0.0 <= least) & (total < LARGEST)
        if not good:
            return i
    return GOOD


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def fits(rows, count, num_options):
    """Whether there is a row for each outcome, or none for all."""
    return (rows.shape[0] == count or rows.shape[0] == 0) and rows.shape[1] == num_options


# ------------------------------------------------------------------------------------------ Gumbel


@njit(error_model="numpy", _nrt=False)
def _log(p):
    return math.log(p) if p > 0.0 else -np.inf


@njit(error_model="numpy", _nrt=False)
def completion(nodes, edges, s, n):
    """The mixed value of a node, and the lowest value and the scale of sigma(Q) of its options."""
    visits, most, seen, weighted = 0, 0, 0.0, 0.0
    for a in range(edges.shape[-1]):
        edge = edges[n, a]
        if edge["closed"] != FORBIDDEN and edge["visits"] > 0:
            visits += edge["visits"]
            most = max(most, edge["visits"])
            prior = max(edge["prior"], 1.1754944e-38)
            seen += prior
            weighted += prior * edge["value"]
    mixed = float(nodes[n]["raw_value"])
    if visits > 0:
        mixed = (mixed + visits * weighted / seen) / (visits + 1.0)
    low, high = np.inf, -np.inf
    for a in range(edges.shape[-1]):
        edge = edges[n, a]
        value = edge["value"] if edge["visits"] > 0 else mixed
        low, high = min(low, value), max(high, value)
    return mixed, low, (s["c"] + most) * s["c_scale"] / max(high - low, 1e-8)


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def sigma(edge, mixed, low, scale):
    return scale * ((edge["value"] if edge["visits"] > 0 else mixed) - low)


@njit(error_model="numpy", _nrt=False)
def gumbel_option(nodes, edges, s, gumbel, b, n):
    num_options = edges.shape[-1]
    mixed, low, scale = completion(nodes, edges, s, n)
    total = 0
    for a in range(num_options):
        total += edges[n, a]["visits"]
    best, best_score = -1, -np.inf
    if n == 0:  # gumbel[b]: noise + log prior of every option, then the halving schedule
        last = gumbel.shape[1] - 1
        considered = gumbel[b, min(num_options + total, last)]
        for a in range(num_options):
            edge = edges[0, a]
            if edge["closed"] == FORBIDDEN or edge["visits"] != considered:
                continue
            score = gumbel[b, a] + sigma(edge, mixed, low, scale)
            if score > best_score or best < 0:
                best, best_score = a, score
        return best
    top = -np.inf
    for a in range(num_options):
        edge = edges[n, a]
        if edge["closed"] != FORBIDDEN:
            top = max(top, sigma(edge, mixed, low, scale) + _log(edge["prior"]))
    norm = 0.0
    for a in range(num_options):
        edge = edges[n, a]
        if edge["closed"] != FORBIDDEN:
            norm += math.exp(sigma(edge, mixed, low, scale) + _log(edge["prior"]) - top)
    for a in range(num_options):
        edge = edges[n, a]
        if edge["closed"] == FORBIDDEN:
            continue
        share = math.exp(sigma(edge, mixed, low, scale) + _log(edge["prior"]) - top) / norm
        score = share - edge["visits"] / (1.0 + total)
        if score > best_score:
            best, best_score = a, score
    return best


@njit(error_model="numpy", _nrt=False)
def completed_values(nodes, edges, record, b, n, out):
    """Write sigma(Q) of the options of a node, unvisited ones completed by the mixed value."""
    mixed, low, scale = completion(nodes[b], edges[b], record[0], n)
    for a in range(edges.shape[-1]):
        out[a] = sigma(edges[b, n, a], mixed, low, scale)


# --------------------------------------------------------------- several outcomes, and equal states


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def outcome(nodes, first):
    """The outcome of an option to continue from: visits follow how often each was drawn."""
    best, best_share = first, -1.0
    node = first
    while node >= 0:
        share = nodes[node]["samples"] / (1.0 + nodes[node]["visits"])
        if share > best_share:
            best, best_share = node, share
        node = nodes[node]["sibling"]
    return best


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def wants_sample(edge, s):
    """Whether progressive widening asks for one more outcome of an option that has some."""
    if s["widening"] <= 0.0 or edge["in_flight"] > 0 or edge["samples"] >= MOST_SAMPLES:
        return False
    most = s["widening"] * (edge["visits"] + 1.0) ** s["widening_exponent"]  # with this visit
    return edge["samples"] < math.ceil(most)


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def option_value(nodes, first):
    """Q of an option from its outcomes, each weighted by how often it was drawn."""
    node = nodes[first]
    if node["sibling"] < 0:
        return node["reward"] + node["discount"] * node["value"]
    total, weight = 0.0, 0
    n = first
    while n >= 0:
        node = nodes[n]
        total += node["samples"] * (node["reward"] + node["discount"] * node["value"])
        weight += node["samples"]
        n = node["sibling"]
    return total / weight


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def refresh_twins(nodes, edges, n):
    """Give the options of ``n`` that lead to a state known elsewhere the value it has there now."""
    for a in range(edges.shape[-1]):
        child = edges[n, a]["child"]
        if child >= 0 and nodes[child]["twin"] >= 0:
            node = nodes[child]
            node["value"] = nodes[node["twin"]]["value"]
            if node["sibling"] < 0:
                edges[n, a]["value"] = node["reward"] + node["discount"] * node["value"]


@njit(error_model="numpy")
def number_nodes(roots, rows):
    """The numbers that :func:`insert` will give to the nodes of a wave of roots ``rows``."""
    numbers = np.empty(rows.shape[0], np.int64)
    added = np.zeros(roots.shape[0], np.int64)
    for i in range(rows.shape[0]):
        numbers[i] = roots[rows[i]]["num_nodes"] + added[rows[i]]
        added[rows[i]] += 1
    return numbers
