"""Snapshots: the whole state of a Gymnasium env as a row of bytes, and back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import (
    FilterObservation,
    FlattenObservation,
    OrderEnforcing,
    PassiveEnvChecker,
    TimeLimit,
)

SNAPSHOT_KEY = "snapshot"
"""Entry of a tensordict that holds the row of a state."""
DEFAULT_CAP = 1 << 16
"""Bytes of a row that a general snapshot may fill, unless told otherwise."""
KNOWN_WRAPPERS = frozenset(
    {FilterObservation, FlattenObservation, OrderEnforcing, PassiveEnvChecker, TimeLimit}
)
"""Gymnasium's wrappers whose state is a clock, or nothing."""


class SnapshotError(ValueError):
    """The state of an env cannot be read or restored; the message says why and what to do.

    Example:
        >>> from torchrl_hmcts.envs import SettableGymEnv
        >>> SettableGymEnv("FrozenLake-v1", cap=64)
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
        ...     def read(self):
        ...         return np.array(self.inner.state, np.float64).view(np.uint8)
        ...     def restore(self, row):
        ...         self.inner.state = row.view(np.float64).copy()
        >>> SettableGymEnv("Acrobot-v1", snapshot=AcrobotSnapshot)
        SettableGymEnv(Acrobot-v1, snapshot=AcrobotSnapshot, 32 bytes)
    """

    width: int

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        """Return whether this kind of snapshot stores such an env."""
        return True

    @abstractmethod
    def read(self) -> np.ndarray:
        """Return the state of the env, uint8 ``[width]``."""

    @abstractmethod
    def restore(self, row: np.ndarray) -> None:
        """Put the env into a state, uint8 ``[width]``, as :meth:`read` returned it."""

    def note_reset(self, seed: int | None) -> None:  # noqa: B027  most kinds need no note
        """Take note that the env is about to be reset; whoever resets it calls this first."""

    def note_step(self, action: Any) -> None:  # noqa: B027
        """Take note that the env is about to take a step; whoever steps it calls this first."""

    def note_redraw(self, seed: int) -> None:  # noqa: B027
        """Take note that :func:`redraw` gave the generators other numbers, of this seed."""


def env_layers(env: gymnasium.Env) -> list[gymnasium.Env]:
    """Return the wrappers from the outside, the env itself, and envs that it holds as attributes.

    Wrappers with a class attribute ``is_stateless = True`` are left out: they hold no state.
    """
    layers: list[gymnasium.Env] = []
    waiting = [env]
    while waiting:
        layer = waiting.pop(0)
        if any(layer is known for known in layers):
            continue
        if not getattr(type(layer), "is_stateless", False):
            layers.append(layer)
        waiting += _held_by(layer)
    return layers


def _held_by(layer: Any) -> list[gymnasium.Env]:
    """The envs that a layer holds.

    CPython 3.11 and 3.12 look an attribute up more slowly once vars() has been asked for: CartPole
    took 14 % longer a step.
    """
    if type(layer) in KNOWN_WRAPPERS:
        return [layer.env]
    if type(layer).__module__.startswith("gymnasium.envs.classic_control"):
        return []
    if getattr(type(layer), "is_stateless", False):
        return [layer.env]  # type: ignore[attr-defined]
    return [value for value in vars(layer).values() if isinstance(value, gymnasium.Env)]


def time_limits(env: gymnasium.Env) -> list[Any]:
    """Return the wrappers of an env that count its steps, from the outside."""
    return [layer for layer in env_layers(env) if type(layer) is TimeLimit]


def redraw(layers: Sequence[gymnasium.Env], seed: int) -> None:
    """Give all generators of the :func:`env_layers` other numbers."""
    for number, layer in enumerate(layers):
        generator = getattr(layer, "_np_random", None)
        if generator is not None and type(generator.bit_generator) is np.random.PCG64:
            generator.bit_generator.state = _new_draws(seed, number)
        elif generator is not None:
            layer._np_random = np.random.default_rng((seed, number))
        if hasattr(type(layer), "seed_globals"):
            layer.seed_globals(seed)  # type: ignore[attr-defined]


