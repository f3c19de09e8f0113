"""The inner loops of the search, compiled by numba: select, insert, back up, close and reopen.

All of them work in place on the records of :mod:`torchrl_hmcts.planners.tree` and cost O(depth) per
simulation. This module is imported when the first search starts, since numba takes a second to
load. Fields are read as ``record["field"]``, not ``record.field``, so that the kernels also run as
plain Python under ``NUMBA_DISABLE_JIT=1``, for a debugger.

Those that allocate nothing are compiled without reference counts (``_nrt=False``, as numba
compiles its own string functions): counting the views of arrays took a third of a descent's time.
"""

# numba compiles these functions; it does not read annotations as strings.
import math

import numba
import numpy as np

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.planners.tree import (
    CLOSED,
    EDGE,
    EXPANDED,
    FORBIDDEN,
    LARGEST,
    MOST_SAMPLES,
    MOST_VISITS,
    NODE,
    PENDING,
    PRUNED,
    REWARDED,
    ROOT,
    SOLVED,
    TERMINAL,
    WAVE,
)

COMPILED = not numba.config.DISABLE_JIT
UCT_SCORE, PUCT_SCORE, GUMBEL_SCORE = 0, 1, 2
MEAN_BACKUP, MAX_BACKUP = 0, 1
RAW_VALUES, SIBLINGS, WHOLE_TREE = 0, 1, 2

# Visits of a node up to which its mean value is updated in float32, with an error of about 1e-5.
# Beyond it the rest of the mean is kept too: changes of one part in 10 million would be lost.
FEW_VISITS = 2**16
ROUNDING = 1e-5  # by which the sum of float32 probabilities may differ from 1
FACTORS = 256  # visits of a node up to which its exploration factor is looked up
BLOCK = 32  # trees that go down in step: what they touch fits in the first-level cache
AHEAD = 4  # outcomes; by so many the insertion is ahead in asking for memory

