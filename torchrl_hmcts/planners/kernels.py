"""The inner loops of the search, compiled by numba, in place, at O(depth) per simulation.

They are imported when the first search begins, since numba takes a second to load.
"""

# numba compiles these functions; it does not read annotations as strings. Fields are read as
# record["field"], so that they also run as plain Python under NUMBA_DISABLE_JIT=1. What allocates
# nothing is compiled without counting references (_nrt=False): a third of a descent's time.
import math

import numba
import numpy as np

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.planners.tree import (
    CLOSED,
    EXPANDED,
    FACTORS,
    FORBIDDEN,
    GUMBEL_SCORE,
    MEAN_BACKUP,
    PENDING,
    PRUNED,
    PUCT_SCORE,
    PYTHON_SCORE,
    RAW_VALUES,
    REWARDED,
    SIBLINGS,
    SOLVED,
    TERMINAL,
    WHOLE_TREE,
)
from torchrl_hmcts.planners.variant_kernels import (
    GOOD,
    MISFIT,
    first_bad,
    fits,
    gumbel_option,
    option_value,
    outcome,
    refresh_twins,
    wants_sample,
)

# Visits of a node up to which its mean value is updated in float32, with an error of about 1e-5.
# Beyond it the rest of the mean is kept too: changes of one part in 10 million would be lost.
FEW_VISITS = 2**16
ROUNDING = 1e-5  # by which the sum of float32 probabilities may differ from 1

# What a descent comes to.
_ALL_OPTIONS, _ONE_OPTION, _KNOWN_LEAF, _COLLISION = 0, 1, 2, 3
# Landings of one call on leaves that need no simulation, after which closed options are skipped.
_MAX_REVISITS = 10_000


# ------------------------------------------------------------------------------------------ select


@njit(error_model="numpy", _nrt=False)
def exploration(s, total):
    """The part of the exploration term that all options of a node share, after ``total`` visits."""
    if s["score"] == PUCT_SCORE:
        c = s["c"]
        under_root = float(total)
        if s["c_base"] > 0.0:
            under_root += 1.0
            c += math.log((under_root + s["c_base"] + 1.0) / s["c_base"])
        return c * math.sqrt(under_root)
    return math.log(total + 1.0)


@njit(error_model="numpy", _nrt=False)
def fill_factors(record):
    """Fill the table of :func:`exploration`, whose logarithm costs as much as an option's score."""
    s = record[0]
    for total in range(FACTORS):
        s["factors"][total] = exploration(s, total)


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def best_option(nodes, edges, root, s, gumbel, b, n, revisit):
    """The option with the highest score; ties go to the higher prior, then the lower index."""
    num_options = edges.shape[-1]
    if s["score"] == GUMBEL_SCORE:
        return gumbel_option(nodes, edges, s, gumbel, b, n)
    normalize = s["normalize"]
    total = 0
    low, span = 0.0, 1.0
    if normalize == SIBLINGS:
        own = nodes[n]["value"]
        lowest, highest = own, own
        for a in range(num_options):
            edge = edges[n, a]
            visits, value = edge["visits"], edge["value"]
            total += visits + edge["in_flight"]
            value = value if visits > 0 else own
            lowest = value if value < lowest else lowest
            highest = value if value > highest else highest
        low = float(lowest)
        span = max(highest - low, 1e-8)
    else:
        for a in range(num_options):
            total += edges[n, a]["visits"] + edges[n, a]["in_flight"]
        # The only value so far counts as 0, whatever its size.
        if normalize == WHOLE_TREE and root["lowest"] <= root["highest"]:
            low = root["lowest"]
            span = max(root["highest"] - low, 1e-8)
    factors = s["factors"]
    factor = factors[total] if total < FACTORS else exploration(s, total)
    c = s["c"]
    puct = s["score"] == PUCT_SCORE
    raw = normalize == RAW_VALUES
    unvisited = s["unvisited_value"] if raw else low
    best, best_score, best_prior = -1, -np.inf, -np.inf
    for a in range(num_options):
        edge = edges[n, a]
        if edge["closed"] and (not revisit or edge["closed"] == FORBIDDEN):
            continue
        visits, q, prior = edge["visits"], float(edge["value"]), edge["prior"]
        tried = visits + edge["in_flight"]
        q = ((q if visits > 0 else unvisited) - low) / span
        if puct:
            value = q + factor * prior / (1.0 + tried)
        elif tried == 0:
            value = np.inf
        else:
            value = q + c * math.sqrt(factor / tried)
        # No branches here: which option is best is what a processor cannot predict.
        better = (value > best_score) | ((value == best_score) & (prior > best_prior))
        best = a if better else best
        best_score = value if better else best_score
        best_prior = prior if better else best_prior
    return best


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _descend(nodes, edges, root, s, gumbel, b, n, revisit):
    """Go down from node ``n``; return what was met, the node and the option to simulate."""
    mark = s["mark"]
    while True:
        flags = nodes[n]["flags"]
        if flags & (TERMINAL | PRUNED):
            return _KNOWN_LEAF, n, -1
        if s["expand_all"] and not flags & EXPANDED and nodes[n]["open_options"] > 0:
            if flags & PENDING:
                return _COLLISION, n, -1
            nodes[n]["flags"] |= PENDING
            return _ALL_OPTIONS, n, -1
        if s["twins"]:
            refresh_twins(nodes, edges, n)
        a = best_option(nodes, edges, root, s, gumbel, b, n, revisit)
        if a < 0:
            return (_KNOWN_LEAF if revisit else _COLLISION), n, -1
        edge = edges[n, a]
        if edge["child"] < 0 or wants_sample(edge, s):
            if edge["in_flight"] > 0:
                return _COLLISION, n, -1
            if mark:
                edge["in_flight"] += 1
            return _ONE_OPTION, n, a
        if mark:
            edge["in_flight"] += 1
        n = edge["child"]
        if nodes[n]["sibling"] >= 0:
            n = outcome(nodes, n)


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def release(nodes, edges, n):
    """Take back the in-flight counts of the options from the root to node ``n``."""
    while True:
        parent = nodes[n]["parent"]
        if parent < 0:
            return
        edges[parent, nodes[n]["option"]]["in_flight"] -= 1
        n = parent


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def revisit_leaf(nodes, edges, root, s, n):
    """Back the known value of leaf ``n`` up once more: a simulation without the simulator."""
    nodes[n]["visits"] += 1
    back_up(nodes, edges, root, s, n)
    root["simulations"] += 1
    root["revisits"] += 1


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def schedule(wave, i, b, n, a):
    wave[i]["root"] = b
    wave[i]["node"] = n
    wave[i]["option"] = a


