"""Marks: what is equal only if all attributes of an env are, much cheaper than a pickle of them.

A walk through the attributes is slow, and needed only where one of them was replaced: as long as
all objects are the same, only the memory of arrays and generators can have changed.
"""

from __future__ import annotations

import ctypes
import marshal
from collections.abc import Callable, Sequence
from itertools import chain, compress
from operator import attrgetter, is_
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np

ATOMS: frozenset[type] = frozenset({int, float, str, bool, bytes, type(None)})
"""Kinds of values that nobody can change in place."""
_shape = attrgetter("shape")


class Seen(NamedTuple):
    """All that the layers of an env refer to, at the last look."""

    mark: bytes  # stands for it, without what is in arrays and generators
    owners: list[Any]  # whose attributes are the first of the dicts
    dicts: list[dict[Any, Any]]
    lists: list[list[Any]]
    keys: list[tuple[Any, ...]]
    sizes: list[int]
    held: list[Any]  # views of the values of the dicts, and the lists
    read: list[bool]  # which of the items in them are state
    parts: list[Any]  # these items
    memory: list[Any]  # of arrays and generators: it may change in place
    strided: list[np.ndarray]  # arrays whose memory is in pieces
    arrays: list[np.ndarray]

    def still(self) -> bool:
        """Whether all objects are the same, the contents of arrays aside."""
        return (
            all(map(is_, map(vars, self.owners), self.dicts))
            and [*map(tuple, self.dicts)] == self.keys
            and [*map(len, self.lists)] == self.sizes
            and all(map(is_, compress(chain.from_iterable(self.held), self.read), self.parts))
        )

    def contents(self) -> list[Any]:
        """What is equal only if all attributes are."""
        found: list[Any] = [self.mark, b"".join(self.memory), [*map(_shape, self.arrays)]]
        if self.strided:
            found += [array.tobytes() for array in self.strided]
        return found


def look_through(
    layers: Sequence[Any],
    read: Sequence[Sequence[bool]],
    is_state: Callable[[int, str, Any], bool],
    fixed: dict[int, int],
    packages: frozenset[str],
) -> Seen | None:
    """Walk through the attributes of all layers; None if objects are met of which nothing is known.

    ``read`` says of each attribute whether another object in its place matters, ``is_state``
    whether it is stored, by layer, name and value. ``fixed`` numbers objects that are no state by
    their id; objects of ``packages``, the env's, hold nothing but attributes.
    """
    try:
        return _Look(layers, fixed, packages).seen(read, is_state)
    except (TypeError, ValueError):
        return None


def generator_state(generator: Any) -> bytes | Any:
    """Return the state of a generator: 40 bytes for NumPy's default one, else itself."""
    if generator is None or type(generator.bit_generator) is not np.random.PCG64:
        return generator
    state = generator.bit_generator.state
    inner = state["state"]
    return (
        inner["state"].to_bytes(16, "little")
        + inner["inc"].to_bytes(16, "little")
        + state["has_uint32"].to_bytes(4, "little")
        + state["uinteger"].to_bytes(4, "little")
    )


def set_generator_state(generator: np.random.Generator, stored: bytes) -> None:
    """Put NumPy's default generator into a state of :func:`generator_state`, 40 bytes."""
    number = [int.from_bytes(stored[a:b], "little") for a, b in ((0, 16), (16, 32))]
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": number[0], "inc": number[1]},
        "has_uint32": int.from_bytes(stored[32:36], "little"),
        "uinteger": int.from_bytes(stored[36:40], "little"),
    }


def generator_memory(generator: Any) -> tuple[memoryview, memoryview] | None:
    """Return where a generator keeps its state: 32 bytes, and 8 of a number half used.

    None where it is not NumPy's default one, or keeps it in another way than NumPy has done since
    1.17: a pointer to two numbers of 128 bits, then the rest. The address is of NumPy's public
    interface, ``bit_generator.ctypes``; the bytes are compared with the public state.
    """
    bits: Any = getattr(generator, "bit_generator", None)
    if type(bits) is not np.random.PCG64:
        return None
    inside = range(id(bits), id(bits) + type(bits).__basicsize__ - 31)  # where 32 bytes begin
    at = bits.ctypes.state_address
    if at not in inside:
        return None
    pointer = ctypes.c_uint64.from_address(at).value
    if pointer not in inside:
        return None
    words = memoryview((ctypes.c_uint8 * 32).from_address(pointer)).cast("B")
    rest = memoryview((ctypes.c_uint8 * 8).from_address(at + 8)).cast("B")
    return (words, rest) if bytes(words) + bytes(rest) == generator_state(generator) else None


