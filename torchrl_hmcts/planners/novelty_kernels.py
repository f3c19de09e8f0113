"""The inner loops of the novelty tests, compiled by numba; they stop where they need more room.

Letters: ``B`` roots, ``m`` states to test, ``F`` features, ``C`` states a root has room for.
"""

# numba compiles these functions; it does not read annotations as strings.
import math

import numpy as np

from torchrl_hmcts.compiling import njit

# What the radius test knows of a root.
RADIUS_ROOT = np.dtype(
    [
        ("count", np.int64),  # accepted states
        ("radius", np.float64),
        ("cell", np.float64),  # edge of the grid's cells, 0: there is no grid
        ("axis0", np.int64),  # features that span the grid, at most 3; -1 for none
        ("axis1", np.int64),
        ("axis2", np.int64),
    ],
    align=True,
)

# Up to here a scan of all accepted states is faster than a grid.
_SMALL = 48
# Cells further out than this share one; it keeps products of the hash below 2 ** 63.
_FURTHEST = 2**30
# A ball reaches this much further, so that no rounding hides a state at its edge.
_MARGIN = 1.0 + 1e-6


# ------------------------------------------------------------------------------- distant states


@njit()
def _cell(states, i, axis, edge, shift):
    """The cell of a state along a feature, if there is one, moved by ``shift``."""
    if axis < 0:
        return 0
    x = float(states[i, axis]) + shift
    return int(min(max(np.floor(x / edge), -_FURTHEST), _FURTHEST))


@njit()
def _bucket(i, j, k, num_buckets):
    mixed = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791)
    return (((mixed & 0x7FFFFFFF) * 2654435761) >> 16) & (num_buckets - 1)


@njit()
def _is_finite(states, i):
    for f in range(states.shape[1]):
        if not math.isfinite(states[i, f]):
            return False
    return True


@njit()
def _link(seen, links, heads, root, b, j):
    """Put accepted state ``j`` into its cell; one that is not finite is near none."""
    if not _is_finite(seen[b], j):
        return
    edge = root["cell"]
    bucket = _bucket(
        _cell(seen[b], j, root["axis0"], edge, 0.0),
        _cell(seen[b], j, root["axis1"], edge, 0.0),
        _cell(seen[b], j, root["axis2"], edge, 0.0),
        heads.shape[1],
    )
    links[b, j] = heads[b, bucket]
    heads[b, bucket] = j


@njit()
def _choose_axes(seen, root, b):
    """Span the grid by the three features that vary most; a distance in them is a lower bound."""
    num_features = seen.shape[2]
    root["axis0"] = 0 if num_features > 0 else -1
    root["axis1"] = 1 if num_features > 1 else -1
    root["axis2"] = 2 if num_features > 2 else -1
    if num_features <= 3:
        return
    variance = np.zeros(num_features)
    for f in range(num_features):
        total, squares, count = 0.0, 0.0, 0
        first = 0.0
        for j in range(root["count"]):
            value = float(seen[b, j, f])
            if math.isfinite(value):
                first = value if count == 0 else first
                total += value - first
                squares += (value - first) * (value - first)
                count += 1
        if count:
            variance[f] = squares / count - (total / count) * (total / count)
    order = np.argsort(-variance)
    root["axis0"], root["axis1"], root["axis2"] = order[0], order[1], order[2]


@njit()
def _build_grid(seen, links, heads, root, b):
    """Sort the accepted states of a root into cells twice as wide as its radius."""
    root["cell"] = 2.0 * root["radius"]
    _choose_axes(seen, root, b)
    heads[b, :] = -1
    for j in range(root["count"]):
        _link(seen, links, heads, root, b, j)


@njit()
def _is_near(features, i, seen, b, j, limit):
    distance = 0.0
    for f in range(features.shape[1]):
        delta = float(features[i, f]) - float(seen[b, j, f])
        distance += delta * delta
    return distance < limit


@njit()
def _fewest_nearby(seen, seen_steps, links, heads, root, b, features, i, any_is_enough):
    """The fewest base steps of the accepted states within the radius, -1 if there is none."""
    limit = root["radius"] * root["radius"]
    fewest = -1
    if root["cell"] == 0.0:
        count = root["count"]
        for j in range(count):
            if _is_near(features, i, seen, b, j, limit):
                if fewest < 0 or seen_steps[b, j] < fewest:
                    fewest = seen_steps[b, j]
                if any_is_enough:
                    return fewest
        return fewest
    if not _is_finite(features, i):
        return fewest
    reach, edge = root["radius"] * _MARGIN, root["cell"]
    axis0, axis1, axis2 = root["axis0"], root["axis1"], root["axis2"]
    low0, high0 = _cell(features, i, axis0, edge, -reach), _cell(features, i, axis0, edge, reach)
    low1, high1 = _cell(features, i, axis1, edge, -reach), _cell(features, i, axis1, edge, reach)
    low2, high2 = _cell(features, i, axis2, edge, -reach), _cell(features, i, axis2, edge, reach)
    for x0 in range(low0, high0 + 1):
        for x1 in range(low1, high1 + 1):
            for x2 in range(low2, high2 + 1):
                j = heads[b, _bucket(x0, x1, x2, heads.shape[1])]
                while j >= 0:
                    if _is_near(features, i, seen, b, j, limit):
                        if fewest < 0 or seen_steps[b, j] < fewest:
                            fewest = seen_steps[b, j]
                        if any_is_enough:
                            return fewest
                    j = links[b, j]
    return fewest