@lru_cache(maxsize=16)
def _new_draws(seed: int, number: int) -> Any:
    return np.random.PCG64((seed, number)).state


class ReplaySnapshot(Snapshot):
    """Stores how a state was reached, the seed and the actions since, and takes them again.

    Exact for every deterministic env, and for one that draws as long as each :func:`redraw` is
    noted; restoring costs as many steps as the episode has had.

    Example:
        >>> import gymnasium
        >>> snapshot = ReplaySnapshot(gymnasium.make("CartPole-v1"))
        >>> snapshot.width  # seed, number of steps, and 500 actions with what was redrawn
        8016

    Args:
        env (gymnasium.Env): any env.
        max_steps (int): steps of an episode at most. Default: the env's limit, or 1,000.

    Raises:
        SnapshotError: if an action has another size than the action space, or an episode is
            longer.
    """

    def __init__(self, env: gymnasium.Env, *, max_steps: int | None = None) -> None:
        self.env = env
        limit = env.spec.max_episode_steps if env.spec is not None else None
        self._max_steps = max_steps or limit or 1_000
        sample = np.asarray(env.action_space.sample())
        self._shape, self._dtype = sample.shape, sample.dtype
        self._bytes = sample.nbytes
        self.width = 16 + self._max_steps * (8 + self._bytes)
        self._layers = env_layers(env)
        self._seed: int | None = None
        self._actions: list[np.ndarray] = []
        self._redraws: list[int] = []  # seeds of new draws before each action, 0 for none
        self._redraw = 0  # before the next action

    def note_reset(self, seed: int | None) -> None:
        if seed is None:
            raise SnapshotError(
                "A snapshot by replay needs every episode to begin with reset(seed=...)."
            )
        self._seed, self._actions, self._redraws, self._redraw = seed, [], [], 0

    def note_redraw(self, seed: int) -> None:
        self._redraw = seed

    def note_step(self, action: Any) -> None:
        if len(self._actions) == self._max_steps:
            raise SnapshotError(
                f"The episode is longer than the {self._max_steps} steps that a row has room for. "
                "Pass max_steps= to ReplaySnapshot."
            )
        self._actions.append(np.array(action, self._dtype))
        self._redraws.append(self._redraw)
        self._redraw = 0

    def read(self) -> np.ndarray:
        if self._seed is None:
            raise SnapshotError("No episode has begun. Call reset(seed=...) first.")
        row = np.zeros(self.width, np.uint8)
        steps = len(self._actions)
        row[:16].view(np.int64)[:] = self._seed, steps
        if steps:
            taken = np.array(self._redraws, np.uint64).tobytes() + np.stack(self._actions).tobytes()
            row[16 : 16 + len(taken)] = np.frombuffer(taken, np.uint8)
        return row

    def restore(self, row: np.ndarray) -> None:
        seed, steps = (int(n) for n in np.frombuffer(row[:16].tobytes(), np.int64))
        taken = row[16 : 16 + steps * (8 + self._bytes)].tobytes()
        redraws = np.frombuffer(taken[: 8 * steps], np.uint64).tolist()
        actions = list(np.frombuffer(taken[8 * steps :], self._dtype).reshape(steps, *self._shape))
        known = len(self._actions)
        on_the_way = self._redraws == redraws[:known] and all(
            map(np.array_equal, self._actions, actions)
        )
        if seed != self._seed or self._redraw or not on_the_way:
            self.note_reset(seed)
            self.env.reset(seed=seed)
            known = 0
        self._actions, self._redraws = actions, redraws
        for again, action in zip(redraws[known:], actions[known:], strict=True):
            if again:
                redraw(self._layers, again)
            self.env.step(action if self._shape else action[()])


class FunctionSnapshot(Snapshot):
    """Stores what two functions of yours read and restore.

    ``read(env)`` gives bytes or an array, of one size every time; ``restore(env, row)`` takes uint8
    ``[width]``.
    """

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