@njit(error_model="numpy", _nrt=False)
def select(nodes, edges, roots, record, gumbel, wave, walked):
    """Descend to the leaves of every active root; return how many outcomes to simulate.

    In-flight counts let several descents of a root spread; :func:`insert` takes them back. If the
    trees have ``walked`` in step (:func:`batch_kernels.walk`), the first descents continue from
    there.
    """
    s = record[0]
    count = 0
    num_options = edges.shape[-1]
    for b in range(roots.shape[0]):
        root = roots[b]
        if not root["active"]:
            continue
        tree, links = nodes[b], edges[b]
        start, chosen = 0, -1
        if walked:
            start, chosen = root["at"], root["choice"]
        scheduled = root["scheduled"]
        revisits = 0
        for _ in range(s["leaves"]):
            found = False
            while root["simulations"] + scheduled < root["limit"]:
                closed = tree[0]["flags"] & CLOSED
                revisit = s["revisit"] > 0 and revisits < _MAX_REVISITS
                if closed and (not revisit or root["limit"] == np.iinfo(np.int64).max):
                    break  # nothing is left to simulate
                if chosen >= 0:
                    met, n, a = _ONE_OPTION, start, chosen
                    if links[n, a]["in_flight"] > 0:
                        met = _COLLISION
                    elif s["mark"]:
                        links[n, a]["in_flight"] += 1
                else:
                    met, n, a = _descend(tree, links, root, s, gumbel, b, start, revisit)
                start, chosen = 0, -1
                if met == _ALL_OPTIONS:
                    for option in range(num_options):
                        if links[n, option]["closed"] != FORBIDDEN:
                            schedule(wave, count, b, n, option)
                            count += 1
                            scheduled += 1
                    found = True
                    break
                if met == _ONE_OPTION:
                    schedule(wave, count, b, n, a)
                    count += 1
                    scheduled += 1
                    found = True
                    break
                if s["mark"]:
                    release(tree, links, n)
                if met == _COLLISION or not revisit:  # e.g. a leaf that is being simulated
                    break
                if scheduled and s["widening"] > 0.0:
                    break  # what is in flight keeps options above from being drawn again
                revisit_leaf(tree, links, root, s, n)
                revisits += 1
                if s["score"] == PYTHON_SCORE:
                    break
                if scheduled:  # it counts as a leaf: what is in flight may change the next choice
                    found = True
                    break
            if not found:
                break
    return count