# How a search is set up: one record instead of a dozen arguments, which cost 0.1 us each a call.
SETTINGS = np.dtype(
    [
        ("score", np.int64),
        ("c", np.float64),
        ("c_base", np.float64),  # 0: a constant c
        ("c_scale", np.float64),
        ("unvisited_value", np.float64),
        ("normalize", np.int64),
        ("backup", np.int64),
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

_float32, _int64 = np.dtype(np.float32), np.dtype(np.int64)
_bool_, _uint8 = np.dtype(np.bool_), np.dtype(np.uint8)

# What a descent comes to.
_ALL_OPTIONS, _ONE_OPTION, _KNOWN_LEAF, _COLLISION = 0, 1, 2, 3
# Landings of one call on leaves that need no simulation, after which closed options are skipped.
_MAX_REVISITS = 10_000


# ------------------------------------------------------------------------------ choosing an option


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
def fill_factors(settings):
    """Fill the table of :func:`exploration`, whose logarithm costs as much as an option's score."""
    s = settings[0]
    for total in range(FACTORS):
        s["factors"][total] = exploration(s, total)


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _best_option(nodes, edges, root, s, gumbel, b, n, revisit):
    """The option with the highest score; ties go to the higher prior, then the lower index."""
    num_options = edges.shape[-1]
    if s["score"] == GUMBEL_SCORE:
        return _gumbel_option(nodes, edges, s, gumbel, b, n)
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


@njit(error_model="numpy", _nrt=False)
def _log(p):
    return math.log(p) if p > 0.0 else -np.inf


@njit(error_model="numpy", _nrt=False)
def _completion(nodes, edges, s, n):
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
def _sigma(edge, mixed, low, scale):
    return scale * ((edge["value"] if edge["visits"] > 0 else mixed) - low)


@njit(error_model="numpy", _nrt=False)
def _gumbel_option(nodes, edges, s, gumbel, b, n):
    num_options = edges.shape[-1]
    mixed, low, scale = _completion(nodes, edges, s, n)
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
            score = gumbel[b, a] + _sigma(edge, mixed, low, scale)
            if score > best_score or best < 0:
                best, best_score = a, score
        return best
    top = -np.inf
    for a in range(num_options):
        edge = edges[n, a]
        if edge["closed"] != FORBIDDEN:
            top = max(top, _sigma(edge, mixed, low, scale) + _log(edge["prior"]))
    norm = 0.0
    for a in range(num_options):
        edge = edges[n, a]
        if edge["closed"] != FORBIDDEN:
            norm += math.exp(_sigma(edge, mixed, low, scale) + _log(edge["prior"]) - top)
    for a in range(num_options):
        edge = edges[n, a]
        if edge["closed"] == FORBIDDEN:
            continue
        share = math.exp(_sigma(edge, mixed, low, scale) + _log(edge["prior"]) - top) / norm
        score = share - edge["visits"] / (1.0 + total)
        if score > best_score:
            best, best_score = a, score
    return best


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _outcome(nodes, first):
    """The outcome of an option to go on from: visits follow how often each was drawn."""
    best, best_share = first, -1.0
    node = first
    while node >= 0:
        share = nodes[node]["samples"] / (1.0 + nodes[node]["visits"])
        if share > best_share:
            best, best_share = node, share
        node = nodes[node]["sibling"]
    return best


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _wants_sample(edge, s):
    """Whether progressive widening asks for one more outcome of an option that has some."""
    if s["widening"] <= 0.0 or edge["in_flight"] > 0 or edge["samples"] >= MOST_SAMPLES:
        return False
    most = s["widening"] * (edge["visits"] + 1.0) ** s["widening_exponent"]  # with this visit
    return edge["samples"] < math.ceil(most)


# ------------------------------------------------------------------------------------------ select


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _release(nodes, edges, n):
    """Take back the in-flight counts of the options from the root to node ``n``."""
    while True:
        parent = nodes[n]["parent"]
        if parent < 0:
            return
        edges[parent, nodes[n]["option"]]["in_flight"] -= 1
        n = parent


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _refresh_twins(nodes, edges, n):
    """Give the options of ``n`` that lead to a state known elsewhere the value it has there now."""
    for a in range(edges.shape[-1]):
        child = edges[n, a]["child"]
        if child >= 0 and nodes[child]["twin"] >= 0:
            node = nodes[child]
            node["value"] = nodes[node["twin"]]["value"]
            if node["sibling"] < 0:
                edges[n, a]["value"] = node["reward"] + node["discount"] * node["value"]


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
            _refresh_twins(nodes, edges, n)
        a = _best_option(nodes, edges, root, s, gumbel, b, n, revisit)
        if a < 0:
            return (_KNOWN_LEAF if revisit else _COLLISION), n, -1
        edge = edges[n, a]
        if edge["child"] < 0 or _wants_sample(edge, s):
            if edge["in_flight"] > 0:
                return _COLLISION, n, -1
            if mark:
                edge["in_flight"] += 1
            return _ONE_OPTION, n, a
        if mark:
            edge["in_flight"] += 1
        n = edge["child"]
        if nodes[n]["sibling"] >= 0:
            n = _outcome(nodes, n)


def _no_hint(intrinsic):
    """In place of a hint for processors, which plain Python cannot give."""
    return lambda record: None


@(numba.extending.intrinsic if COMPILED else _no_hint)
def _prefetch(typing_context, record):
    """Ask for the memory of a record; what it holds is needed soon."""
    from numba.core import types
    from numba.core.cgutils import ir

    def codegen(context, builder, signature, args):
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        name = "llvm.prefetch.p0i8"
        function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
        read, keep, data = number(0), number(3), number(1)
        builder.call(function, [builder.bitcast(args[0], byte), read, keep, data])
        return context.get_dummy_value()

    return types.none(record), codegen


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _prefetch_node(nodes, edges, b, n):
    """Ask for the memory of a node and of its edges; a middle edge is on one of their lines."""
    _prefetch(nodes[b, n])
    _prefetch(edges[b, n, 0])
    _prefetch(edges[b, n, edges.shape[2] - 1])


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _walk_together(nodes, edges, roots, s, gumbel, first, last):
    """Take all active roots down level by level; write their node, and the option to simulate.

    One tree after the other would wait for memory at every node; in step, the nodes of the next
    level are fetched while the other trees choose.
    """
    for b in range(first, last):
        _prefetch_node(nodes, edges, b, 0)
        roots[b]["at"] = 0
        roots[b]["choice"] = -1
        roots[b]["queue"] = b
    count = last - first
    while count > 0:
        kept = 0
        for i in range(count):
            b = roots[first + i]["queue"]
            root = roots[b]
            tree, links = nodes[b], edges[b]
            n = root["at"]
            flags = tree[n]["flags"]
            if not root["active"] or flags & (TERMINAL | PRUNED):
                continue
            if (s["expand_all"] and not flags & EXPANDED) or (n == 0 and flags & CLOSED):
                continue
            if s["twins"]:
                _refresh_twins(tree, links, n)
            a = _best_option(tree, links, root, s, gumbel, b, n, s["revisit"] > 0)
            if a < 0:
                continue
            if links[n, a]["child"] < 0 or _wants_sample(links[n, a], s):
                root["choice"] = a
                continue
            child = links[n, a]["child"]
            if s["widening"] > 0.0 and tree[child]["sibling"] >= 0:
                child = _outcome(tree, child)
            _prefetch_node(nodes, edges, b, child)
            root["at"] = child
            roots[first + kept]["queue"] = b
            kept += 1
        count = kept


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _revisit(nodes, edges, root, s, n):
    """Back the known value of leaf ``n`` up once more: a simulation without the simulator."""
    nodes[n]["visits"] += 1
    _back_up(nodes, edges, root, s, n)
    root["simulations"] += 1
    root["revisits"] += 1


@njit(error_model="numpy", _nrt=False)
def select(nodes, edges, roots, settings, gumbel, wave):
    """Descend to the leaves of every active root; return how many outcomes to simulate.

    Writes (root, node, option) triples to ``wave``. Where a root contributes several leaves,
    in-flight counts let the descents spread; :func:`insert` takes them back.
    """
    s = settings[0]
    count = 0
    num_options = edges.shape[-1]
    together = roots.shape[0] >= 64 and not s["mark"]
    if together:
        for first in range(0, roots.shape[0], BLOCK):
            _walk_together(
                nodes, edges, roots, s, gumbel, first, min(first + BLOCK, roots.shape[0])
            )
    for b in range(roots.shape[0]):
        root = roots[b]
        if not root["active"]:
            continue
        tree, links = nodes[b], edges[b]
        start, chosen = 0, -1
        if together:
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
                else:
                    met, n, a = _descend(tree, links, root, s, gumbel, b, start, revisit)
                start, chosen = 0, -1
                if met == _ALL_OPTIONS:
                    for option in range(num_options):
                        if links[n, option]["closed"] != FORBIDDEN:
                            _schedule(wave, count, b, n, option)
                            count += 1
                            scheduled += 1
                    found = True
                    break
                if met == _ONE_OPTION:
                    _schedule(wave, count, b, n, a)
                    count += 1
                    scheduled += 1
                    found = True
                    break
                if s["mark"]:
                    _release(tree, links, n)
                if met == _COLLISION or not revisit:  # e.g. a leaf that is being simulated
                    break
                if scheduled and s["widening"] > 0.0:
                    break  # what is in flight keeps options above from being drawn again
                _revisit(tree, links, root, s, n)
                revisits += 1
                if scheduled:  # it counts as a leaf: what is in flight may change the next choice
                    found = True
                    break
            if not found:
                break
    return count


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _schedule(wave, i, b, n, a):
    wave[i]["root"] = b
    wave[i]["node"] = n
    wave[i]["option"] = a


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _is_untried(edge):
    return not edge["closed"] and edge["child"] < 0 and edge["in_flight"] == 0


@njit(error_model="numpy", _nrt=False)
def extend(nodes, edges, roots, settings, ended, draws, wave):
    """Schedule an option of each new node ``ended``, by its prior; return how many there are.

    ``ended`` are records of the last wave, inserted; ``draws`` [len(ended)] in [0, 1).
    """
    s = settings[0]
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
            if _is_untried(links[n, a]):
                total += links[n, a]["prior"]
        left, chosen = draws[i] * total, -1
        for a in range(edges.shape[-1]):
            if _is_untried(links[n, a]):
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
        _schedule(wave, count, b, n, chosen)
        count += 1
    return count


@njit(error_model="numpy", _nrt=False)
def cancel(nodes, edges, settings, wave):
    """Forget a wave that was selected and will never be inserted."""
    s = settings[0]
    for i in range(wave.shape[0]):
        b, n, a = wave[i]["root"], wave[i]["node"], wave[i]["option"]
        if nodes[b, n]["flags"] & PENDING:
            nodes[b, n]["flags"] &= ~PENDING
            if s["mark"]:
                _release(nodes[b], edges[b], n)
        elif s["mark"] and edges[b, n, a]["in_flight"] > 0:
            edges[b, n, a]["in_flight"] -= 1
            _release(nodes[b], edges[b], n)


# ------------------------------------------------------------------------------------------ insert


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _write_node(nodes, edges, n, parent, option, value, priors, masks, i):
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


@njit(error_model="numpy", _nrt=False)
def add_roots(nodes, edges, roots, rows, values, closed, priors, masks):
    """Write node 0 of the roots ``rows`` and forget all that was known of them."""
    for i in range(rows.shape[0]):
        b = rows[i]
        _write_node(nodes[b], edges[b], 0, -1, -1, values[i], priors, masks, i)
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
def begin(roots, limit):
    """Count what is spent from 0, up to a number of simulations."""
    for b in range(roots.shape[0]):
        root = roots[b]
        root["active"] = 1
        root["limit"] = limit
        root["simulations"] = 0
        root["revisits"] = 0
        root["expansions"] = 0
        root["base_steps"] = 0
        found = root["best_node"] >= 0
        root["expansions_to_plan"] = 0 if found else -1
        root["base_steps_to_plan"] = 0 if found else -1


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _option_value(nodes, first):
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
def _back_up(nodes, edges, root, s, n):
    """Carry the value of node ``n`` up to its root."""
    num_options = edges.shape[-1]
    gain = nodes[n]["value"]
    while nodes[n]["parent"] >= 0:
        parent, a = nodes[n]["parent"], nodes[n]["option"]
        gain = nodes[n]["reward"] + nodes[n]["discount"] * gain
        edge = edges[parent, a]
        edge["visits"] += 1
        edge["squares"] += gain * gain
        edge["value"] = _option_value(nodes, edge["child"])
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
def _close(nodes, edges, n):
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
def _append(nodes, edges, root, n, a, reward, discount, duration, done, value, priors, masks, i):
    """Write a new node behind option ``a`` of node ``n``; return it."""
    new = root["num_nodes"]
    root["num_nodes"] += 1
    _write_node(nodes, edges, new, n, a, value, priors, masks, i)
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
def _count_plan(nodes, root, new):
    if nodes[new]["path_return"] > root["best_return"]:
        root["best_return"] = nodes[new]["path_return"]
        root["best_node"] = new
    if root["expansions_to_plan"] < 0:
        root["expansions_to_plan"] = root["expansions"]
        root["base_steps_to_plan"] = root["base_steps"]


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def _arrived(nodes, edges, roots, s, wave, count):
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
            _release(nodes[b], edges[b], n)


@njit(error_model="numpy")
def number_nodes(roots, rows):
    """The numbers that :func:`insert` will give to the nodes of a wave of roots ``rows``."""
    numbers = np.empty(rows.shape[0], np.int64)
    added = np.zeros(roots.shape[0], np.int64)
    for i in range(rows.shape[0]):
        numbers[i] = roots[rows[i]]["num_nodes"] + added[rows[i]]
        added[rows[i]] += 1
    return numbers


@njit(error_model="numpy", _nrt=False)
def insert(
    nodes,
    edges,
    roots,
    settings,
    wave,
    rewards,
    discounts,
    durations,
    done,
    novel,
    twins,
    merges,
    values,
    priors,
    masks,
):
    """Append the outcomes of a wave as nodes and back each of them up, in order.

    ``twins`` (node of the same state, or -1) and ``merges`` (outcome of the same option and state,
    or -1) may be empty.
    """
    s = settings[0]
    count = wave.shape[0]
    _arrived(nodes, edges, roots, s, wave, count)
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
            _back_up(tree, links, root, s, same)
            continue
        value = values[i]
        twin = twins[i] if twins.shape[0] else -1
        if twin >= 0:
            value = tree[twin]["value"]
        new = _append(
            tree, links, root, n, a,
            rewards[i], discounts[i], durations[i], done[i], value, priors, masks, i,
        )  # fmt: skip
        wave[i]["new_node"] = new
        node = tree[new]
        if not done[i] and (twin >= 0 or not novel[i]):
            node["flags"] |= PRUNED
            node["twin"] = twin
        _back_up(tree, links, root, s, new)
        if rewards[i] > 0.0:
            _count_plan(tree, root, new)
        closed = node["flags"] & (PRUNED | TERMINAL) or node["open_options"] == 0
        if s["widening"] <= 0.0 and closed:
            _close(tree, links, new)


@njit(error_model="numpy", _nrt=False)
def first_bad(rewards, discounts, values, priors):
    """The first outcome with a number that no search can use, or -1.

    Those are rewards and values from LARGEST on, discounts outside [0, 1], priors below 0, and what
    is not finite. ``values`` and ``priors`` may be empty.
    """
    for i in range(rewards.shape[0]):
        good = (abs(rewards[i]) < LARGEST) & (0.0 <= discounts[i]) & (discounts[i] <= 1.0)
        if values.shape[0]:
            good &= abs(values[i]) < LARGEST
        if priors.shape[0]:
            for a in range(priors.shape[1]):
                good &= (0.0 <= priors[i, a]) & (priors[i, a] < LARGEST)
        if not good:
            return i
    return -1


@njit(error_model="numpy", _nrt=False)
def advance(
    nodes, edges, roots, settings, gumbel, wave, masks, stored, states, options, count,
    rewards, discounts, values, priors, new_states,
):  # fmt: skip
    """Insert the outcomes of ``wave[:count]`` and select the next wave; return its size.

    One call per simulation for searches over plain arrays: a discount of 0 is a terminal state, an
    option takes one base step, and states (bytes, flat) are copied to and from the tree's
    ``stored`` ones. What is written to ``states`` and ``options`` is never read again.
    """
    s = settings[0]
    size = stored.shape[2]
    num_options = edges.shape[2]
    if (
        rewards.shape[0] != count
        or discounts.shape[0] != count
        or values.shape[0] != count
        or priors.shape[0] != count
        or (count > 0 and priors.shape[1] != num_options)
        or new_states.shape[0] != count * size
    ):
        raise ValueError("the transition function returned rows that do not fit the wave")
    if first_bad(rewards, discounts, values, priors) >= 0:
        raise ValueError("the transition function returned a number that is out of range")
    if count:
        _arrived(nodes, edges, roots, s, wave, count)
    for i in range(count):
        if i + AHEAD < count:
            b = wave[i + AHEAD]["root"]
            _prefetch_node(nodes, edges, b, wave[i + AHEAD]["node"])
            _prefetch_node(nodes, edges, b, roots[b]["num_nodes"])
        b, n, a = wave[i]["root"], wave[i]["node"], wave[i]["option"]
        tree, links, root = nodes[b], edges[b], roots[b]
        root["simulations"] += 1
        root["base_steps"] += 1
        done = discounts[i] == 0.0
        new = _append(
            tree, links, root, n, a,
            rewards[i], discounts[i], 1, done, values[i] if not done else 0.0, priors, masks, i,
        )  # fmt: skip
        for k in range(size):
            stored[b, new, k] = new_states[i * size + k]
        _back_up(tree, links, root, s, new)
        if rewards[i] > 0.0:
            _count_plan(tree, root, new)
        if done or tree[new]["open_options"] == 0:
            _close(tree, links, new)
    count = select(nodes, edges, roots, settings, gumbel, wave)
    for i in range(count):
        b, n = wave[i]["root"], wave[i]["node"]
        options[i] = wave[i]["option"]
        for k in range(size):
            states[i * size + k] = stored[b, n, k]
    return count


@numba.extending.intrinsic
def _pointer(typing_context, address, dtype):
    """The address as a pointer to records or numbers of a dtype."""
    from numba.core import types

    target = types.CPointer(dtype.dtype)  # type: ignore[attr-defined]

    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], context.get_value_type(target))

    return target(types.intp, dtype), codegen


