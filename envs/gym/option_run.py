"""Options taken to their end in one env, by a worker: what each process of a pool does.

Letters: S slots, T ``max_steps``.
"""

from __future__ import annotations

import hashlib
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.wrappers import OrderEnforcing, TimeLimit
from torchrl.data.utils import CloudpickleWrapper

from torchrl_hmcts.envs.gym.attributes import AttributeSnapshot
from torchrl_hmcts.envs.gym.families import snapshot_of
from torchrl_hmcts.envs.gym.features import FEATURES_KEY, Features
from torchrl_hmcts.envs.gym.marks import generator_memory, set_generator_state
from torchrl_hmcts.envs.gym.quick import quick_step
from torchrl_hmcts.envs.gym.settable import PrivateRandom, make_gym
from torchrl_hmcts.envs.gym.snapshots import (
    SNAPSHOT_KEY,
    Snapshot,
    env_layers,
    redraw,
    time_limits,
)

Shape = tuple[tuple[int, ...], Any]
"""Shape and dtype of an entry."""
_JOB = struct.Struct("<qi")  # seed and option
_ROW_BEFORE, _ROW_AFTER = f"before {SNAPSHOT_KEY}", f"after {SNAPSHOT_KEY}"
_FEATURES = f"after {FEATURES_KEY}"


class OptionWorker(Protocol):
    """The part of an agent that acts inside options: any object that can be pickled.

    It may have ``begin(observation, option)`` too, which is called before the first step of an
    option, and ``ends(observation, option, steps) -> bool``: whether the option ends after so many
    steps.

    Example:
        >>> class LeftOrRight:
        ...     num_options = 2
        ...     def act(self, observation, option, generator):
        ...         return option
        >>> from torchrl_hmcts.envs import OptionPool
        >>> pool = OptionPool("CartPole-v1", LeftOrRight(), max_steps=4, num_processes=0)
        >>> pool.num_options
        2
    """

    num_options: int

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> Any:
        """Return the next action.

        Args:
            observation: as the env gives it; of :class:`AtariOptionPool` the RAM, uint8 ``[128]``.
                It may be overwritten in the next step.
            option: which option runs.
            generator: of all random choices.
        """
        ...


class OptionRun(ABC):
    """Runs options in one env.

    A subclass is built from ``arguments``, again in each process, so that what it opens is never
    sent.

    Attributes:
        state_keys: entries that are the state.
        outputs: shape and dtype of the entries that a state and an outcome have.
        work: memory of one int64, counted up while options run.
        step: takes a step as an env of Gymnasium does.
        clock: a time limit that :meth:`run` keeps, since ``step`` goes past it.
        block: in which the steps of an option are taken.
    """

    state_keys: list[Any]
    outputs: dict[Any, Shape]
    step: Callable[[Any], tuple[Any, Any, Any, Any, Any]]
    clock: Any = None
    block: AbstractContextManager[Any] = nullcontext()

    def __init__(self, worker: OptionWorker, max_steps: int, gamma: float) -> None:
        self.worker, self.max_steps, self.gamma = worker, max_steps, gamma
        self.ends: Callable[..., bool] | None = getattr(worker, "ends", None)
        self._begun: Callable[..., None] | None = getattr(worker, "begin", None)
        self.work: Any = np.zeros(1, np.int64).data
        self.arguments: tuple[Any, ...] = ()

    def __reduce__(self) -> Any:
        return type(self), self.arguments

    def slot_type(self) -> np.dtype:
        """Return the type of a job, and of its outcome after it."""
        fields: list[Any] = [("option", np.int64), ("seed", np.int64)]
        fields += [
            (f"before {key}", dtype, shape)
            for key, (shape, dtype) in self.outputs.items()
            if key in self.state_keys
        ]
        fields += [(f"after {key}", dtype, shape) for key, (shape, dtype) in self.outputs.items()]
        fields += [
            ("reward", np.float32, (1,)),
            ("duration", np.int64, (1,)),
            ("terminated", np.bool_, (1,)),
            ("truncated", np.bool_, (1,)),
        ]
        return np.dtype(fields, align=True)

    def run(self, slots: dict[str, np.ndarray], index: int) -> None:
        """Run the option in one slot, of fields ``[S, ...]``, to its end and write the outcome."""
        option = int(slots["option"][index])
        observation, generator = self.begin(slots, index)
        if self._begun is not None:
            self._begun(observation, option)
        act, ends, take, gamma = self.worker.act, self.ends, self.step, self.gamma
        reward, discount, work, clock = 0.0, 1.0, self.work, self.clock
        left = clock._max_episode_steps - clock._elapsed_steps if clock is not None else np.inf
        with self.block:
            for step in range(1, self.max_steps + 1):
                action = act(observation, option, generator)
                try:
                    observation, gained, terminated, truncated, _ = take(action)
                except Exception as error:
                    if wrong := self._wrong(action, option):
                        raise ValueError(wrong) from error
                    raise
                work[0] += 1  # a step of Atari adds to it as well
                reward += discount * float(gained)
                discount *= gamma
                if terminated or truncated or step >= left:
                    break
                if ends is not None and ends(observation, option, step):
                    break
        if clock is not None:
            clock._elapsed_steps += step
            truncated = truncated or step >= left
        slots["reward"][index] = reward
        slots["duration"][index] = step
        slots["terminated"][index], slots["truncated"][index] = terminated, truncated
        self.write(slots, index, observation)

    @abstractmethod
    def reset(self, generator: np.random.Generator, seed: int | None) -> Any:
        """Begin an episode, of a seed or of one that is drawn; return its observation."""

    @staticmethod
    def seed_of(slots: dict[str, np.ndarray], index: int, mark: bytes) -> int:
        """Return the seed of all draws in an option, a function of the job and a mark of its state.

        The mark must be the same in every process.
        """
        numbers = _JOB.pack(slots["seed"][index], slots["option"][index])
        digest = hashlib.blake2b(numbers + mark, digest_size=8).digest()
        return int.from_bytes(digest, "little")

    @abstractmethod
    def begin(self, slots: dict[str, np.ndarray], index: int) -> tuple[Any, np.random.Generator]:
        """Restore the state of a job; return its observation and the worker's generator."""

    @abstractmethod
    def write(self, slots: dict[str, np.ndarray], index: int, observation: Any) -> None:
        """Write the entries of the present state, which has this observation."""

    @abstractmethod
    def check_action(self, action: Any) -> str:
        """Return what actions there are, if that is none of them, else nothing."""

    @abstractmethod
    def render(self, slots: dict[str, np.ndarray], index: int) -> Any:
        """Draw the state of a job."""

    def check_worker(self, owner: str) -> None:
        """Refuse a worker that cannot act, before it is sent to the processes."""
        worker = self.worker
        count = getattr(worker, "num_options", None)
        if not isinstance(count, int) or count < 1 or not hasattr(worker, "act"):
            raise ValueError(
                f"{owner} needs a worker with num_options (an int >= 1) and act(observation, "
                f"option, generator) -> action; got {worker!r}. See RepeatActions and SkillWorker "
                f"in torchrl_hmcts.envs."
            )
        observation = self.first_observation()
        for option in range(count):
            if self._begun is not None:
                self._begun(observation, option)
            action = worker.act(observation, option, np.random.default_rng(0))
            if wrong := self._wrong(action, option):
                raise ValueError(wrong)

    def _wrong(self, action: Any, option: int) -> str:
        wanted = self.check_action(action)
        kind = type(self.worker).__name__
        told = f"The worker {kind} took the action {action!r} in option {option}; {wanted}."
        return told if wanted else ""

    def first_observation(self) -> Any:
        """Return an observation of an episode's beginning."""
        return self.reset(np.random.default_rng(0), 0)