class _Look:
    """A walk, and what it has noted."""

    def __init__(
        self, layers: Sequence[Any], fixed: dict[int, int], packages: frozenset[str]
    ) -> None:
        self._fixed, self._packages = fixed, packages
        self._shared: dict[int, int] = {}
        self._owners = [*layers]
        self._dicts: list[dict[Any, Any]] = []  # that no owner has
        self._lists: list[list[Any]] = []
        self._memory: list[Any] = []
        self._strided: list[np.ndarray] = []
        self._arrays: list[np.ndarray] = []

    def seen(
        self, read: Sequence[Sequence[bool]], is_state: Callable[[int, str, Any], bool]
    ) -> Seen:
        marks: list[Any] = []
        for number, layer in enumerate([*self._owners]):
            own = vars(layer)
            for (name, value), matters in zip(own.items(), read[number], strict=True):
                if type(value) in ATOMS:
                    if matters:
                        marks += name, value
                elif is_state(number, name, value):
                    marks += name, self._digest(value)
            generator = own.get("_np_random")
            memory = () if generator is None else generator_memory(generator)
            if memory is None:
                raise TypeError
            self._memory += memory
            marks.append(len(memory))
        dicts: list[dict[Any, Any]] = [*[vars(owner) for owner in self._owners], *self._dicts]
        held = [*map(dict.values, dicts), *self._lists]
        flags = [*chain.from_iterable(read)]
        flags += [True] * (sum(map(len, held)) - len(flags))
        return Seen(
            marshal.dumps(marks, 2),  # the newest version that does not depend on references
            self._owners,
            dicts,
            self._lists,
            [*map(tuple, dicts)],
            [*map(len, self._lists)],
            held,
            flags,
            [*compress(chain.from_iterable(held), flags)],
            self._memory,
            self._strided,
            self._arrays,
        )

    def _digest(self, value: Any) -> Any:
        """Stands for a value; two names of one are not two."""
        kind = type(value)
        if kind in ATOMS:
            return value
        if kind is tuple and all(type(item) in ATOMS for item in value):
            return "atoms", value
        if issubclass(kind, np.generic) and value.dtype.kind not in "OV":
            return "number", value.dtype.str, value.tobytes()
        if issubclass(kind, PurePath):
            return kind.__name__, str(value)
        number = self._fixed.get(id(value))
        if number is not None:
            return "fixed", number
        number = self._shared.get(id(value))
        if number is not None:
            return "shared", number
        self._shared[id(value)] = len(self._shared)
        if kind is np.ndarray and value.dtype.kind not in "OV":
            self._arrays.append(value)
            whole = value.flags.c_contiguous and value.dtype.kind in "biufc"
            (self._memory if whole else self._strided).append(value)
            return "array", value.dtype.str
        if kind is dict:
            self._dicts.append(value)
            return ["dict", *[self._digest(x) for item in value.items() for x in item]]
        if kind is list:
            self._lists.append(value)
        if kind in (list, tuple):
            return [kind.__name__, *[self._digest(x) for x in value]]
        if kind.__module__.partition(".")[0] in self._packages and _is_open(kind):
            self._owners.append(value)
            inside = [(name, self._digest(x)) for name, x in vars(value).items()]
            return [kind.__qualname__, inside]
        raise TypeError


def _is_open(kind: Any) -> bool:
    """Whether objects of a class have nothing but attributes by name."""
    sizes = (kind.__basicsize__, kind.__dictoffset__)
    return sizes == (_Open.__basicsize__, _Open.__dictoffset__)  # type: ignore[attr-defined]


class _Open:
    pass