@njit(error_model="numpy", _nrt=False)
def cancel(nodes, edges, record, wave):
    """Forget a wave that was selected and will never be inserted."""
    s = record[0]
    for i in range(wave.shape[0]):
        b, n, a = wave[i]["root"], wave[i]["node"], wave[i]["option"]
        if nodes[b, n]["flags"] & PENDING:
            nodes[b, n]["flags"] &= ~PENDING
            if s["mark"]:
                release(nodes[b], edges[b], n)
        elif s["mark"] and edges[b, n, a]["in_flight"] > 0:
            edges[b, n, a]["in_flight"] -= 1
            release(nodes[b], edges[b], n)


# ------------------------------------------------------------------------------------------ insert


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def write_node(nodes, edges, n, parent, option, value, priors, masks, i):
    num_options = edges.shape[-1]
    node = nodes[n]
    node["visits"] = 1
    node["value"] = value
    node["rest"] = 0.0
    node["raw_value"] = value
    node["parent"] = parent
    node["option"] = option
    node["sibling"] = -1
    node["samples"] = 1
    node["twin"] = -1
    node["flags"] = 0
    # Priors of the options that may be taken sum to 1; what does so already keeps its bits.
    opened, mass = num_options, 0.0
    if masks.shape[0]:
        for a in range(num_options):
            opened -= not masks[i, a]
            mass += priors[i, a] if priors.shape[0] and masks[i, a] else 0.0
    elif priors.shape[0]:
        for a in range(num_options):
            mass += priors[i, a]
    share = 1.0 / opened if opened > 0 and mass == 0.0 else 0.0
    scale = 1.0 if abs(mass - 1.0) <= ROUNDING or mass == 0.0 else 1.0 / mass
    for a in range(num_options):
        edge = edges[n, a]
        edge["child"] = -1
        edge["visits"] = 0
        edge["value"] = 0.0
        edge["prior"] = priors[i, a] * scale + share if priors.shape[0] else share
        edge["squares"] = 0.0
        edge["samples"] = 0
        edge["in_flight"] = 0
        edge["closed"] = 0
        if masks.shape[0] and not masks[i, a]:
            edge["closed"] = FORBIDDEN
            edge["prior"] = 0.0
    node["open_options"] = opened


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def append(nodes, edges, root, n, a, reward, discount, duration, done, value, priors, masks, i):
    """Write a new node behind option ``a`` of node ``n``; return it."""
    new = root["num_nodes"]
    root["num_nodes"] += 1
    write_node(nodes, edges, new, n, a, value, priors, masks, i)
    parent, node, edge = nodes[n], nodes[new], edges[n, a]
    node["reward"] = reward
    node["discount"] = discount
    node["depth"] = parent["depth"] + 1
    node["base_steps"] = parent["base_steps"] + duration
    node["path_return"] = parent["path_return"] + parent["path_discount"] * reward
    node["path_discount"] = parent["path_discount"] * discount
    if reward > 0.0:
        node["flags"] |= REWARDED
    if done:
        node["flags"] |= TERMINAL
    if edge["child"] < 0:
        edge["child"] = new
    else:  # a further outcome of the option, at the end of the chain
        last = edge["child"]
        while nodes[last]["sibling"] >= 0:
            last = nodes[last]["sibling"]
        nodes[last]["sibling"] = new
    edge["samples"] += 1
    parent["flags"] |= EXPANDED
    return new


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def back_up(nodes, edges, root, s, n):
    """Carry the value of node ``n`` up to its root."""
    num_options = edges.shape[-1]
    gain = nodes[n]["value"]
    while nodes[n]["parent"] >= 0:
        parent, a = nodes[n]["parent"], nodes[n]["option"]
        gain = nodes[n]["reward"] + nodes[n]["discount"] * gain
        edge = edges[parent, a]
        edge["visits"] += 1
        edge["squares"] += gain * gain
        edge["value"] = option_value(nodes, edge["child"])
        node = nodes[parent]
        node["visits"] += 1
        if s["backup"] == MEAN_BACKUP and node["visits"] <= FEW_VISITS:
            node["value"] += (gain - node["value"]) / node["visits"]
        elif s["backup"] == MEAN_BACKUP:
            # np.float64, since numba's float() of a float32 is one.
            mean = np.float64(node["value"]) + node["rest"]
            mean += (gain - mean) / node["visits"]
            node["value"] = mean
            node["rest"] = mean - np.float64(node["value"])
        else:
            best = -np.inf
            for other in range(num_options):
                if edges[parent, other]["visits"] > 0:
                    best = max(best, edges[parent, other]["value"])
            node["value"] = best
        if s["normalize"] == WHOLE_TREE:
            root["lowest"] = min(root["lowest"], edge["value"])
            root["highest"] = max(root["highest"], edge["value"])
        n = parent


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def close(nodes, edges, n):
    """Close node ``n`` and every ancestor whose last open option that was."""
    while True:
        nodes[n]["flags"] |= CLOSED
        parent = nodes[n]["parent"]
        if parent < 0:
            return
        edge = edges[parent, nodes[n]["option"]]
        if edge["closed"]:
            return
        edge["closed"] = SOLVED
        nodes[parent]["open_options"] -= 1
        if nodes[parent]["open_options"] > 0:
            return
        n = parent


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def count_plan(nodes, root, new):
    if nodes[new]["path_return"] > root["best_return"]:
        root["best_return"] = nodes[new]["path_return"]
        root["best_node"] = new
    if root["expansions_to_plan"] < 0:
        root["expansions_to_plan"] = root["expansions"]
        root["base_steps_to_plan"] = root["base_steps"]


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def arrived(nodes, edges, roots, s, wave, count):
    """Take back what is in flight before any value is written, and count the expansions."""
    for i in range(count):
        b, n, a = wave[i]["root"], wave[i]["node"], wave[i]["option"]
        pending = nodes[b, n]["flags"] & PENDING
        if pending:
            nodes[b, n]["flags"] &= ~PENDING
        elif s["mark"] and edges[b, n, a]["in_flight"] > 0:
            edges[b, n, a]["in_flight"] -= 1
        elif s["expand_all"] and not edges[b, n, a]["samples"]:
            continue  # another option of a node that was expanded above
        roots[b]["expansions"] += 1
        if s["mark"]:
            release(nodes[b], edges[b], n)