class GymRun(OptionRun):
    """Runs options in a Gymnasium env, whose state a snapshot stores; arguments as of OptionPool.

    With ``redrawing`` the env's own generators begin every option with new draws.
    """

    def __init__(
        self,
        env: Any,
        keywords: dict[str, Any],
        snapshot: Any,
        cap: int,
        worker: Any,
        max_steps: int,
        gamma: float,
        redrawing: bool,
        features: Features | None = None,
        still: float = 0.0,
    ) -> None:
        super().__init__(worker, max_steps, gamma)
        if callable(env) and not isinstance(env, CloudpickleWrapper):
            env = CloudpickleWrapper(env)
        parts = (worker, max_steps, gamma, redrawing, features, still)
        self.arguments = (env, keywords, snapshot, cap, *parts)
        self.env: gymnasium.Env = make_gym(env, **keywords)
        self.snapshot: Snapshot = snapshot_of(self.env, snapshot, cap=cap)
        self._layers, self._clocks = env_layers(self.env), time_limits(self.env)
        self._redrawing = redrawing
        self._draws = np.random.Generator(np.random.PCG64(0))
        self._memory = generator_memory(self._draws)
        noting = type(self.snapshot).note_step
        unread = (Snapshot.note_step, AttributeSnapshot.note_step)
        self._notes_actions = noting not in unread
        inner = self.env
        for layer in self._layers:  # which says that a reset comes first, as it does here
            while type(getattr(layer, "env", None)) is OrderEnforcing:
                layer.env = layer.env.env  # type: ignore[attr-defined]
        if type(inner) is OrderEnforcing:
            inner = inner.env
        if type(inner) is TimeLimit and not self._notes_actions:
            self.clock, inner = inner, inner.env
        self.block = next((e for e in self._layers if isinstance(e, PrivateRandom)), self.block)
        self._take = inner.step
        self.step = self._noted_step if self._notes_actions else self._take
        derived = getattr(self.snapshot, "derived", ())
        quick = None if self._notes_actions or derived else quick_step(self.env)
        if quick is not None and len(self._clocks) <= 1:
            self.step, self.block = quick, nullcontext()
            self.clock = self._clocks[0] if self._clocks else None
        observation = self.first_observation()
        self._paths = _paths(observation)
        self._single = self._paths == [()]
        self._flat = (
            [path[0] for path in self._paths] if all(len(p) == 1 for p in self._paths) else None
        )
        leaves = [_leaf(observation, path) for path in self._paths]
        # A number, e.g. of a Discrete space, reaches the worker as a number.
        self._kinds = [None if isinstance(leaf, np.ndarray) else type(leaf) for leaf in leaves]
        keys = [_key(path) for path in self._paths]
        self._before = [f"before {key}" for key in keys]
        self._after = [f"after {key}" for key in keys]
        arrays = [np.asarray(leaf) for leaf in leaves]
        self.outputs = {
            key: (array.shape, array.dtype) for key, array in zip(keys, arrays, strict=True)
        }
        self.outputs[SNAPSHOT_KEY] = ((self.snapshot.width,), np.dtype(np.uint8))
        self.state_keys = list(self.outputs)
        self._features = features
        if features is not None:
            first = features(self.env, observation)
            self.outputs[FEATURES_KEY] = (first.shape, first.dtype)
            if still > 0.0:
                self._window = -(-max_steps // 5)
                self._past = np.zeros((self._window, *first.shape), first.dtype)
                self._still, self._worker_ends = still**2, self.ends
                self.ends = self._rests

    def _rests(self, observation: Any, option: int, steps: int) -> bool:
        """Whether the worker ends the option, or it no longer moves the features."""
        if self._worker_ends is not None and self._worker_ends(observation, option, steps):
            return True
        assert self._features is not None
        here, at = self._features(self.env, observation), steps % self._window
        moved = here - self._past[at]
        self._past[at] = here
        return steps > self._window and float(moved @ moved) < self._still

    def reset(self, generator: np.random.Generator, seed: int | None) -> Any:
        seed = int(generator.integers(2**31)) if seed is None else seed & 0x7FFFFFFF
        self.snapshot.note_reset(seed)
        return self.env.reset(seed=seed)[0]

    def begin(self, slots: dict[str, np.ndarray], index: int) -> tuple[Any, np.random.Generator]:
        self.snapshot.restore(slots[_ROW_BEFORE][index])
        values = [slots[name][index] for name in self._before]
        # Rows of equal states may differ: objects may have been pickled in another order.
        mark = b"".join([value.tobytes() for value in values])
        for clock in self._clocks:
            mark += b"%d " % (clock._elapsed_steps or 0)
        seed = self.seed_of(slots, index, mark)
        if self._redrawing:
            redraw(self._layers, seed)
            self.snapshot.note_redraw(seed)
        start = (seed << 64 | seed).to_bytes(16, "little") + (seed << 1 | 1).to_bytes(16, "little")
        if self._memory is None:
            set_generator_state(self._draws, start + bytes(8))
        else:
            self._memory[0][:], self._memory[1][:] = start, bytes(8)
        values = [
            value.copy() if kind is None else kind(value)
            for value, kind in zip(values, self._kinds, strict=True)
        ]
        if not self._notes_actions:  # one note is enough
            self.snapshot.note_step(None)
        if self._single:
            return values[0], self._draws
        if self._flat is not None:
            return dict(zip(self._flat, values, strict=True)), self._draws
        return _nested(self._paths, values), self._draws

    def _noted_step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        self.snapshot.note_step(action)
        return self._take(action)

    def write(self, slots: dict[str, np.ndarray], index: int, observation: Any) -> None:
        if self._redrawing and not self._notes_actions:  # equal states have equal rows
            redraw(self._layers, 0)
        slots[_ROW_AFTER][index] = self.snapshot.read()
        for name, path in zip(self._after, self._paths, strict=True):
            slots[name][index] = _leaf(observation, path)
        if self._features is not None:
            slots[_FEATURES][index] = self._features(self.env, observation)

    def check_action(self, action: Any) -> str:
        space = self.env.action_space
        if isinstance(space, gymnasium.spaces.Box):  # whose bounds the env itself keeps
            fits = np.shape(action) == space.shape and bool(np.isfinite(action).all())
        else:
            fits = space.contains(action)
        return "" if fits else f"the actions of {self.env} are {space}"

    def render(self, slots: dict[str, np.ndarray], index: int) -> Any:
        self.begin(slots, index)
        return self.env.render()


def _paths(observation: Any) -> list[tuple[str, ...]]:
    """Where the arrays of an observation are; ``[()]`` where it is one."""
    if not isinstance(observation, dict):
        return [()]
    return [(name, *path) for name, part in observation.items() for path in _paths(part)]


def _key(path: tuple[str, ...]) -> Any:
    return "observation" if not path else path[0] if len(path) == 1 else path


def _leaf(observation: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        observation = observation[name]
    return observation


def _nested(paths: list[tuple[str, ...]], values: list[Any]) -> dict[str, Any]:
    whole: dict[str, Any] = {}
    for (*outer, name), value in zip(paths, values, strict=True):
        part = whole
        for key in outer:
            part = part.setdefault(key, {})
        part[name] = value
    return whole