@njit()
def accept_distant(
    seen, seen_steps, links, heads, known, tally, shorter_paths, roots, features, base_steps,
    accepted, first,
):  # fmt: skip
    """Accept, in order, the states outside the radius of every accepted one; return how far.

    States of a root lie in a hash grid: ``heads [B, buckets]`` is the last state of a bucket,
    ``links [B, C]`` the one before it. ``tally``: states refused, and accepted for a shorter path.
    """
    for i in range(first, roots.shape[0]):
        b = roots[i]
        root = known[b]
        if root["count"] == seen.shape[1]:
            return i
        if root["count"] >= _SMALL and not 0.0 < root["cell"] <= 4.0 * root["radius"]:
            _build_grid(seen, links, heads, root, b)
        fewest = _fewest_nearby(
            seen, seen_steps, links, heads, root, b, features, i, not shorter_paths
        )
        novel = fewest < 0
        if not novel and shorter_paths and base_steps[i] < fewest:
            novel = True
            tally[1] += 1
        accepted[i] = novel
        if novel:
            j = root["count"]
            for f in range(features.shape[1]):
                seen[b, j, f] = features[i, f]
            seen_steps[b, j] = base_steps[i]
            root["count"] += 1
            if root["cell"] > 0.0:
                _link(seen, links, heads, root, b, j)
        else:
            tally[0] += 1
    return roots.shape[0]


# ------------------------------------------------------------------------------------ new values


@njit()
def _slot(values, owners, b, f, value):
    """The slot of feature ``f`` with this value in the hash table of a root, or a free one."""
    last = owners.shape[1] - 1
    mixed = (value & 0x7FFFFFFF) ^ ((value >> 31) & 0x7FFFFFFF) ^ (f * 19349663)
    slot = (((mixed & 0x7FFFFFFF) * 2654435761) >> 16) & last
    while owners[b, slot] >= 0 and (owners[b, slot] != f or values[b, slot] != value):
        slot = (slot + 1) & last
    return slot


@njit()
def accept_new(
    values, owners, counts, used, limits, compared, tally, slots, roots, features, base_steps,
    accepted, first,
):  # fmt: skip
    """Accept, in order, the states with a value that was seldom seen; return how far it came.

    The first ``compared [B]`` features count. ``values``, ``owners`` (the feature, -1 for none) and
    ``counts``, ``[B, slots]``, are a hash table of each root; ``slots [F]`` is room to work in.
    """
    num_features = features.shape[1]
    for i in range(first, roots.shape[0]):
        b = roots[i]
        if 2 * (used[b] + num_features) > owners.shape[1]:
            return i
        novel = False
        for f in range(num_features):
            slots[f] = _slot(values, owners, b, f, features[i, f])
            free = owners[b, slots[f]] < 0
            rare = free or counts[b, slots[f]] < limits[b]
            novel = novel or (rare and f < compared[b])
        accepted[i] = novel
        if novel:
            for f in range(num_features):
                slot = slots[f]
                if owners[b, slot] >= 0 and owners[b, slot] != f:  # taken a moment ago
                    slot = _slot(values, owners, b, f, features[i, f])
                if owners[b, slot] < 0:
                    owners[b, slot], values[b, slot] = f, features[i, f]
                    counts[b, slot] = 0
                    used[b] += 1
                if counts[b, slot] < 255:
                    counts[b, slot] += 1
        else:
            tally[0] += 1
    return roots.shape[0]


@njit()
def move_values(values, owners, counts, to_values, to_owners, to_counts):
    """Fill a larger hash table."""
    for b in range(owners.shape[0]):
        for slot in range(owners.shape[1]):
            if owners[b, slot] >= 0:
                to = _slot(to_values, to_owners, b, owners[b, slot], values[b, slot])
                to_values[b, to] = values[b, slot]
                to_owners[b, to] = owners[b, slot]
                to_counts[b, to] = counts[b, slot]
