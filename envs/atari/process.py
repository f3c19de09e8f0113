"""Processes that run options on emulators, one emulator each, fed through shared memory.

Jobs are slots of a shared array: a state, an option and a seed go in, the outcome comes back in the
same slot. What goes through pipes is the number of a slot, once per option: all processes read from
one pipe, so that whoever is free takes the next.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import signal
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.envs.atari.emulator import AtariEmulator
from torchrl_hmcts.envs.atari.workers import OptionWorker
from torchrl_hmcts.processes import (
    Silence,
    cpu_ticks,
    need_descriptors,
    share,
    start_context,
    system_errors,
    wake_with_parent,
)

NUM_SLOTS = 512
"""Options that can be under way at once; larger batches are run in several goes."""

_NUMBER = np.dtype("<i4")
_MAX_MESSAGE = 4000  # of an error; what a pipe takes at once
_DEATHS_IN_A_ROW = 5
_SILENCES_IN_A_ROW = 2
_LOOK_MILLISECONDS = 500
_PRELOAD = __name__.replace("process", "preload")


@dataclass(frozen=True)
class OptionRun:
    """How options are run.

    Attributes:
        emulator: keywords of :class:`AtariEmulator`.
        max_steps: steps after which an option ends.
        gamma: discount per step.
        end_on_life_loss: whether an option ends when a life is lost.
        record: whether the steps inside the option are kept.
    """

    emulator: dict[str, Any]
    max_steps: int
    gamma: float
    end_on_life_loss: bool = False
    record: bool = False


def slot_type(width: int, run: OptionRun) -> np.dtype:
    """Return the type of a job and its outcome, for states of ``width`` bytes."""
    fields: list[Any] = [
        ("state", np.uint8, (width,)),  # in
        ("option", np.int64),
        ("seed", np.int64),
        ("after", np.uint8, (width,)),  # out
        ("ram", np.uint8, (128,)),
        ("reward", np.float64),  # discounted sum
        ("score", np.float64),  # plain sum
        ("life_losses", np.float64),  # discounted sum
        ("duration", np.int64),
        ("lives", np.int64),
        ("episode_frame", np.int64),
        ("terminated", np.bool_),
        ("truncated", np.bool_),
    ]
    if run.record:
        fields += [
            ("inner_ram", np.uint8, (run.max_steps, 128)),  # before each action
            ("inner_action", np.int64, (run.max_steps,)),
            ("inner_reward", np.float32, (run.max_steps,)),
        ]
    return np.dtype(fields, align=True)


def run_option(
    emulator: AtariEmulator,
    worker: OptionWorker,
    run: OptionRun,
    slots: np.ndarray,
    index: int,
    frames: np.ndarray,
) -> None:
    """Run the option in one slot to its end and write the outcome.

    Args:
        emulator: set to the slot's state first.
        worker: chooses the actions.
        run: when the option ends, and what is kept.
        slots: ``[S]`` of :func:`slot_type`.
        index: which slot.
        frames: int64 ``[1]``, counted up by the frames emulated, step by step.
    """
    slot = slots[index]
    option = int(slot["option"])
    seed = _mixed(int(slot["seed"]), option, slots["state"][index])
    generator = np.random.default_rng(seed)
    ends = getattr(worker, "ends", None)
    before = emulator.num_frames
    ram = slots["ram"][index]
    emulator.set_state(slots["state"][index], seed & 0x7FFFFFFF)
    emulator.read_ram(ram)
    reward = score = life_losses = 0.0
    discount = 1.0
    for step in range(run.max_steps):
        action = worker.act(ram, option, generator)
        gained, lost = emulator.act(action)
        frames[0] += emulator.num_frames - before
        before = emulator.num_frames
        if run.record:
            slots["inner_ram"][index, step] = ram
            slots["inner_action"][index, step] = action
            slots["inner_reward"][index, step] = gained
        emulator.read_ram(ram)
        score += gained
        reward += discount * gained
        life_losses += discount * lost
        discount *= run.gamma
        if (
            (lost and run.end_on_life_loss)
            or emulator.ale.game_over()
            or (ends is not None and ends(ram, option, step + 1))
        ):
            break
    slot["duration"] = step + 1
    slot["reward"], slot["score"], slot["life_losses"] = reward, score, life_losses
    slot["lives"], slot["episode_frame"] = emulator.lives, emulator.episode_frame
    slot["terminated"], slot["truncated"] = emulator.terminated, emulator.truncated
    slots["after"][index] = emulator.state()


def _mixed(seed: int, option: int, state: np.ndarray) -> int:
    """What an option draws its random numbers from: a function of its three arguments."""
    numbers = seed.to_bytes(8, "little") + option.to_bytes(4, "little")
    digest = hashlib.blake2b(numbers + state.tobytes(), digest_size=8).digest()
    return int.from_bytes(digest, "little")


@dataclass
class Channel:
    """What the processes share with their owner."""

    slots: Tensor  # uint8, the memory of the slots
    frames: Tensor  # [P] int64, frames emulated by each
    jobs: Any = None  # ends of pipes
    results: Any = None
    errors: Any = None

    def views(self, slot: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Return slots and frames as arrays that share their memory."""
        return self.slots.numpy().view(slot), self.frames.numpy()


