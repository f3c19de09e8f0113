"""The kinds of snapshots, and which of them stores an env."""

from __future__ import annotations

import struct
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit

from torchrl_hmcts.envs.gym.attributes import AttributeSnapshot
from torchrl_hmcts.envs.gym.minigrid import MiniGridSnapshot
from torchrl_hmcts.envs.gym.mujoco import MujocoSnapshot
from torchrl_hmcts.envs.gym.snapshots import (
    DEFAULT_CAP,
    KNOWN_WRAPPERS,
    FunctionSnapshot,
    ReplaySnapshot,
    Snapshot,
    SnapshotError,
    env_layers,
    time_limits,
)

_CLASSIC_ROW = struct.Struct("<6d4q")  # state, its type, its length, the clock, steps after the end
_CLASSIC_TYPES = (tuple, np.dtype(np.float64), np.dtype(np.float32))


class ClassicSnapshot(Snapshot):
    """Stores the state and the time limit's clock; no step of these envs draws."""

    width = _CLASSIC_ROW.size

    def __init__(self, env: gymnasium.Env) -> None:
        env.reset(seed=0)
        self._own: Any = env.unwrapped
        self._counts = hasattr(self._own, "steps_beyond_terminated")
        self._clocks = time_limits(env)

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        *wrappers, inner = env_layers(env)
        return (
            sum(type(layer) is TimeLimit for layer in wrappers) <= 1
            and all(type(layer) in KNOWN_WRAPPERS for layer in wrappers)
            and type(inner).__module__.startswith("gymnasium.envs.classic_control")
            and hasattr(inner, "state")
        )

    def read(self) -> np.ndarray:
        state = self._own.state
        kind = 0 if type(state) is tuple else 1 if state.dtype == np.float64 else 2
        values = state if kind == 0 else state.tolist()
        beyond = getattr(self._own, "steps_beyond_terminated", None)
        row = bytearray(_CLASSIC_ROW.size)
        _CLASSIC_ROW.pack_into(
            row,
            0,
            *values,
            *(0.0,) * (6 - len(values)),
            kind,
            len(values),
            (self._clocks[0]._elapsed_steps or 0) if self._clocks else 0,
            -1 if beyond is None else beyond,
        )
        return np.frombuffer(row, np.uint8)

    def restore(self, row: np.ndarray) -> None:
        *numbers, kind, length, steps, beyond = _CLASSIC_ROW.unpack(row.tobytes())
        values = tuple(numbers[:length])
        self._own.state = values if kind == 0 else np.array(values, _CLASSIC_TYPES[kind])
        if self._counts:
            self._own.steps_beyond_terminated = None if beyond < 0 else beyond
        for clock in self._clocks:
            clock._elapsed_steps = steps


class ALESnapshot(AttributeSnapshot):
    """Stores the emulator's own state and the attributes of the env.

    For planning in Atari, :class:`~torchrl_hmcts.envs.AtariRAMEnv` and
    :class:`~torchrl_hmcts.envs.AtariOptionPool` are faster, and exact with sticky actions.

    Args:
        env (gymnasium.Env): of ale-py, with ``repeat_action_probability=0``.
        cap (int): bytes of the attributes at most. Default 65,536.

    Raises:
        SnapshotError: if actions are sticky: the emulator does not tell which one it holds.
    """

    def __init__(self, env: gymnasium.Env, *, cap: int = 1 << 16) -> None:
        import ale_py

        self._ale: Any = env.unwrapped.ale  # type: ignore[attr-defined]
        sticky = self._ale.getFloat("repeat_action_probability")
        if sticky:
            raise SnapshotError(
                f"{env} has sticky actions ({sticky:g}), and ale-py does not tell which action it "
                "holds. Make it with repeat_action_probability=0, or use AtariRAMEnv."
            )
        self._state_type = ale_py.ALEState
        super().__init__(env, cap=cap)
        self._attributes = self.width
        self._room = len(self._serialized()) + 256
        self.width += 8 + self._room

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return type(vars(env.unwrapped).get("ale")).__name__ == "ALEInterface"

    def is_fixed(self, value: Any) -> bool:
        return type(value).__module__.startswith("ale_py") or super().is_fixed(value)

    def read(self) -> np.ndarray:
        row = np.zeros(self.width, np.uint8)
        state = self._serialized()
        row[:8] = np.frombuffer(len(state).to_bytes(8, "little"), np.uint8)
        row[8 : 8 + len(state)] = np.frombuffer(state, np.uint8)
        self._write(row[8 + self._room :])
        return row

    def restore(self, row: np.ndarray) -> None:
        length = int.from_bytes(row[:8].tobytes(), "little")
        self._ale.restoreState(self._state_type(row[8 : 8 + length].tobytes()))
        self._load(row[8 + self._room :])

    def _serialized(self) -> bytes:
        return bytes(self._ale.cloneState(include_rng=True).serialize())


class ToyTextSnapshot(AttributeSnapshot):
    """Stores the attributes but the tables of transitions and starts, up to 80 kB."""

    skipped_attributes = AttributeSnapshot.skipped_attributes | {
        "P", "desc", "initial_state_distrib", "locs", "locs_colors",
    }  # fmt: skip

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return type(env.unwrapped).__module__.startswith("gymnasium.envs.toy_text")


class Box2DSnapshot(ReplaySnapshot):
    """Replays the episode, each in a new world.

    No other way is exact: the impulses of contacts, from which the next step begins, cannot be set.
    A world that has seen an episode keeps an order of its bodies, so that the next one differs.
    """

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return bool(_worlds(env))

    def note_reset(self, seed: int | None) -> None:
        super().note_reset(seed)
        inner: Any = self.env.unwrapped
        for name, world in _worlds(inner):
            inner._destroy()  # while its bodies have their world
            setattr(inner, name, type(world)(gravity=world.gravity))


def _worlds(env: gymnasium.Env) -> list[tuple[str, Any]]:
    own = vars(env.unwrapped).items()
    return [(name, value) for name, value in own if type(value).__name__ == "b2World"]


KINDS: tuple[Any, ...] = (
    ClassicSnapshot,
    MujocoSnapshot,
    MiniGridSnapshot,
    ALESnapshot,
    Box2DSnapshot,
    ToyTextSnapshot,
    AttributeSnapshot,
)
"""Special kinds first: the first that fits is taken."""


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
        kind = next(kind for kind in KINDS if kind.fits(env))
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