def handle(nodes, edges, roots, settings, gumbel, wave, masks, stored, states, options):
    """Where the arrays of a search are: addresses, then sizes. They must outlive it."""
    arrays = (nodes, edges, roots, settings, gumbel, wave, masks, stored, states, options)
    sizes = (*edges.shape, gumbel.shape[0], gumbel.shape[1], len(wave), len(masks))
    sizes += (stored.shape[2], len(states))
    addresses = (array.__array_interface__["data"][0] for array in arrays)
    return np.array([*addresses, *sizes], np.int64)


@njit(error_model="numpy")
def advance_at(at, count, rewards, discounts, values, priors, embedding):
    """:func:`advance` with its lasting arrays behind one handle: a third of the call's cost."""
    num_roots, capacity, num_options = at[10], at[11], at[12]
    if not embedding.flags.c_contiguous:
        raise ValueError("the transition function returned an embedding that is not contiguous")
    return advance(
        numba.carray(_pointer(at[0], NODE), (num_roots, capacity)),
        numba.carray(_pointer(at[1], EDGE), (num_roots, capacity, num_options)),
        numba.carray(_pointer(at[2], ROOT), num_roots),
        numba.carray(_pointer(at[3], SETTINGS), 1),
        numba.carray(_pointer(at[4], _float32), (at[13], at[14])),
        numba.carray(_pointer(at[5], WAVE), at[15]),
        numba.carray(_pointer(at[6], _bool_), (at[16], num_options)),
        numba.carray(_pointer(at[7], _uint8), (num_roots, capacity, at[17])),
        numba.carray(_pointer(at[8], _uint8), at[18]),
        numba.carray(_pointer(at[9], _int64), at[15]),
        count,
        rewards,
        discounts,
        values,
        priors,
        numba.carray(_pointer(embedding.ctypes.data, _uint8), embedding.size * embedding.itemsize),
    )


