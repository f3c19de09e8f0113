"""Snapshots: the whole state of a Gymnasium env as a row of bytes, and back."""

from __future__ import annotations

import io
import pickle
import types
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit

SNAPSHOT_KEY = "snapshot"
"""Entry of a tensordict that holds the row of a state."""
DEFAULT_CAP = 1 << 16
"""Bytes of a row that a general snapshot may fill, unless told otherwise."""
_GENERATOR_BYTES = 41  # a flag, PCG64's state and increment, its spare 32 bits


class SnapshotError(ValueError):
    """The state of an env cannot be read or restored; the message says why and what to do.

    Example:
        >>> from torchrl_hmcts.envs import SettableGymEnv
        >>> SettableGymEnv("CartPole-v1", cap=64)
        Traceback (most recent call last):
        ...
        torchrl_hmcts.envs.gym.snapshots.SnapshotError: The state of ... more than cap=64...
    """


class Snapshot(ABC):
    """Reads the whole state of one env into a row of bytes, and restores it.

    A row of one instance fits every instance that was made in the same way, in another process
    too. Where the state is Python objects, a row holds them pickled; only arrays, containers and
    classes of the env's own packages are read, so that no row can execute anything else.

    Args:
        env (gymnasium.Env): the env with its wrappers. It is reset with seed 0, so that instances
            made in the same way agree on the row.

    Attributes:
        width (int): bytes of a row.

    Raises:
        SnapshotError: if a part of the state cannot be stored, by name.

    Example:
        >>> import gymnasium
        >>> import numpy as np
        >>> from torchrl_hmcts.envs import SettableGymEnv, Snapshot
        >>> class AcrobotSnapshot(Snapshot):
        ...     width = 4 * 8
        ...     def __init__(self, env):
        ...         self.inner = env.unwrapped
        ...     @classmethod
        ...     def fits(cls, env):
        ...         return type(env.unwrapped).__name__ == "AcrobotEnv"
        ...     def read(self):
        ...         return np.array(self.inner.state, np.float64).view(np.uint8)
        ...     def restore(self, row):
        ...         self.inner.state = row.view(np.float64).copy()
        >>> SettableGymEnv("Acrobot-v1", snapshot=AcrobotSnapshot)
        SettableGymEnv(Acrobot-v1, snapshot=AcrobotSnapshot, 32 bytes)
    """

    width: int

    @classmethod
    @abstractmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        """Return whether this kind of snapshot stores such an env."""

    @abstractmethod
    def read(self) -> np.ndarray:
        """Return the state of the env, uint8 ``[width]``."""

    @abstractmethod
    def restore(self, row: np.ndarray) -> None:
        """Put the env into a state.

        Args:
            row (ndarray): uint8 ``[width]``, as :meth:`read` returned it.
        """

    def note_reset(self, seed: int | None) -> None:  # noqa: B027  most kinds need no note
        """Take note that the env is about to be reset; whoever resets it calls this first.

        Args:
            seed (int, optional): of the reset.
        """

    def note_step(self, action: Any) -> None:  # noqa: B027
        """Take note that the env is about to take a step; whoever steps it calls this first.

        Args:
            action: of the step.
        """


_FIXED_TYPES = (
    gymnasium.Space,
    gymnasium.envs.registration.EnvSpec,
    types.FunctionType,
    types.MethodType,
    types.BuiltinFunctionType,
    types.ModuleType,
    type,
)
_ATOMS: frozenset[type] = frozenset({int, float, str, bool, bytes, type(None)})
_NO_OBJECTS = frozenset({*_ATOMS, list, dict, tuple, np.ndarray, np.dtype})
_FIXED, _PLAIN, _OTHER = range(3)


