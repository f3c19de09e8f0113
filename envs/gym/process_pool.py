"""A macro environment whose steps are whole options, run inside processes.

Letters: *B batch of the tensordict, m its elements.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.direct_calls import put
from torchrl_hmcts.envs.gym.option_run import OptionRun
from torchrl_hmcts.envs.gym.processes import NUM_SLOTS, OptionProcesses, fields_of


class PendingStep:
    """A step of a pool that was begun: the ticket of :meth:`ProcessPool.step_async`."""

    def __init__(self, pool: ProcessPool, tensordict: TensorDictBase) -> None:
        self.pool, self.tensordict = pool, tensordict
        self.slots: list[int] = []  # whose options are under way
        self.done: list[dict[str, np.ndarray]] = []  # [k, ...] outcomes of those before them
        self.used = False

    def __reduce__(self) -> Any:
        raise TypeError("A step that is under way can be neither copied nor sent.")


class ProcessPool(EnvBase):
    """What all pools share: slots, tickets, processes, threads, copies and specs."""

    batch_locked = False
    _supports_set_state = True

    def __init__(
        self,
        run: OptionRun,
        *,
        num_processes: int | None,
        determinised: bool,
        start_method: str,
        step_seconds: float,
        batch_size: Sequence[int],
        seed: int | None,
    ) -> None:
        owner = type(self).__name__
        if num_processes is None:
            num_processes = len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1
        num_processes = whole_number(owner, "num_processes", num_processes)
        if num_processes and sys.platform == "win32":
            raise ValueError(
                f"{owner} sends data to its processes through POSIX pipes, which Windows lacks. "
                "Use num_processes=0 there, which runs options in the calling process."
            )
        if start_method not in ("forkserver", "spawn"):
            raise ValueError(
                f'{owner} starts processes by "forkserver" or "spawn"; got {start_method!r}. '
                "Forked ones would inherit pipes and threads."
            )
        run.check_worker(owner)
        super().__init__(batch_size=torch.Size(batch_size))
        self.worker, self.num_options = run.worker, int(run.worker.num_options)
        self.max_steps, self.gamma = run.max_steps, run.gamma
        self.num_processes = num_processes
        self.determinised = bool(determinised)
        self._run = run
        self._start_method = start_method
        self._step_seconds = real_number(owner, "step_seconds", step_seconds, above=0.0)
        self._make_slots()
        self.on_step: Callable[[TensorDictBase, TensorDictBase], object] | None = None
        """Called with what was stepped and its outcome, e.g. to keep what a search tries."""
        self._set_specs()
        self.set_seed(int(torch.empty((), dtype=torch.int64).random_()) if seed is None else seed)

    def _make_slots(self, forked: bool = False) -> None:
        """Begin with no step under way, in the process that this is."""
        self._owner, self._lock = os.getpid(), threading.RLock()
        self._processes: OptionProcesses | None = None
        alone = forked or multiprocessing.current_process().daemon
        if self.num_processes and not alone:
            self._processes = OptionProcesses(
                type(self).__name__,
                self.num_processes,
                self._run,
                self._start_method,
                self._step_seconds,
            )
            self._slots = self._processes.slots
        else:
            self._slots = np.zeros(NUM_SLOTS, self._run.slot_type())
        self._fields = fields_of(self._slots)
        self._inputs = {"option", "seed", *(f"before {key}" for key in self._run.state_keys)}
        self._free = list(range(NUM_SLOTS))  # slots that no step under way uses
        self._under_way: list[PendingStep] = []

    @contextlib.contextmanager
    def _turn(self) -> Iterator[None]:
        """Let one thread at a time in; in a forked process, leave the slots to their owner."""
        if self._owner != os.getpid():
            self._make_slots(forked=True)
        with self._lock:
            yield

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in _OF_ONE_PROCESS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.on_step = None
        self._make_slots()

    def _set_specs(self) -> None:
        shape = self.batch_size
        observed: dict[Any, Any] = {
            key: Unbounded((*shape, *size), dtype=torch.from_numpy(np.empty(0, dtype)).dtype)
            for key, (size, dtype) in self._entries().items()
        }
        state = {key: observed[key].clone() for key in self._run.state_keys}
        observed["duration"] = Unbounded((*shape, 1), dtype=torch.int64)
        self.state_spec = Composite(state, shape=shape)
        self.observation_spec = Composite(observed, shape=shape)
        self.action_spec = Composite(
            {"option": Categorical(self.num_options, shape=shape)}, shape=shape
        )
        self.reward_spec = Unbounded((*shape, 1), dtype=torch.float32)
        done = {key: Binary(1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done).expand(shape)

    def _entries(self) -> dict[Any, Any]:
        """Shapes and dtypes of what is observed beside the duration."""
        return self._run.outputs

    def _set_seed(self, seed: int | None) -> None:
        words = np.random.SeedSequence(seed).generate_state(2)
        self._generator = np.random.default_rng(int(words[0]))
        self._first_seed: int | None = int(words[1].astype(np.int32))
        self._key = int(words.view(np.uint64)[0] >> 1)
        self._num_calls = 0

    # ---------------------------------------------------------------- what it cost

    @property
    def num_steps(self) -> int:
        """Base steps taken so far, by all processes and for all purposes."""
        return int(self._run.work[0]) + (0 if self._processes is None else self._processes.work)

    @property
    def num_restarts(self) -> int:
        """Processes that died and were started again."""
        return 0 if self._processes is None else self._processes.num_restarts

    @property
    def pids(self) -> list[int]:
        """Ids of the processes that run."""
        return [] if self._processes is None else self._processes.pids

    # ---------------------------------------------------------------- playing

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        with self._turn():
            shape = self.batch_size if tensordict is None else tensordict.batch_size
            given = self._rows(tensordict) if kwargs.get("set_state") else {}
            begun = np.zeros(shape.numel(), self._run.slot_type())
            fields = fields_of(begun)
            for key, rows in given.items():
                fields[f"before {key}"][:] = rows
            for i in range(shape.numel()):
                if given:
                    observation, _ = self._run.begin(fields, i)
                else:
                    seed, self._first_seed = self._first_seed, None
                    observation = self._run.reset(self._generator, seed)
                self._run.write(fields, i, observation)
            for key, rows in given.items():
                fields[f"after {key}"][:] = rows
            copied = {name: field.copy() for name, field in fields.items()}
            return self._observed(self._entries_in(copied), shape)

    def _rows(self, tensordict: TensorDictBase | None) -> dict[Any, np.ndarray]:
        """Return the entries of the state, ``[m, ...]``, after checking them."""
        rows = {}
        for key in self._run.state_keys:
            value = None if tensordict is None else tensordict.get(key, None)
            size = self._run.outputs[key][0]
            if value is None:
                raise ValueError(
                    f"{type(self).__name__} continues from the state under {key!r}, which the "
                    "tensordict lacks. Pass a tensordict from reset() or a step."
                )
            array = self._cut(_array(value))
            if array.shape[len(tensordict.batch_size) :] != size:  # type: ignore[union-attr]
                raise ValueError(
                    f"A state under {key!r} has {list(size)} numbers; got "
                    f"{list(array.shape[len(tensordict.batch_size) :])}. "  # type: ignore[union-attr]
                    "Pass what reset() or a step wrote."
                )
            rows[key] = array.reshape(-1, *size)
        return rows

    def _cut(self, rows: np.ndarray) -> np.ndarray:
        """Leave out what of a state is not a planner's to know."""
        return rows

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.step_wait(self.step_async(tensordict))

    def step_async(self, tensordict: TensorDictBase) -> PendingStep:
        """Begin a step, on which the processes work while the caller continues.

        Several can be under way, of 512 options together; then the oldest are waited for, as the
        first parts of a larger batch are. With ``num_processes=0`` a step is done at once.

        Args:
            tensordict: what a step reads, of any batch shape. ``on_step`` is given it, too.

        Returns:
            A ticket for :meth:`step_wait` or :meth:`step_abandon`.

        Raises:
            ValueError: if an option does not exist.
        """
        with self._turn():
            rows = self._rows(tensordict)
            options = _array(tensordict.get("option")).reshape(-1)
            count = len(options)
            if count and not (0 <= options.min() and options.max() < self.num_options):
                bad = int(options.min()) if options.min() < 0 else int(options.max())
                raise ValueError(
                    f"Option {bad} does not exist: the worker's are 0 to {self.num_options - 1}."
                )
            seeds = np.full(count, self._key)
            if not self.determinised:
                seeds = (self._key + self._num_calls + np.arange(count)) & np.iinfo(np.int64).max
                self._num_calls += count
            inputs = {f"before {key}": value for key, value in rows.items()}
            inputs.update(option=options, seed=seeds)
            ticket, begin = PendingStep(self, tensordict), 0
            self._under_way.append(ticket)
            try:
                while begin < count:
                    self._make_room(min(count - begin, NUM_SLOTS))
                    slots = self._free[: count - begin]
                    part = slice(begin, begin + len(slots))
                    for name, values in inputs.items():
                        self._fields[name][slots] = values[part]
                    del self._free[: len(slots)]
                    ticket.slots = slots
                    self._submit(slots)
                    begin = part.stop
            except BaseException:
                self.step_abandon(ticket)
                raise
            return ticket

    def step_wait(self, ticket: PendingStep) -> TensorDictBase:
        """Wait for a step that was begun and return what it writes as next.

        Args:
            ticket: from :meth:`step_async`; each counts once.

        Raises:
            RuntimeError: if the worker raises an error, the processes were stopped meanwhile, or
                the ticket was used before.
            ValueError: if the ticket is of another pool.
        """
        if ticket.pool is not self:
            raise ValueError(
                "This step was begun by another pool; wait for it there, in ticket.pool."
            )
        with self._turn():
            if ticket.used or ticket not in self._under_way:
                raise RuntimeError(
                    "The outcome of this step was returned or dropped before. Call step_async to "
                    "take another step."
                )
            try:
                self._settle(ticket)
            finally:
                self._forget(ticket)
            fields, *further = ticket.done
            if further:
                fields = {name: np.concatenate([p[name] for p in ticket.done]) for name in fields}
            out = self._entries_in(fields)
            for key in ("reward", "terminated", "truncated"):
                out[key] = fields[key]
            out["done"] = out["terminated"] | out["truncated"]
            result = self._observed(out, ticket.tensordict.batch_size)
            if self.on_step is not None:
                self.on_step(ticket.tensordict, result)
            return result

    def step_abandon(self, ticket: PendingStep) -> None:
        """Give up a step that was begun: its outcome, or error, is dropped.

        Blocks until its options have been run, unless the processes have been stopped.
        """
        with self._turn():
            if ticket.pool is self and not ticket.used and ticket in self._under_way:
                with contextlib.suppress(RuntimeError):
                    self._settle(ticket)
                self._forget(ticket)

    def _make_room(self, count: int) -> None:
        """Wait for the oldest steps until so many slots are free."""
        for ticket in self._under_way:
            if len(self._free) >= count:
                break
            self._settle(ticket)

    def _settle(self, ticket: PendingStep) -> None:
        """Wait for the options of a ticket that are under way and take their outcomes."""
        slots, ticket.slots = ticket.slots, []
        try:
            if slots and self._processes is not None:
                self._processes.wait(slots)
            at = np.array(slots, np.int64)
            outcomes = {n: f[at] for n, f in self._fields.items() if n not in self._inputs}
            ticket.done.append(outcomes)
        finally:
            self._free += slots

    def _forget(self, ticket: PendingStep) -> None:
        ticket.used = True
        self._under_way.remove(ticket)

    def _submit(self, slots: list[int]) -> None:
        if self._processes is not None:
            self._processes.submit(slots)
            return
        for i in slots:
            self._run.run(self._fields, i)

    def _entries_in(self, fields: dict[str, np.ndarray]) -> dict[Any, np.ndarray]:
        """Return what is observed, from the fields of outcomes."""
        out: dict[Any, np.ndarray] = {key: fields[f"after {key}"] for key in self._run.outputs}
        out["duration"] = fields["duration"]
        return out

    def _observed(self, out: dict[Any, np.ndarray], shape: torch.Size) -> TensorDict:
        if len(shape) != 1:
            out = {key: value.reshape((*shape, *value.shape[1:])) for key, value in out.items()}
        observed = TensorDict({}, shape)
        for key, value in out.items():
            put(observed, key, torch.from_numpy(value))
        return observed

    def render(self, tensordict: TensorDictBase) -> Any:
        """Draw a state.

        Args:
            tensordict: one state, as ``reset()`` or a step wrote it.

        Returns:
            The picture, as the env draws it.
        """
        with self._turn():
            fields = fields_of(np.zeros(1, self._run.slot_type()))
            for key, rows in self._rows(tensordict).items():
                fields[f"before {key}"][0] = rows[0]
            return self._run.render(fields, 0)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Stop the processes."""
        if self._owner == os.getpid():
            with self._lock:
                if self._processes is not None:
                    self._processes.stop()
        super().close(raise_if_closed=raise_if_closed)


# What a copy in another process makes for itself.
_OF_ONE_PROCESS = {
    "_owner", "_lock", "_processes", "_slots", "_fields", "_free", "_under_way", "on_step",
}  # fmt: skip


def _array(tensor: Tensor) -> np.ndarray:
    array: np.ndarray = (tensor if tensor.is_cpu else tensor.cpu()).numpy()
    return array
