"""Loops for many trees: descents in step, and the whole of :func:`tree_search`."""

# numba compiles these functions; it does not read annotations as strings.
import numba
import numpy as np

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.planners.kernels import (
    append,
    arrived,
    back_up,
    best_option,
    close,
    count_plan,
    select,
)
from torchrl_hmcts.planners.tree import (
    CLOSED,
    EDGE,
    EXPANDED,
    MANY_ROOTS,
    NODE,
    PRUNED,
    RECORD,
    ROOT,
    TERMINAL,
    WAVE,
)
from torchrl_hmcts.planners.variant_kernels import (
    GOOD,
    first_bad,
    outcome,
    refresh_twins,
    wants_sample,
)

COMPILED = not numba.config.DISABLE_JIT
BLOCK = 32  # trees that go down in step: what they touch fits in the first-level cache
AHEAD = 4  # outcomes; by so many the insertion is ahead in asking for memory
_float32, _int64 = np.dtype(np.float32), np.dtype(np.int64)
_bool_, _uint8 = np.dtype(np.bool_), np.dtype(np.uint8)


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
    """Take all active roots down level by level, so that the next nodes are fetched meanwhile."""
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
                refresh_twins(tree, links, n)
            a = best_option(tree, links, root, s, gumbel, b, n, s["revisit"] > 0)
            if a < 0:
                continue
            if links[n, a]["child"] < 0 or wants_sample(links[n, a], s):
                root["choice"] = a
                continue
            child = links[n, a]["child"]
            if s["widening"] > 0.0 and tree[child]["sibling"] >= 0:
                child = outcome(tree, child)
            _prefetch_node(nodes, edges, b, child)
            root["at"] = child
            roots[first + kept]["queue"] = b
            kept += 1
        count = kept


@njit(error_model="numpy", _nrt=False)
def walk(nodes, edges, roots, record, gumbel):
    """Walk many trees down in step; return whether :func:`select` continues from there."""
    if record[0]["mark"]:
        return False
    for first in range(0, roots.shape[0], BLOCK):
        last = min(first + BLOCK, roots.shape[0])
        _walk_together(nodes, edges, roots, record[0], gumbel, first, last)
    return True


@njit(error_model="numpy", _nrt=False)
def advance(
    nodes, edges, roots, record, gumbel, wave, masks, stored, states, options, count,
    rewards, discounts, values, priors, new_states,
):  # fmt: skip
    """Insert the outcomes of ``wave[:count]`` and select the next wave; return its size.

    For searches over plain arrays: a discount of 0 is a terminal state, an option takes one base
    step, and states (bytes, flat) are copied to and from the tree's ``stored`` ones.
    """
    s = record[0]
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
    if first_bad(rewards, discounts, values, priors) != GOOD:
        raise ValueError("the transition function returned a number that is out of range")
    if count:
        arrived(nodes, edges, roots, s, wave, count)
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
        new = append(
            tree, links, root, n, a,
            rewards[i], discounts[i], 1, done, values[i] if not done else 0.0, priors, masks, i,
        )  # fmt: skip
        for k in range(size):
            stored[b, new, k] = new_states[i * size + k]
        back_up(tree, links, root, s, new)
        if rewards[i] > 0.0:
            count_plan(tree, root, new)
        if done or tree[new]["open_options"] == 0:
            close(tree, links, new)
    walked = roots.shape[0] >= MANY_ROOTS and walk(nodes, edges, roots, record, gumbel)
    count = select(nodes, edges, roots, record, gumbel, wave, walked)
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


def handle(nodes, edges, roots, record, gumbel, wave, masks, stored, states, options):
    """Where the arrays of a search are: addresses, then sizes. They must outlive it."""
    arrays = (nodes, edges, roots, record, gumbel, wave, masks, stored, states, options)
    sizes = (*edges.shape, gumbel.shape[0], gumbel.shape[1], len(wave), len(masks))
    sizes += (stored.shape[2], len(states))
    addresses = (array.ctypes.data for array in arrays)
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
        numba.carray(_pointer(at[3], RECORD), 1),
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
