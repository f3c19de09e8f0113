"""A snapshot of the attributes of an env and its wrappers, pickled."""

from __future__ import annotations

import io
import pickle
import struct
import types
from typing import Any, ClassVar

import gymnasium
import numpy as np

from torchrl_hmcts.envs.gym.marks import (
    ATOMS,
    Seen,
    generator_state,
    look_through,
    set_generator_state,
)
from torchrl_hmcts.envs.gym.snapshots import (
    DEFAULT_CAP,
    KNOWN_WRAPPERS,
    Snapshot,
    SnapshotError,
    env_layers,
    time_limits,
)

_FIXED_TYPES = (
    gymnasium.Env,
    gymnasium.Space,
    gymnasium.envs.registration.EnvSpec,
    types.FunctionType,
    types.MethodType,
    types.BuiltinFunctionType,
    types.ModuleType,
    type,
)
_NO_OBJECTS = frozenset({*ATOMS, list, dict, tuple, np.ndarray, np.dtype})
_FIXED, _PLAIN, _OTHER = range(3)
_REMEMBERED = 8  # states of attributes whose objects are kept


class AttributeSnapshot(Snapshot):
    """Stores the attributes of an env and its wrappers: right for any env written in Python.

    Spaces, specs, functions and what only draws are no state. Everything else is: counters,
    generators, goals, grids. An attribute that cannot be pickled is refused by name, since it may
    hold state.

    Args:
        env (gymnasium.Env): the env with its wrappers.
        cap (int): bytes of a row at most. Default 65,536.

    Raises:
        SnapshotError: if an attribute cannot be stored, or the state is wider than the cap.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("CartPole-v1")
        >>> snapshot = AttributeSnapshot(env)
        >>> _ = env.reset(seed=1)
        >>> row = snapshot.read()
        >>> snapshot.note_step(1)
        >>> first = env.step(1)[0]
        >>> snapshot.restore(row)
        >>> bool((env.step(1)[0] == first).all())
        True
    """

    skipped_attributes: ClassVar[frozenset[str]] = frozenset(
        {"spec", "metadata", "_previous_data", "render_mode"}
        | {"_saved_kwargs", "_ezpickle_args", "_ezpickle_kwargs"}  # how the env was made
    )
    plain_types: ClassVar[frozenset[type]] = ATOMS
    head: ClassVar[int] = 1  # numbers before the clocks
    drawing_modules: ClassVar[tuple[str, ...]] = ("pygame", "matplotlib", "PIL", "cv2", "moviepy")

    def __init__(self, env: gymnasium.Env, *, cap: int = DEFAULT_CAP) -> None:
        self.env = env
        env.reset(seed=0)
        layers = env_layers(env)
        self._clocks = time_limits(env)
        self._head = struct.Struct(f"{self.head}q{len(self._clocks)}q")
        self._layers = [layer for layer in layers if type(layer) not in KNOWN_WRAPPERS]
        self._fixed: list[Any] = layers  # referred to by their index, never stored
        self._index = {id(item): i for i, item in enumerate(self._fixed)}
        self._cap = cap
        modules = {kind.__module__ for layer in layers for kind in type(layer).__mro__}
        self._packages = frozenset(name.partition(".")[0] for name in modules) - _LIBRARIES
        self._kinds: list[dict[tuple[str, type], int]] = [{} for _ in self._layers]
        self._unchanged: bytes | None = None  # attributes of the env, if it took no step since
        self._known: tuple[Any, bytes] = None, b""  # a mark, and what it stands for
        self._seen: Seen | None = None
        self._recent: dict[bytes, tuple[Seen, Any, list[Any], list[Any], list[Any]]] = {}
        content = self._pickled(learning=True)
        self._unpickled(content)  # a class that is not read is named now, not in a search
        self.width = _room_for(len(content), cap, env)

    def read(self) -> np.ndarray:
        row = np.zeros(self.width, np.uint8)
        self._write(row)
        return row

    def restore(self, row: np.ndarray) -> None:
        self._load(row)

    def is_fixed(self, value: Any) -> bool:
        """Return whether an object is not state: it never changes in an instance."""
        if isinstance(value, _FIXED_TYPES):
            return True
        module = type(value).__module__
        return module.startswith(self.drawing_modules)

    # ------------------------------------------------------------------ rows

    def note_reset(self, seed: int | None) -> None:
        self._unchanged = None

    def note_step(self, action: Any) -> None:
        self._unchanged = None

    def _write(self, row: np.ndarray) -> None:
        """Writes clocks, generators and attributes into a row, or the end of one."""
        self._unchanged = content = self._pickled()
        begin = self._head.size
        if begin + len(content) > len(row):
            raise SnapshotError(
                f"The state of {self.env} has grown to {begin + len(content):,} bytes, and a row "
                f"has {len(row):,}. Pass cap={2 * (begin + len(content)):,} or more."
            )
        clocks = [clock._elapsed_steps or 0 for clock in self._clocks]
        self._head.pack_into(row.data, 0, len(content), *clocks)
        row.data[begin : begin + len(content)] = content

    def _load(self, row: np.ndarray) -> None:
        begin = self._head.size
        length, *clocks = self._head.unpack_from(row.data)
        for clock, steps in zip(self._clocks, clocks, strict=True):
            clock._elapsed_steps = steps
        self._load_content(row[begin : begin + length].tobytes())

    def _load_content(self, content: bytes) -> None:
        """Sets the attributes, unless they are so already."""
        if content != self._unchanged:
            mark, known = self._known
            if content != known or mark is None or self._mark() != mark:
                if not self._recalls(content):
                    self._load_attributes(content)
            self._unchanged = content

    def _recalls(self, content: bytes) -> bool:
        """Sets the attributes to the objects that were read, if these have not changed since."""
        if content not in self._recent:
            return False
        seen, mark, states, inner, lists = self._recent[content]
        for layer, state in zip(self._layers, states, strict=True):
            vars(layer).update(state)
        for held, copied in zip(seen.dicts[len(states) :], inner, strict=True):
            held.clear()
            held.update(copied)
        for items, copies in zip(seen.lists, lists, strict=True):
            items[:] = copies
        if not seen.still() or seen.contents() != mark:
            return False
        self._seen, self._known = seen, (mark, content)
        return True

    def _load_attributes(self, content: bytes) -> None:
        """Sets the attributes of all layers."""
        values, others, generators = self._unpickled(content)
        parts = zip(self._layers, values, others, generators, strict=True)
        for number, (layer, plain, other, generator) in enumerate(parts):
            now = vars(layer)
            if len(now) > len(plain) + len(other):
                for name in [n for n in now if n not in plain and n not in other]:
                    if self._is_state(number, name, now[name]):
                        del now[name]
            now.update(plain)
            now.update((name, value) for name, value in other.items() if value is not _KEPT)
            _set_generator(layer, generator)

    def _unpickled(self, content: bytes) -> tuple[list[Any], list[Any], list[Any]]:
        """Plain attributes, all others and the generator's state of each layer."""
        stream = io.BytesIO(content)

        def read() -> Any:
            return RowUnpickler(stream, self._fixed, self._packages).load()

        values, generators, with_others = read()
        return values, read() if with_others else [{}] * len(values), generators

    def _kind(self, layer: int, name: str, value: Any) -> int:
        """Whether an attribute is no state, a plain value, or anything else."""
        if name == "_np_random" or self.is_fixed(value):
            kind = _FIXED
        elif not self.is_read(self._layers[layer], name):
            kind = _FIXED
        else:
            kind = _PLAIN if type(value) in self.plain_types else _OTHER
        self._kinds[layer][name, type(value)] = kind
        return kind

    def _is_state(self, layer: int, name: str, value: Any) -> bool:
        kind = self._kinds[layer].get((name, type(value)))
        return (self._kind(layer, name, value) if kind is None else kind) != _FIXED

    def _pickled(self, learning: bool = False) -> bytes:
        """The attributes of all layers; while learning, objects that are no state get numbers.

        Plain values need no look at each object, which is slow; all others are pickled together,
        so that what they share stays shared.
        """
        mark = None if learning else self._mark()
        if mark is not None and mark == self._known[0]:
            return self._known[1]
        values, others, generators, with_others = [], [], [], False
        for number, layer in enumerate(self._layers):
            plain, other, kinds = {}, {}, self._kinds[number]
            for name, value in vars(layer).items():
                kind = kinds.get((name, type(value)))
                if kind is None:
                    kind = self._kind(number, name, value)
                if kind == _PLAIN:
                    plain[name] = value
                elif kind == _OTHER:
                    other[name] = value
                    with_others = True
            values.append(plain)
            others.append(other)
            generators.append(generator_state(vars(layer).get("_np_random")))
        stream = io.BytesIO()
        pickle.dump((values, generators, with_others), stream, protocol=5)
        if with_others:
            try:
                _Pickler(stream, self, learning).dump(others)
            except Exception as error:
                raise SnapshotError(self._refusal(others, error)) from error
        self._known = mark, stream.getvalue()
        if mark is not None and self._seen is not None:
            if len(self._recent) == _REMEMBERED:
                del self._recent[next(iter(self._recent))]
            states = [a | b for a, b in zip(values, others, strict=True)]
            inner = [*map(dict, self._seen.dicts[len(states) :])]
            lists = [*map(list, self._seen.lists)]
            self._recent[self._known[1]] = self._seen, mark, states, inner, lists
        return self._known[1]

    def _mark(self) -> Any:
        """What is equal only if all attributes are, much cheaper than pickling them.

        None where some are objects of which nothing is known.
        """
        if self._seen is None or not self._seen.still():
            names = [[self.is_read(layer, name) for name in vars(layer)] for layer in self._layers]
            self._seen = look_through(
                self._layers, names, self._is_state, self._index, self._packages
            )
        return None if self._seen is None else self._seen.contents()

    def is_read(self, layer: Any, name: str) -> bool:
        """Return whether an attribute of a layer may be state."""
        return name not in self.skipped_attributes

    def _refusal(self, values: list[dict[str, Any]], error: Exception) -> str:
        """Names the attribute that cannot be pickled."""
        for layer, own in zip(self._layers, values, strict=True):
            for name, value in own.items():
                try:
                    _Pickler(io.BytesIO(), self, True).dump(value)
                except Exception:
                    return (
                        f"{type(layer).__name__}.{name} is a {type(value).__name__}, which cannot "
                        f"be stored ({error}), and it may hold state. Pass snapshot=(read, "
                        "restore), two functions of your own, or snapshot=ReplaySnapshot."
                    )
        return f"The state of {self.env} cannot be stored: {error}."