@njit(error_model="numpy", _nrt=False)
def insert(
    nodes, edges, roots, record, wave, rewards, discounts, durations, done, novel, twins, merges,
    values, priors, masks,
):  # fmt: skip
    """Append the outcomes of a wave as nodes and back each of them up, in order.

    ``twins`` (node of the same state, or -1) and ``merges`` (outcome of the same option and state,
    or -1) may be empty. Returns GOOD or, with nothing changed, the row of the first bad outcome or
    MISFIT.
    """
    s = record[0]
    count = wave.shape[0]
    fit = fits(priors, count, edges.shape[-1]) and fits(masks, count, edges.shape[-1])
    fit = fit and rewards.shape[0] == count and discounts.shape[0] == count
    fit = fit and durations.shape[0] == count and done.shape[0] == count
    if not fit or values.shape[0] != count:
        return MISFIT
    bad = first_bad(rewards, discounts, values, priors)
    if bad != GOOD:
        return bad
    arrived(nodes, edges, roots, s, wave, count)
    for i in range(count):
        roots[wave[i]["root"]]["base_steps"] += durations[i]
    for i in range(count):
        b, n, a = wave[i]["root"], wave[i]["node"], wave[i]["option"]
        tree, links, root = nodes[b], edges[b], roots[b]
        root["simulations"] += 1
        if merges.shape[0] and merges[i] >= 0:
            same = merges[i]
            wave[i]["new_node"] = same
            node = tree[same]
            node["samples"] += 1
            node["reward"] += (rewards[i] - node["reward"]) / node["samples"]
            node["discount"] += (discounts[i] - node["discount"]) / node["samples"]
            links[n, a]["samples"] += 1
            back_up(tree, links, root, s, same)
            continue
        value = values[i]
        twin = twins[i] if twins.shape[0] else -1
        if twin >= 0:
            value = tree[twin]["value"]
        new = append(
            tree, links, root, n, a,
            rewards[i], discounts[i], durations[i], done[i], value, priors, masks, i,
        )  # fmt: skip
        wave[i]["new_node"] = new
        node = tree[new]
        if not done[i] and (twin >= 0 or not novel[i]):
            node["flags"] |= PRUNED
            node["twin"] = twin
        back_up(tree, links, root, s, new)
        if rewards[i] > 0.0:
            count_plan(tree, root, new)
        closed = node["flags"] & (PRUNED | TERMINAL) or node["open_options"] == 0
        if s["widening"] <= 0.0 and closed:
            close(tree, links, new)
    return GOOD