# ------------------------------------------------------------------------- reopening and re-rooting


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
    """Make node ``root`` the root and move its subtree to the front, in place.

    Writes the old index of every node that stays to ``kept``, in their new order; returns their
    number. Parents come before their children in the records, before and after.
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
                        edge["value"] = _option_value(nodes, edge["child"])
                        value = max(value, edge["value"])
            change = max(change, abs(value - nodes[n]["value"]))
            nodes[n]["value"] = value
        if change <= tolerance:
            return True
    return False


@njit(error_model="numpy", _nrt=False)
def still_active(
    nodes, roots, active, expansions, base_steps, num_nodes, until_plan, improve, kept, stuck
):
    """Split the roots ``active`` into those that go on and those that are exhausted.

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


# ------------------------------------------------------- for descents that are controlled by Python


@njit(error_model="numpy", _nrt=False)
def release_all(nodes, edges, rows, leaves):
    for i in range(rows.shape[0]):
        _release(nodes[rows[i]], edges[rows[i]], leaves[i])


@njit(error_model="numpy", _nrt=False)
def revisit_all(nodes, edges, roots, settings, rows, leaves):
    for i in range(rows.shape[0]):
        _release(nodes[rows[i]], edges[rows[i]], leaves[i])
        b = rows[i]
        _revisit(nodes[b], edges[b], roots[b], settings[0], leaves[i])


@njit(error_model="numpy", _nrt=False)
def refresh_all(nodes, edges, rows, leaves):
    for i in range(rows.shape[0]):
        _refresh_twins(nodes[rows[i]], edges[rows[i]], leaves[i])


@njit(error_model="numpy")
def wants_samples(edges, settings, rows, leaves, options):
    wants = np.zeros(rows.shape[0], np.bool_)
    for i in range(rows.shape[0]):
        edge = edges[rows[i], leaves[i], options[i]]
        wants[i] = edge["child"] >= 0 and _wants_sample(edge, settings[0])
    return wants


@njit(error_model="numpy")
def outcomes(nodes, rows, first):
    chosen = first.copy()
    for i in range(rows.shape[0]):
        if nodes[rows[i], first[i]]["sibling"] >= 0:
            chosen[i] = _outcome(nodes[rows[i]], first[i])
    return chosen


@njit(error_model="numpy", _nrt=False)
def completed_values(nodes, edges, settings, b, n, out):
    """Write sigma(Q) of the options of a node, unvisited ones completed by the mixed value."""
    mixed, low, scale = _completion(nodes[b], edges[b], settings[0], n)
    for a in range(edges.shape[-1]):
        out[a] = _sigma(edges[b, n, a], mixed, low, scale)