def env_layers(env: gymnasium.Env) -> list[gymnasium.Env]:
    """Return the wrappers from the outside, the env itself, and envs that it holds as attributes.

    Args:
        env (gymnasium.Env): any env.

    Example:
        >>> import gymnasium
        >>> [type(layer).__name__ for layer in env_layers(gymnasium.make("CartPole-v1"))]
        ['TimeLimit', 'OrderEnforcing', 'PassiveEnvChecker', 'CartPoleEnv']
    """
    layers: list[gymnasium.Env] = []
    waiting = [env]
    while waiting:
        layer = waiting.pop(0)
        if any(layer is known for known in layers):
            continue
        layers.append(layer)
        waiting += [value for value in vars(layer).values() if isinstance(value, gymnasium.Env)]
    return layers


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
        {"env", "spec", "metadata", "_previous_data"}
    )
    plain_types: ClassVar[frozenset[type]] = _ATOMS
    drawing_modules: ClassVar[tuple[str, ...]] = ("pygame", "matplotlib", "PIL", "cv2", "moviepy")

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return True

    def __init__(self, env: gymnasium.Env, *, cap: int = DEFAULT_CAP) -> None:
        self.env = env
        env.reset(seed=0)
        self._layers = env_layers(env)
        self._fixed: list[Any] = list(self._layers)  # referred to by their index, never stored
        self._index = {id(item): i for i, item in enumerate(self._fixed)}
        self._cap = cap
        modules = {kind.__module__ for layer in self._layers for kind in type(layer).__mro__}
        self._packages = frozenset(name.partition(".")[0] for name in modules) - _LIBRARIES
        self._kinds: dict[tuple[int, str, type], int] = {}
        self._clocks = [vars(layer) for layer in self._layers if type(layer) is TimeLimit]
        self._unchanged: bytes | None = None  # attributes of the env, if it took no step since
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
        """Return whether an object is no state: it stays as it is in each instance.

        Args:
            value: any object that an env refers to.
        """
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
        begin = 8 + 8 * len(self._clocks)
        if begin + len(content) > len(row):
            raise SnapshotError(
                f"The state of {self.env} has grown to {begin + len(content):,} bytes, and a row "
                f"has {len(row):,}. Pass cap={2 * (begin + len(content)):,} or more."
            )
        clocks = [clock["_elapsed_steps"] or 0 for clock in self._clocks]
        row[:begin].view(np.int64)[:] = len(content), *clocks
        row[begin : begin + len(content)] = np.frombuffer(content, np.uint8)

    def _load(self, row: np.ndarray) -> None:
        begin = 8 + 8 * len(self._clocks)
        length, *clocks = row[:begin].view(np.int64).tolist()
        for clock, steps in zip(self._clocks, clocks, strict=True):
            clock["_elapsed_steps"] = steps
        content = row[begin : begin + length].tobytes()
        if content != self._unchanged:
            self._load_attributes(content)
            self._unchanged = content

    def _load_attributes(self, content: bytes) -> None:
        """Sets the attributes of all layers."""
        values, others, generators = self._unpickled(content)
        parts = zip(self._layers, values, others, generators, strict=True)
        for number, (layer, plain, other, generator) in enumerate(parts):
            now = vars(layer)
            if len(now) > len(plain) + len(other):
                for name in [n for n in now if n not in plain and n not in other]:
                    if self._kind(number, name, now[name]) != _FIXED:
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
        key = (layer, name, type(value))
        kind = self._kinds.get(key)
        if kind is None:
            apart = name == "_np_random" or (
                name == "_elapsed_steps" and type(self._layers[layer]) is TimeLimit
            )
            if apart or name in self.skipped_attributes or self.is_fixed(value):
                kind = _FIXED
            else:
                kind = _PLAIN if type(value) in self.plain_types else _OTHER
            self._kinds[key] = kind
        return kind

    def _pickled(self, learning: bool = False) -> bytes:
        """The attributes of all layers; while learning, objects that are no state get numbers.

        Plain values need no look at each object, which is slow; all others are pickled together,
        so that what they share stays shared.
        """
        values, others, generators, with_others = [], [], [], False
        for number, layer in enumerate(self._layers):
            plain, other = {}, {}
            for name, value in vars(layer).items():
                kind = self._kind(number, name, value)
                if kind == _PLAIN:
                    plain[name] = value
                elif kind == _OTHER:
                    other[name] = value
                    with_others = True
            values.append(plain)
            others.append(other)
            generators.append(_generator_state(layer))
        stream = io.BytesIO()
        pickle.dump((values, generators, with_others), stream, protocol=5)
        if with_others:
            try:
                _Pickler(stream, self, learning).dump(others)
            except Exception as error:
                raise SnapshotError(self._refusal(others, error)) from error
        return stream.getvalue()

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