def serve(rank: int, run: OptionRun, worker: OptionWorker, channel: Channel) -> None:
    """Run options until the owner closes the pipe of jobs or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is the owner's to handle
    wake_with_parent()
    torch.set_num_threads(1)
    jobs, results = channel.jobs.fileno(), channel.results.fileno()
    try:
        emulator = AtariEmulator(**run.emulator)
        slots, frames = channel.views(slot_type(emulator.states.width, run))
        while message := os.read(jobs, _NUMBER.itemsize):
            index = int.from_bytes(message, "little")
            run_option(emulator, worker, run, slots, index, frames[rank : rank + 1])
            os.write(results, message)
    except BrokenPipeError:  # the owner has gone
        pass
    except Exception:
        text = f"process {rank}: {traceback.format_exc()[-_MAX_MESSAGE:]}"
        with contextlib.suppress(BrokenPipeError):
            os.write(channel.errors.fileno(), text.encode()[:_MAX_MESSAGE])


@dataclass
class _Running:
    """Processes that run, and the owner's ends of their pipes."""

    processes: list[Any]
    jobs: Any
    results: Any
    errors: Any
    poll: Any = field(default_factory=lambda: select.poll())


class EmulatorProcesses:
    """Runs the options in the slots on several processes.

    A process that dies, by a signal or a crash of the emulator, costs what was under way: all
    processes are started again, and the options without an outcome run again. So does a process
    that is stopped or hangs, after ``step_seconds``. An error that is raised in a process, e.g. by
    the worker, is raised here.

    Args:
        num_processes: P.
        width: bytes of a state.
        run: how options are run.
        worker: sent to the processes once; what it shares with them (tensors in shared memory)
            stays shared.
        start_method: ``"forkserver"`` or ``"spawn"``.
        step_seconds: longest time in which no process takes a step of its emulator, or uses any
            processor time, while options are waited for.

    Raises:
        OSError: if there is too little shared memory, or a process cannot be started.
        RuntimeError: in :meth:`wait`, if the worker fails or processes die again and again.
    """

    def __init__(
        self,
        num_processes: int,
        width: int,
        run: OptionRun,
        worker: OptionWorker,
        start_method: str = "forkserver",
        step_seconds: float = 60.0,
    ) -> None:
        self.num_processes, self.step_seconds = num_processes, step_seconds
        self.run, self.worker = run, worker
        self.num_restarts = 0
        """Processes that died and were started anew."""
        self._context: Any = start_context(start_method)
        if self._context.get_start_method() == "forkserver":  # imports once for all processes
            self._context.set_forkserver_preload([_PRELOAD])
        slot = slot_type(width, run)
        memory = torch.zeros(NUM_SLOTS * slot.itemsize, dtype=torch.uint8)
        frames = torch.zeros(num_processes, dtype=torch.int64)
        share([memory, frames], "AtariOptionPool")
        self._memory = Channel(memory, frames)
        self.slots, self._frames = self._memory.views(slot)
        self._running: _Running | None = None
        self._waiting: set[int] = set()  # slots whose options are under way
        self._lost: set[int] = set()  # slots whose options will not be run

    @property
    def num_frames(self) -> int:
        """Frames emulated by all processes, those of options that were lost included."""
        return int(self._frames.sum())

    @property
    def pids(self) -> list[int]:
        """Ids of the processes that run."""
        return [] if self._running is None else [p.pid for p in self._running.processes]

    def start(self) -> None:
        """Start the processes, if they do not run."""
        if self._running is None:
            with system_errors(f"AtariOptionPool cannot start {self.num_processes} processes"):
                self._start()

    def _start(self) -> None:
        need_descriptors(self.num_processes, pipes=3)
        theirs: list[Any] = []
        ours: list[Any] = []
        try:
            for sent_by_us in (True, False, False):
                reader, writer = self._context.Pipe(duplex=False)
                theirs.append(reader if sent_by_us else writer)
                ours.append(writer if sent_by_us else reader)
        except OSError:
            for end in (*theirs, *ours):
                end.close()
            raise
        channel = Channel(self._memory.slots, self._memory.frames, *theirs)
        running = _Running([], *ours)
        running.poll.register(running.results.fileno(), select.POLLIN)
        try:
            for rank in range(self.num_processes):
                process = self._context.Process(
                    target=serve, args=(rank, self.run, self.worker, channel), daemon=True
                )
                process.start()
                running.processes.append(process)
                running.poll.register(process.sentinel, select.POLLIN)
        except BaseException:
            self._running = running
            self.stop()
            raise
        finally:
            for end in theirs:
                end.close()
        self._running = running

    def submit(self, slots: Sequence[int]) -> None:
        """Have the options in some slots run; :meth:`wait` says when they are done."""
        try:
            self.start()
            self._waiting.update(slots)
            self._lost.difference_update(slots)
            self._write(slots)
        except BaseException:
            self.stop()
            raise

    def wait(self, slots: Sequence[int]) -> None:
        """Wait until the options in some slots have been run."""
        if not self._lost.isdisjoint(slots):
            raise RuntimeError(
                "The processes were stopped while this step was under way, by an error or by "
                "close(), so that it has no outcome. Take the step again."
            )
        try:
            deaths = silences = 0
            silence = Silence()
            while not self._waiting.isdisjoint(slots):
                before = len(self._waiting)
                dead = self._listen(silence)
                if len(self._waiting) < before:
                    deaths = silences = 0
                deaths += len(dead)
                self.num_restarts += len(dead)
                if self._running is not None or not self._waiting:
                    continue
                silences += not dead
                if silences >= _SILENCES_IN_A_ROW:
                    raise RuntimeError(
                        f"The processes of the pool took no step for {self.step_seconds:g} s, "
                        f"{silences} times one after the other, so they were ended. If a step may "
                        f"take longer, raise step_seconds; else look at what the worker waits for."
                    )
                if not dead:  # all that are stopped or hang cannot be told from those that wait
                    self.num_restarts += 1
                if deaths >= _DEATHS_IN_A_ROW:
                    raise RuntimeError(
                        f"{deaths} processes of the pool died one after the other without an "
                        f"outcome, with the exit codes {dead} (a negative one is a signal). If "
                        f"they die at once, put what the script does under "
                        f"`if __name__ == '__main__':`, as multiprocessing needs it."
                    )
                self.start()
                self._write(sorted(self._waiting))
        except BaseException:  # e.g. an interrupt: outcomes still under way are nobody's
            self.stop()
            raise

    def _write(self, slots: Sequence[int]) -> None:
        assert self._running is not None
        with contextlib.suppress(BrokenPipeError):  # all have died
            os.write(self._running.jobs.fileno(), np.array(slots, _NUMBER).tobytes())

    def _listen(self, silence: Silence) -> list[int | None]:
        """Take what is done, or stop all if one died or all are silent; return exit codes."""
        running = self._running
        assert running is not None
        results = running.results.fileno()
        ready = [fd for fd, _ in running.poll.poll(_LOOK_MILLISECONDS)]
        if not ready:
            marks = (self.num_frames, *map(cpu_ticks, self.pids))
            if silence.look(marks) >= self.step_seconds:
                self._kill()
            return []
        if results in ready:
            self._waiting.difference_update(_numbers(results))
        if ready == [results]:
            return []
        if running.errors.poll():
            text = os.read(running.errors.fileno(), _MAX_MESSAGE).decode(errors="replace")
            if text:
                raise RuntimeError(f"An option failed in {text}")
        codes = [p.exitcode for p in running.processes if not p.is_alive()]
        self._kill()  # those that live, too: who had what cannot be known
        return codes

    def stop(self) -> None:
        """Stop the processes, which start again when needed; what is under way is lost."""
        try:
            self._kill()
        finally:
            self._lost |= self._waiting
            self._waiting.clear()

    def _kill(self) -> None:
        """Stop the processes and take what they had finished."""
        running, self._running = self._running, None
        if running is None:
            return
        for process in running.processes:
            process.kill()
        running.jobs.close()
        for process in running.processes:
            process.join(5.0)
        while running.results.poll():
            numbers = _numbers(running.results.fileno())
            if not numbers:
                break
            self._waiting.difference_update(numbers)
        for process in running.processes:
            with contextlib.suppress(ValueError):
                process.close()
        running.results.close()
        running.errors.close()


def _numbers(pipe: int) -> list[int]:
    """The numbers of slots that wait in a pipe, none at its end."""
    message = os.read(pipe, NUM_SLOTS * _NUMBER.itemsize)
    return np.frombuffer(message, _NUMBER).tolist() if message else []
