"""Processes that run options, an env in each: jobs are slots of shared memory, pipes carry numbers.

All processes read up to 32 slots from one pipe, fewer towards the end of a batch, so that all end
at about the same time.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import struct
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.envs.gym.option_run import OptionRun
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

_MESSAGE = struct.Struct("<32h")  # numbers of slots, then -1
_MOST = 32
_MAX_ERROR = 4000  # of an error; what a pipe takes at once
_DEATHS_IN_A_ROW = 5
_SILENCES_IN_A_ROW = 2
_LOOK_MILLISECONDS = 500
_STALLS, _LEAST_STALL = 10, 120.0  # step_seconds, and seconds, without a step but computing
_PRELOAD = __name__.replace("processes", "preload")


@dataclass
class Channel:
    """What the processes share with their owner."""

    slots: Tensor  # uint8, the memory of the slots
    work: Tensor  # [P] int64, steps taken by each
    jobs: Any = None  # ends of pipes
    results: Any = None
    errors: Any = None


def serve(rank: int, kind: type[OptionRun], arguments: tuple[Any, ...], channel: Channel) -> None:
    """Run options until the owner closes the pipe of jobs or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is the owner's to handle
    wake_with_parent()
    torch.set_num_threads(1)
    jobs, results = channel.jobs.fileno(), channel.results.fileno()
    try:
        run = kind(*arguments)
        run.work = channel.work.numpy()[rank : rank + 1].data
        slots = fields_of(channel.slots.numpy().view(run.slot_type()))
        while message := os.read(jobs, _MESSAGE.size):
            for index in _MESSAGE.unpack(message):
                if index >= 0:
                    run.run(slots, index)
            os.write(results, message)
    except BrokenPipeError:  # the owner has gone
        pass
    except Exception:
        text = f"process {rank}: {traceback.format_exc()[-_MAX_ERROR:]}"
        with contextlib.suppress(BrokenPipeError):
            os.write(channel.errors.fileno(), text.encode()[:_MAX_ERROR])


def fields_of(slots: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of a structured array, which share its memory."""
    return {name: slots[name] for name in slots.dtype.names or ()}


@dataclass
class _Running:
    """Processes that run, and the owner's ends of their pipes."""

    processes: list[Any]
    jobs: Any
    results: Any
    errors: Any
    poll: Any = field(default_factory=lambda: select.poll())


class OptionProcesses:
    """Runs the options in the slots on several processes.

    A process that dies, by a signal or a crash of the env, costs what was under way: all processes
    are started again, and the options without an outcome run again. So does a process that is
    stopped or hangs: that takes no step and uses no processor time for ``step_seconds``, or
    computes without a step for ten times as long, and two minutes at least. An error that is raised
    in a process, e.g. by the worker, is raised here.
    """

    def __init__(
        self, owner: str, num_processes: int, run: OptionRun, start_method: str, step_seconds: float
    ) -> None:
        self.owner, self.num_processes, self.step_seconds = owner, num_processes, step_seconds
        self._job = (type(run), run.arguments)
        self.num_restarts = 0
        """Processes that died and were started again."""
        self._context: Any = start_context(start_method)
        if self._context.get_start_method() == "forkserver":  # imports once for all processes
            self._context.set_forkserver_preload([_PRELOAD])
        slot = run.slot_type()
        memory = torch.zeros(NUM_SLOTS * slot.itemsize, dtype=torch.uint8)
        work = torch.zeros(num_processes, dtype=torch.int64)
        share([memory, work], owner)
        self._memory = Channel(memory, work)
        self.slots: np.ndarray = memory.numpy().view(slot)
        self._running: _Running | None = None
        self._waiting: set[int] = set()  # slots whose options are under way
        self._lost: set[int] = set()  # slots whose options will not be run

    @property
    def work(self) -> int:
        """Steps of all processes, those of options that were lost included."""
        return int(self._memory.work.sum())

    @property
    def pids(self) -> list[int]:
        """Ids of the processes that run."""
        return [] if self._running is None else [p.pid for p in self._running.processes]

    def start(self) -> None:
        """Start the processes, if they do not run."""
        if self._running is None:
            with system_errors(f"{self.owner} cannot start {self.num_processes} processes"):
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
        channel = Channel(self._memory.slots, self._memory.work, *theirs)
        running = _Running([], *ours)
        running.poll.register(running.results.fileno(), select.POLLIN)
        try:
            for rank in range(self.num_processes):
                process = self._context.Process(
                    target=serve, args=(rank, *self._job, channel), daemon=True
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
                "close(), so it has no outcome. Take the step again."
            )
        try:
            deaths = silences = 0
            silences_of = Silence(), Silence()
            while not self._waiting.isdisjoint(slots):
                before = len(self._waiting)
                dead = self._listen(*silences_of)
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
                        f"{silences} times in a row, so they were ended. If a step can take "
                        "longer, raise step_seconds. If not, find what the worker waits for."
                    )
                if not dead:  # all that are stopped or hang cannot be told from those that wait
                    self.num_restarts += 1
                if deaths >= _DEATHS_IN_A_ROW:
                    raise RuntimeError(
                        f"{deaths} processes of the pool died in a row without an outcome, with "
                        f"the exit codes {dead} (a negative one is a signal). If they die at once, "
                        "put the script's code under `if __name__ == '__main__':`; "
                        "multiprocessing needs it."
                    )
                self.start()
                self._write(sorted(self._waiting))
        except BaseException:  # e.g. an interrupt: outcomes still under way are nobody's
            self.stop()
            raise

    def _write(self, slots: Sequence[int]) -> None:
        assert self._running is not None
        content, at = b"", 0
        while at < len(slots):
            most = max(1, min(_MOST, (len(slots) - at) // (2 * self.num_processes - 1)))
            part = slots[at : at + most]
            content += _MESSAGE.pack(*part, *(-1,) * (_MOST - len(part)))
            at += len(part)
        with contextlib.suppress(BrokenPipeError):  # all have died
            os.write(self._running.jobs.fileno(), content)

    def _listen(self, silence: Silence, stall: Silence) -> list[int | None]:
        """Take what is done, or stop all if one died or all are silent; return exit codes."""
        running = self._running
        assert running is not None
        results = running.results.fileno()
        ready = [fd for fd, _ in running.poll.poll(_LOOK_MILLISECONDS)]
        if not ready:
            marks = (self.work, *map(cpu_ticks, self.pids))
            longest = max(_STALLS * self.step_seconds, _LEAST_STALL)
            still = silence.look(marks) >= self.step_seconds
            if stall.look(self.work) >= longest or still:
                self._kill()
            return []
        if results in ready:
            self._waiting.difference_update(_numbers(results))
        if ready == [results]:
            return []
        if running.errors.poll():
            text = os.read(running.errors.fileno(), _MAX_ERROR).decode(errors="replace")
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
    message = os.read(pipe, NUM_SLOTS * _MESSAGE.size)
    return [number for part in _MESSAGE.iter_unpack(message) for number in part if number >= 0]
