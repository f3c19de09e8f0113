"""A pool of Atari emulators as a macro environment: one step is a whole option.

Letters: *B batch of the tensordict, m its elements, T ``max_steps``.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_hmcts.envs.atari.emulator import AtariEmulator
from torchrl_hmcts.envs.atari.process import (
    NUM_SLOTS,
    EmulatorProcesses,
    OptionRun,
    run_option,
    slot_type,
)
from torchrl_hmcts.envs.atari.ram import NO_OP_STARTS, atari_specs
from torchrl_hmcts.envs.atari.workers import OptionWorker


class PendingStep:
    """A step of a pool that was begun: the ticket of :meth:`AtariOptionPool.step_async`."""

    def __init__(self, pool: AtariOptionPool, tensordict: TensorDictBase) -> None:
        self.pool, self.tensordict = pool, tensordict
        self.slots: list[int] = []  # whose options are under way
        self.done: list[np.ndarray] = []  # each [k] of slot_type: outcomes of those before them
        self.used = False

    def __reduce__(self) -> Any:
        raise TypeError("A step that is under way can be neither copied nor sent.")


class AtariOptionPool(EnvBase):
    r"""Options of an Atari game, carried out by a worker inside processes that emulate.

    The action is an option. A step takes each state of the batch to the end of its option: the
    worker acts on the RAM until ``max_steps``, its own ``ends``, or the end of the game. With
    :math:`r_{i+1}` the game's rewards, :math:`l_{i+1}` the lives lost, :math:`p` the
    ``life_loss_penalty`` and :math:`k` the steps taken, it writes

    .. math:: \text{reward} = \sum_{i<k} \gamma^i (r_{i+1} - p\, l_{i+1}), \qquad
        \text{duration} = k.

    Stateless: the state is in the tensordict, ``"emulator_state"`` (uint8 ``[*B, about 530]``), of
    :class:`AtariRAMEnv` or of a pool, and any batch can be stepped, so a planner searches in it and
    an agent plays in it. ``num_processes`` emulate at a time: a wave of the planner wants
    ``leaves_per_wave`` a few times as large.

    An outcome is a function of state, option, the worker's weights and the pool's seed, whichever
    process finds it: the worker's random choices and sticky actions are drawn from these. So a
    search can be repeated, and in the deterministic protocol what was planned is what happens. With
    ``determinised=False`` every call draws anew, for a planner that samples options more than once
    (``chance=ProgressiveWidening()``).

    A process that dies, is stopped or hangs for ``step_seconds`` is started again and its options
    run again; ``num_restarts`` counts them, ``num_frames`` counts all emulated frames, also those
    that were lost. The processes start with the first step. A copy of a pool has processes of
    its own; in a forked process, and in one that may have none, such as a worker of a
    ``DataLoader``, options run as with ``num_processes=0``. Threads take turns.

    Writes, besides the entries of :class:`AtariRAMEnv`: ``"duration"`` (int64 ``[*B, 1]``, steps of
    ``frame_skip`` frames), ``"score"`` (float32 ``[*B, 1]``, :math:`\sum r_{i+1}`, undiscounted and
    without penalty) and ``"life_losses"`` (float32 ``[*B, 1]``, discounted sum of :math:`l`).

    Args:
        game (str): e.g. ``"Breakout"``.
        worker (OptionWorker): ``worker.act(ram, option, generator)`` gives the next action; see
            :mod:`~torchrl_hmcts.envs.atari.workers`. It is sent to each process once; weights in
            shared memory stay shared, so that updates are seen at once.
        max_steps (int): T.
        num_processes (int, optional): 0 runs the options in the calling process. Default: one for
            each core.
        gamma (float): discount per step; the planner takes it over. Default 0.99.
        life_loss_penalty (float): p; an attribute of the same name may be changed at any time, e.g.
            to the greatest reward seen. For planning: play without. Default 0.
        end_on_life_loss (bool): whether an option ends when a life is lost. Default False.
        determinised (bool): see above. Default True.
        record (bool): also write the steps inside the option: ``"inner_ram"`` (uint8 ``[*B, T,
            128]``, before each action), ``"inner_action"`` (int64 ``[*B, T]``) and
            ``"inner_reward"`` (float32 ``[*B, T]``); of them the first ``duration`` have a meaning.
            Default False.
        frame_skip, full_action_space, max_frames, mode, difficulty, noop_max, read_outs: as in
            :class:`AtariRAMEnv`.
        repeat_action_probability (float): Default 0, for planning. To play under sticky actions
            make another pool with 0.25 and a seed that the planner does not know.
        start_method ("forkserver" or "spawn"): how processes are started. Default forkserver, or
            spawn where the path of the temporary folder (``TMPDIR``) is too long for it. As
            always with :mod:`multiprocessing`, a script needs ``if __name__ == "__main__":``.
        step_seconds (float): longest time for one step of the worker and the emulator, seconds;
            processes that neither step nor use the processor for so long are replaced. Default 60.
        batch_size (sequence of int): of ``reset()`` without a tensordict. Default none.
        seed (int, optional): of starts and of the draws inside options.

    Raises:
        ImportError: if ale-py is not installed.
        ValueError: if an argument is out of range; when stepping, if an option is.
        RuntimeError: when stepping, if the worker raises an error, or processes die or hang again
            and again.
        OSError: if there is too little shared memory or too few file descriptors, or when stepping,
            if processes cannot be started.

    Reference:
        Sutton, Precup and Singh, "Between MDPs and semi-MDPs", 1999; dissertation, chapter 5.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool, RepeatActions
        >>> from torchrl_hmcts.planners import PUCT, MCTSPlanner, SearchBudget
        >>> worker = RepeatActions(4)
        >>> pool = AtariOptionPool("Breakout", worker, max_steps=5, num_processes=0, seed=0)
        >>> planner = MCTSPlanner(pool, tree_policy=PUCT(), expand="one", leaves_per_wave=4,
        ...                       budget=SearchBudget(base_steps=100, until_plan=False))
        >>> td = pool.rollout(3, policy=planner)
        >>> td["next", "duration"].flatten().tolist()
        [5, 5, 5]
        >>> pool.close()
    """

    batch_locked = False
    _supports_set_state = True
    _has_frame_skip = True
    metadata = {"render_modes": ["rgb_array"], "render_fps": 60}

    def __init__(
        self,
        game: str,
        worker: OptionWorker,
        *,
        max_steps: int,
        num_processes: int | None = None,
        gamma: float = 0.99,
        life_loss_penalty: float = 0.0,
        end_on_life_loss: bool = False,
        determinised: bool = True,
        record: bool = False,
        frame_skip: int = 4,
        repeat_action_probability: float = 0.0,
        full_action_space: bool = False,
        noop_max: int | None = None,
        max_frames: int = 108_000,
        mode: int | None = None,
        difficulty: int | None = None,
        read_outs: Sequence[str] = ("ram", "observation"),
        start_method: Literal["forkserver", "spawn"] = "forkserver",
        step_seconds: float = 60.0,
        batch_size: Sequence[int] = (),
        seed: int | None = None,
    ) -> None:
        if num_processes is None:
            num_processes = len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1
        for name, value, low in (("max_steps", max_steps, 1), ("num_processes", num_processes, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                raise ValueError(
                    f"AtariOptionPool needs {name} to be an int >= {low}; got {value!r}."
                )
        if num_processes and sys.platform == "win32":
            raise ValueError(
                "AtariOptionPool feeds its processes through POSIX pipes, which Windows has not. "
                "Use num_processes=0 there, which emulates in the calling process."
            )
        if not step_seconds > 0.0:
            raise ValueError(f"AtariOptionPool needs step_seconds > 0; got {step_seconds}.")
        if not 0.0 < gamma <= 1.0:
            raise ValueError(f"AtariOptionPool needs a discount gamma in (0, 1]; got {gamma}.")
        if start_method not in ("forkserver", "spawn"):
            raise ValueError(
                f'AtariOptionPool starts processes by "forkserver" or "spawn"; got '
                f"{start_method!r}. Forked ones would inherit pipes and threads."
            )
        if noop_max is None:
            noop_max = 0 if repeat_action_probability > 0.0 else NO_OP_STARTS
        run = OptionRun(
            emulator={
                "game": game,
                "frame_skip": frame_skip,
                "repeat_action_probability": repeat_action_probability,
                "full_action_space": full_action_space,
                "max_frames": max_frames,
                "mode": mode,
                "difficulty": difficulty,
                "noop_max": noop_max,
            },
            max_steps=max_steps,
            gamma=float(gamma),
            end_on_life_loss=bool(end_on_life_loss),
            record=bool(record),
        )
        emulator = AtariEmulator(**run.emulator)
        _check_worker(worker, emulator)
        super().__init__(batch_size=torch.Size(batch_size))
        self.game = emulator.game
        self.worker = worker
        self.num_options = int(worker.num_options)
        self.num_processes = num_processes
        self.max_steps, self.gamma = max_steps, run.gamma
        self.life_loss_penalty = float(life_loss_penalty)
        self.determinised = bool(determinised)
        self.frame_skip = frame_skip
        self.action_names = emulator.action_names
        self._read_outs = tuple(read_outs)
        self._run = run
        self._emulator = emulator
        self._drawing: AtariEmulator | None = None  # made when first needed
        self._start_method, self._step_seconds = start_method, float(step_seconds)
        self._own_frames = np.zeros(1, np.int64)
        self._make_slots()
        self.on_step: Callable[[TensorDictBase, TensorDictBase], object] | None = None
        """Called with what was stepped and what came of it, e.g. to keep what a search simulates
        (with ``record=True`` the steps inside the options, too)."""
        self._set_specs(emulator.states.width)
        self.set_seed(int(torch.empty((), dtype=torch.int64).random_()) if seed is None else seed)

    def _make_slots(self, forked: bool = False) -> None:
        """Begin with no step under way, in the process that this is."""
        self._owner, self._lock = os.getpid(), threading.RLock()
        width = self._emulator.states.width
        self._processes: EmulatorProcesses | None = None
        alone = forked or multiprocessing.current_process().daemon
        if self.num_processes and not alone:
            self._processes = EmulatorProcesses(
                self.num_processes,
                width,
                self._run,
                self.worker,
                self._start_method,
                self._step_seconds,
            )
            self._slots = self._processes.slots
        else:
            self._slots = np.zeros(NUM_SLOTS, slot_type(width, self._run))
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

    def _set_specs(self, width: int) -> None:
        shape = self.batch_size
        self.state_spec, observed = atari_specs(self._read_outs, width, shape, None)

        def numbers(*size: int, dtype: torch.dtype) -> Any:
            return Unbounded((*shape, *size), dtype=dtype)

        observed["duration"] = numbers(1, dtype=torch.int64)
        observed["score"] = numbers(1, dtype=torch.float32)
        observed["life_losses"] = numbers(1, dtype=torch.float32)
        if self._run.record:
            observed["inner_ram"] = numbers(self.max_steps, 128, dtype=torch.uint8)
            observed["inner_action"] = numbers(self.max_steps, dtype=torch.int64)
            observed["inner_reward"] = numbers(self.max_steps, dtype=torch.float32)
        self.observation_spec = observed
        self.action_spec = Composite(
            {"option": Categorical(self.num_options, shape=shape)}, shape=shape
        )
        self.reward_spec = Unbounded((*shape, 1), dtype=torch.float32)
        done = {key: Binary(1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done).expand(shape)

    def _set_seed(self, seed: int | None) -> None:
        words = np.random.SeedSequence(seed).generate_state(2)
        self._generator = np.random.default_rng(int(words[0]))
        self._first_seed: int | None = int(words[1].astype(np.int32))
        self._key = int(words.view(np.uint64)[0] >> 1)
        self._num_calls = 0

    # ---------------------------------------------------------------- what it cost

    @property
    def num_frames(self) -> int:
        """Frames emulated so far, by all processes and for all purposes."""
        own = int(self._emulator.num_frames)
        return own + (0 if self._processes is None else self._processes.num_frames)

    @property
    def num_restarts(self) -> int:
        """Processes that died and were started anew."""
        return 0 if self._processes is None else self._processes.num_restarts

    @property
    def pids(self) -> list[int]:
        """Ids of the processes that run."""
        return [] if self._processes is None else self._processes.pids

    # ---------------------------------------------------------------- playing

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        with self._turn():
            return self._reset_alone(tensordict, **kwargs)

    def _reset_alone(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        shape = self.batch_size if tensordict is None else tensordict.batch_size
        to_state = bool(kwargs.get("set_state"))
        rows = self._rows(tensordict) if to_state else None
        out = self._begin(shape.numel())
        for i in range(shape.numel()):
            if rows is not None:
                self._emulator.set_state(rows[i])
            else:
                seed, self._first_seed = self._first_seed, None
                self._emulator.reset(self._generator, seed)
            self._emulator.read_ram(out["ram"][i])
            out["emulator_state"][i] = self._emulator.state() if rows is None else rows[i]
            out["lives"][i] = self._emulator.lives
            out["episode_frame"][i] = self._emulator.episode_frame
        return self._observed(out, shape)

    def _rows(self, tensordict: TensorDictBase | None) -> np.ndarray:
        row = None if tensordict is None else tensordict.get("emulator_state", None)
        if row is None:
            raise ValueError(
                'AtariOptionPool goes on from the state under "emulator_state", which the '
                "tensordict has not. Pass what reset() or a step wrote."
            )
        # Rows of an AtariRAMEnv may hold its random generator, which is not a planner's to know.
        width = self._emulator.states.width
        rows = _array(row)[..., :width]
        if rows.shape[-1] != width:
            raise ValueError(
                f'A state of {self.game} under "emulator_state" has {width} bytes (or more, with a '
                f"random generator); got {rows.shape[-1]}. Pass what reset() or a step wrote."
            )
        return rows.reshape(-1, rows.shape[-1])

    def _begin(self, count: int) -> dict[str, np.ndarray]:
        """Arrays ``[count, ...]`` of everything that is observed, zeros."""
        out = {
            "emulator_state": np.zeros((count, self._emulator.states.width), np.uint8),
            "ram": np.zeros((count, 128), np.uint8),
        }
        for key in ("lives", "episode_frame", "duration"):
            out[key] = np.zeros((count, 1), np.int64)
        for key in ("score", "life_losses"):
            out[key] = np.zeros((count, 1), np.float32)
        if self._run.record:
            steps = self.max_steps
            out["inner_ram"] = np.zeros((count, steps, 128), np.uint8)
            out["inner_action"] = np.zeros((count, steps), np.int64)
            out["inner_reward"] = np.zeros((count, steps), np.float32)
        return out

    def _observed(self, out: dict[str, np.ndarray], shape: torch.Size) -> TensorDict:
        if "observation" in self._read_outs:  # by numpy: torch is slow where its code is not cached
            out["observation"] = out["ram"] / np.float32(255.0)
        if "ram" not in self._read_outs:
            del out["ram"]
        entries = {key: torch.from_numpy(value) for key, value in out.items()}
        if len(shape) != 1:
            entries = {k: v.reshape(*shape, *v.shape[1:]) for k, v in entries.items()}
        return TensorDict._new_unsafe(entries, shape)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.step_wait(self.step_async(tensordict))

    def step_async(self, tensordict: TensorDictBase) -> PendingStep:
        """Begin a step, on which the processes work while the caller goes on.

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
            return self._begin_step(tensordict)

    def _begin_step(self, tensordict: TensorDictBase) -> PendingStep:
        rows = self._rows(tensordict)
        options = _array(tensordict.get("option")).reshape(-1)
        count = len(rows)
        if count and not (0 <= options.min() and options.max() < self.num_options):
            bad = int(options.min()) if options.min() < 0 else int(options.max())
            raise ValueError(
                f"Option {bad} does not exist: the worker's are 0 to {self.num_options - 1}."
            )
        seeds = np.full(count, self._key)
        if not self.determinised:
            seeds = (self._key + self._num_calls + np.arange(count)) & np.iinfo(np.int64).max
            self._num_calls += count
        ticket, begin = PendingStep(self, tensordict), 0
        self._under_way.append(ticket)
        try:
            while begin < count:
                self._make_room(min(count - begin, NUM_SLOTS))
                slots = self._free[: count - begin]
                part = slice(begin, begin + len(slots))
                for field, values in (("state", rows), ("option", options), ("seed", seeds)):
                    self._slots[field][slots] = values[part]
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
            return self._end_step(ticket)

    def _end_step(self, ticket: PendingStep) -> TensorDictBase:
        if ticket.used or ticket not in self._under_way:
            raise RuntimeError(
                "This step was waited for before, and its outcome returned then, or given up. Call "
                "step_async again to take another."
            )
        try:
            self._settle(ticket)
        finally:
            self._forget(ticket)
        used = ticket.done[0] if len(ticket.done) == 1 else np.concatenate(ticket.done)
        result = self._outcome(used, ticket.tensordict.batch_size)
        if self.on_step is not None:
            self.on_step(ticket.tensordict, result)
        return result

    def step_abandon(self, ticket: PendingStep) -> None:
        """Give up a step that was begun: its outcome, or error, is nobody's.

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
            ticket.done.append(self._slots[slots])
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
            run_option(self._emulator, self.worker, self._run, self._slots, i, self._own_frames)

    def _outcome(self, used: np.ndarray, shape: torch.Size) -> TensorDict:
        """What a step writes, from slots whose options have been run."""
        out = {"emulator_state": used["after"].copy(), "ram": used["ram"].copy()}
        for key in ("lives", "episode_frame", "duration"):
            out[key] = used[key].reshape(-1, 1)
        for key in ("score", "life_losses"):
            out[key] = used[key].astype(np.float32).reshape(-1, 1)
        for key in ("terminated", "truncated"):
            out[key] = used[key].reshape(-1, 1)
        out["done"] = out["terminated"] | out["truncated"]
        rewards = used["reward"].astype(np.float32).reshape(-1, 1)
        out["reward"] = rewards - np.float32(self.life_loss_penalty) * out["life_losses"]
        if self._run.record:
            for key in ("inner_ram", "inner_action", "inner_reward"):
                out[key] = used[key].copy()
        return self._observed(out, shape)

    def render(self, tensordict: TensorDictBase) -> np.ndarray:
        """Return a state's picture, uint8 ``[210, 160, 3]``; see :meth:`AtariRAMEnv.render`."""
        with self._turn():
            if self._drawing is None:
                config = {**self._run.emulator, "frame_skip": 1, "repeat_action_probability": 0.0}
                self._drawing = AtariEmulator(**config)
            self._drawing.set_state(self._rows(tensordict)[0])
            self._drawing.act(0)
            return self._drawing.screen()

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Stop the processes."""
        if self._owner == os.getpid():
            with self._lock:
                if self._processes is not None:
                    self._processes.stop()
        super().close(raise_if_closed=raise_if_closed)


# What a copy in another process makes for itself.
_OF_ONE_PROCESS = {"_owner", "_lock", "_processes", "_slots", "_free", "_under_way", "on_step"}


def _array(tensor: Tensor) -> np.ndarray:
    array: np.ndarray = (tensor if tensor.is_cpu else tensor.cpu()).numpy()
    return array


def _check_worker(worker: Any, emulator: AtariEmulator) -> None:
    """Refuse a worker that cannot act, before it is sent to the processes."""
    num_options = getattr(worker, "num_options", None)
    if not isinstance(num_options, int) or num_options < 1 or not hasattr(worker, "act"):
        raise ValueError(
            f"AtariOptionPool needs a worker with num_options (an int >= 1) and "
            f"act(ram, option, generator) -> action index; got {worker!r}. See RepeatActions and "
            f"SharedMLP in torchrl_hmcts.envs."
        )
    ram = np.zeros(128, np.uint8)
    emulator.read_ram(ram)
    for option in range(num_options):
        action = worker.act(ram.copy(), option, np.random.default_rng(0))
        if not isinstance(action, (int, np.integer)) or not 0 <= action < emulator.num_actions:
            raise ValueError(
                f"The worker {type(worker).__name__} took the action {action!r} in option "
                f"{option}; {emulator.game} has the actions 0 to {emulator.num_actions - 1}: "
                f"{', '.join(emulator.action_names)}."
            )