class _Kept:
    """Marks an attribute that was no state when the row was read: it stays as it is."""


_KEPT = _Kept()


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


def _generator_state(layer: gymnasium.Env) -> bytes | Any:
    """The state of an env's own generator: 40 bytes for NumPy's default one."""
    generator = vars(layer).get("_np_random")
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


def _set_generator(layer: gymnasium.Env, stored: bytes | Any) -> None:
    if not isinstance(stored, bytes):
        if "_np_random" in vars(layer) or stored is not None:
            layer._np_random = stored
        return
    generator = vars(layer).get("_np_random")
    if generator is None or type(generator.bit_generator) is not np.random.PCG64:
        generator = layer._np_random = np.random.Generator(np.random.PCG64(0))
    number = [int.from_bytes(stored[a:b], "little") for a, b in ((0, 16), (16, 32))]
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": number[0], "inc": number[1]},
        "has_uint32": int.from_bytes(stored[32:36], "little"),
        "uinteger": int.from_bytes(stored[36:40], "little"),
    }


class ReplaySnapshot(Snapshot):
    """Stores how a state was reached, the seed and the actions since, and takes them again.

    Exact for every deterministic env; restoring costs as many steps as the episode has had.

    Example:
        >>> import gymnasium
        >>> snapshot = ReplaySnapshot(gymnasium.make("CartPole-v1"))
        >>> snapshot.width  # seed, number of steps, and 500 actions
        4016

    Args:
        env (gymnasium.Env): any env.
        max_steps (int): steps of an episode at most. Default: the env's limit, or 1,000.

    Raises:
        SnapshotError: if an action has another size than the action space, or an episode is
            longer.
    """

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return True

    def __init__(self, env: gymnasium.Env, *, max_steps: int | None = None) -> None:
        self.env = env
        limit = env.spec.max_episode_steps if env.spec is not None else None
        self._max_steps = max_steps or limit or 1_000
        sample = np.asarray(env.action_space.sample())
        self._shape, self._dtype = sample.shape, sample.dtype
        self._bytes = sample.nbytes
        self.width = 16 + self._max_steps * self._bytes
        self._seed: int | None = None
        self._actions: list[np.ndarray] = []

    def note_reset(self, seed: int | None) -> None:
        if seed is None:
            raise SnapshotError(
                "A snapshot by replay needs every episode to begin with reset(seed=...)."
            )
        self._seed, self._actions = seed, []

    def note_step(self, action: Any) -> None:
        if len(self._actions) == self._max_steps:
            raise SnapshotError(
                f"The episode is longer than the {self._max_steps} steps that a row has room for. "
                "Pass max_steps= to ReplaySnapshot."
            )
        self._actions.append(np.array(action, self._dtype))

    def read(self) -> np.ndarray:
        if self._seed is None:
            raise SnapshotError("No episode has begun. Call reset(seed=...) first.")
        row = np.zeros(self.width, np.uint8)
        row[:16].view(np.int64)[:] = self._seed, len(self._actions)
        if self._actions:
            taken = np.stack(self._actions)
            row[16 : 16 + taken.nbytes] = np.frombuffer(taken.tobytes(), np.uint8)
        return row

    def restore(self, row: np.ndarray) -> None:
        seed, steps = (int(n) for n in np.frombuffer(row[:16].tobytes(), np.int64))
        taken = np.frombuffer(row[16 : 16 + steps * self._bytes].tobytes(), self._dtype)
        actions = list(taken.reshape(steps, *self._shape))
        if seed == self._seed and len(self._actions) <= steps and _same(self._actions, actions):
            ahead = actions[len(self._actions) :]  # the state lies on the way to that one
        else:
            self.env.reset(seed=seed)
            self._seed, ahead = seed, actions
        self._actions = actions
        for action in ahead:
            self.env.step(self._plain(action))

    def _plain(self, action: np.ndarray) -> Any:
        return action if self._shape else action[()]