_NUMPY = frozenset(
    "ndarray dtype _reconstruct scalar _frombuffer __generator_ctor __bit_generator_ctor "
    "__randomstate_ctor PCG64 MT19937 Philox SFC64 PCG64DXSM SeedSequence "
    "__pyx_unpickle_SeedSequence".split()
)


_KEPT = object()  # an attribute that was no state when the row was read: it stays as it is


class _Pickler(pickle.Pickler):
    """Pickles state, and refers to what is no state by its number."""

    def __init__(self, stream: io.BytesIO, snapshot: AttributeSnapshot, learning: bool) -> None:
        super().__init__(stream, protocol=5)
        self._snapshot = snapshot
        self._index = snapshot._index
        self._learning = learning

    def persistent_id(self, obj: Any) -> int | None:
        if type(obj) in _NO_OBJECTS:
            return None
        number = self._index.get(id(obj))
        if number is not None:
            return number
        if not self._snapshot.is_fixed(obj) or _has_a_path(obj):
            return None
        if not self._learning:
            return -1
        fixed = self._snapshot._fixed
        fixed.append(obj)
        self._index[id(obj)] = len(fixed) - 1
        return len(fixed) - 1


def _has_a_path(obj: Any) -> bool:
    """Whether pickle finds an object again by its module and name."""
    if isinstance(obj, types.MethodType) or "<" in getattr(obj, "__qualname__", "<"):
        return False
    return isinstance(obj, (type, types.FunctionType, types.BuiltinFunctionType))


_SAFE = frozenset(
    {
        *(("builtins", name) for name in ("set", "frozenset", "bytearray", "complex", "range")),
        *(("collections", name) for name in ("deque", "OrderedDict", "defaultdict", "Counter")),
        ("copyreg", "_reconstructor"),
        ("builtins", "object"),
        ("builtins", "slice"),
        ("random", "Random"),
        *(("pathlib", name) for name in ("PosixPath", "PurePosixPath", "WindowsPath")),
        ("fractions", "Fraction"),
        ("decimal", "Decimal"),
    }
)


_LIBRARIES = frozenset({"builtins", "types", "numpy", "os", "subprocess", "functools"})


class RowUnpickler(pickle.Unpickler):
    """Reads a row: plain data, NumPy's, and classes of the packages that the env is made of."""

    def __init__(self, content: io.BytesIO, fixed: list[Any], packages: frozenset[str]) -> None:
        super().__init__(content)
        self._fixed = fixed
        self._packages = packages

    def find_class(self, module: str, name: str) -> Any:
        package = module.partition(".")[0]
        numbers = package == "numpy" and name in _NUMPY
        if not (numbers or (module, name) in _SAFE or package in self._packages):
            raise SnapshotError(
                f"The row holds {module}.{name}, which is no class of this env. Either it was not "
                "written by a snapshot of such an env, or the env keeps objects of other packages: "
                "then pass snapshot=(read, restore) of your own, or snapshot=ReplaySnapshot."
            )
        found = super().find_class(module, name)
        if package in self._packages and not isinstance(found, type):
            raise SnapshotError(f"The row calls {module}.{name}, which is no class.")
        return found

    def persistent_load(self, number: int) -> Any:
        return _KEPT if number < 0 else self._fixed[number]


def _room_for(needed: int, cap: int, env: gymnasium.Env) -> int:
    """Bytes of a row: at least a quarter more than the state has now."""
    width = 64
    while width < needed + needed // 4 + 64:  # steps of an eighth: instances agree on them
        width += max(64, (1 << width.bit_length() - 4) // 64 * 64)
    if needed > cap:
        raise SnapshotError(
            f"The state of {env} has {needed:,} bytes, more than cap={cap:,}. Every node of a tree "
            "holds one. Pass a larger cap, snapshot=(read, restore) of your own, or "
            "snapshot=ReplaySnapshot."
        )
    return min(width, max(cap, 64))


def _set_generator(layer: gymnasium.Env, stored: bytes | Any) -> None:
    if not isinstance(stored, bytes):
        if "_np_random" in vars(layer) or stored is not None:
            layer._np_random = stored
        return
    generator = vars(layer).get("_np_random")
    if generator is None or type(generator.bit_generator) is not np.random.PCG64:
        generator = layer._np_random = np.random.Generator(np.random.PCG64(0))
    set_generator_state(generator, stored)