def _same(taken: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(taken, other, strict=False))


class FunctionSnapshot(Snapshot):
    """Stores what two functions of yours read and restore.

    Args:
        env (gymnasium.Env): the env with its wrappers.
        read (callable): ``read(env) -> bytes`` or an array, the same size every time.
        restore (callable): ``restore(env, row)`` with uint8 ``[width]``.
    """

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return False

    def __init__(
        self,
        env: gymnasium.Env,
        read: Callable[[gymnasium.Env], Any],
        restore: Callable[[gymnasium.Env, np.ndarray], None],
    ) -> None:
        self.env = env
        self._read, self._restore = read, restore
        self.width = len(self._bytes())

    def read(self) -> np.ndarray:
        row = self._bytes()
        if len(row) != self.width:
            raise SnapshotError(
                f"read(env) returned {len(row)} bytes, and {self.width} before. Pad the state to "
                "one size."
            )
        return row

    def restore(self, row: np.ndarray) -> None:
        self._restore(self.env, row)

    def _bytes(self) -> np.ndarray:
        value = self._read(self.env)
        raw = value if isinstance(value, bytes) else np.ascontiguousarray(value).tobytes()
        return np.frombuffer(raw, np.uint8).copy()


def snapshot_of(env: gymnasium.Env, snapshot: Any = None, *, cap: int = DEFAULT_CAP) -> Snapshot:
    """Return the snapshot that stores an env's state.

    Args:
        env (gymnasium.Env): the env with its wrappers; it is reset.
        snapshot (type, tuple of two functions, or callable, optional): a :class:`Snapshot` class,
            ``(read, restore)`` as in :class:`FunctionSnapshot`, or a function of the env. Default:
            the first kind that fits.
        cap (int): bytes of the attributes in a row at most. Default 65,536.

    Raises:
        SnapshotError: if the state cannot be stored.
        TypeError: if ``snapshot`` is something else.
    """
    if snapshot is None:
        kind = next(kind for kind in _kinds() if kind.fits(env))
        room = {"cap": cap} if issubclass(kind, AttributeSnapshot) else {}
        return kind(env, **room)
    if isinstance(snapshot, tuple) and len(snapshot) == 2 and all(map(callable, snapshot)):
        return FunctionSnapshot(env, *snapshot)
    made = snapshot(env) if callable(snapshot) else snapshot
    if not isinstance(made, Snapshot):
        raise TypeError(
            f"snapshot= takes a Snapshot class, or two functions (read, restore); got {snapshot!r}."
        )
    return made


def _kinds() -> tuple[Any, ...]:
    """The kinds of snapshots, special ones first."""
    from torchrl_hmcts.envs.gym.atari import ALESnapshot
    from torchrl_hmcts.envs.gym.box2d import Box2DSnapshot
    from torchrl_hmcts.envs.gym.classic import ClassicSnapshot
    from torchrl_hmcts.envs.gym.minigrid import MiniGridSnapshot
    from torchrl_hmcts.envs.gym.mujoco import MujocoSnapshot
    from torchrl_hmcts.envs.gym.tables import ToyTextSnapshot

    return (
        ClassicSnapshot,
        MujocoSnapshot,
        MiniGridSnapshot,
        ALESnapshot,
        Box2DSnapshot,
        ToyTextSnapshot,
        AttributeSnapshot,
    )
