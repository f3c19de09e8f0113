"""Processes of actor-learners: started, watched, and ended so that none is left behind."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import connection
from typing import Any

from torchrl_hmcts.processes import (
    Silence,
    cpu_ticks,
    need_descriptors,
    start_context,
    system_errors,
)
from torchrl_hmcts.trainers.a3c.actor_learner import SharedMemory, run_learner

_STOP_SECONDS = 10.0  # to finish a segment in, when the run is at its end


class LearnerError(RuntimeError):
    """A learner of an asynchronous training ended before its time.

    Args:
        message (str): what happened, with the learner's traceback.
        learner (int): its number.
        exitcode (int, optional): of its process; negative for a signal, ``None`` if it did not
            answer.

    Examples:
        >>> LearnerError("learner 1 was killed", learner=1, exitcode=-9).learner
        1
    """

    def __init__(self, message: str, *, learner: int, exitcode: int | None) -> None:
        super().__init__(message)
        self.learner, self.exitcode = learner, exitcode


class LearnerProcesses:
    """The processes of one training; a step of a learner's env may take ``step_seconds``."""

    def __init__(
        self, number: int, start_method: str, step_seconds: float, shared: SharedMemory
    ) -> None:
        self.number, self.step_seconds, self.shared = number, step_seconds, shared
        self.context: Any = start_context(start_method)
        if self.context.get_start_method() == "forkserver":
            # Imported once; learners then start within milliseconds.
            self.context.set_forkserver_preload(["__main__", run_learner.__module__])
        self.start_frames = 0
        self.silences: list[Silence] = []
        self.running: list[tuple[Any, Any]] = []  # process, end of a pipe with its traceback

    def start(self, payload: bytes, start_frames: int) -> None:
        """Start all learners, with their settings by cloudpickle and the frames done before."""
        self.start_frames = start_frames
        self.silences = [Silence() for _ in range(self.number)]
        with system_errors(f"A3CTrainer cannot start {self.number} learners"):
            need_descriptors(self.number, pipes=self.number)
            for i in range(self.number):
                errors, send = self.context.Pipe(duplex=False)
                # Not daemons: those may not have processes of their own, as a ParallelEnv has.
                process = self.context.Process(
                    target=run_learner,
                    args=(payload, self.shared, i, start_frames, send),
                    name=f"learner {i}",
                )
                with no_interrupts():
                    process.start()
                    self.running.append((process, errors))
                send.close()

    def wait(self, seconds: float, enough: bool = False) -> bool:
        """Wait until a learner ends or the time is over; return whether all ended as they should.

        With ``enough`` frames done, a learner that does not answer is given up.
        """
        alive = [process.sentinel for process, _ in self.running if process.exitcode is None]
        if alive:
            connection.wait(alive, timeout=seconds)
        for i, (process, errors) in enumerate(self.running):
            if process.exitcode not in (None, 0):
                raise self._error(i, process.exitcode, errors)
        patience = min(_STOP_SECONDS, self.step_seconds) if enough else self.step_seconds
        left = [i for i, (process, _) in enumerate(self.running) if process.exitcode is None]
        silent = [i for i in left if self._silence(i) >= patience]
        if silent and not enough:
            raise self._no_answer(silent[0])
        if silent and silent == left:
            print(f"{self._no_answer(silent[0])}", file=sys.stderr)
            for i in silent:  # what it had under way is nobody's
                self.running[i][0].kill()
        return silent == left

    def _silence(self, learner: int) -> float:
        """Seconds for which a learner has neither stepped nor used the processor."""
        ticks = cpu_ticks(self.running[learner][0].pid)
        return self.silences[learner].look((int(self.shared.steps[learner]), ticks))

    def _no_answer(self, learner: int) -> LearnerError:
        seconds, pid = self.silences[learner].seconds, self.running[learner][0].pid
        return LearnerError(
            f"Learner {learner} of {self.number} (process {pid}) has not answered for "
            f"{seconds:.0f} s, after {self._frames()} frames of all: it is stopped, or its env "
            "hangs. It is ended. If a step may take longer, raise step_seconds.",
            learner=learner,
            exitcode=None,
        )

    def _frames(self) -> int:
        return self.start_frames + int(self.shared.board[:, 0].sum())

    def stop(self) -> None:
        """End all learners: they finish their segment, or are killed after some seconds."""
        self.shared.stop[0] = 1
        with no_interrupts():
            deadline = time.monotonic() + _STOP_SECONDS
            for i, (process, errors) in enumerate(self.running):
                if self.silences[i].seconds >= min(self.step_seconds, _STOP_SECONDS):
                    process.kill()
                process.join(max(0.0, deadline - time.monotonic()))
                if process.exitcode is None:
                    process.kill()
                    process.join()
                process.close()
                errors.close()
            self.running.clear()
        self.shared.stop[0] = 0

    def _error(self, learner: int, exitcode: int, errors: Any) -> LearnerError:
        try:
            text = errors.recv() if errors.poll(1.0) else ""
        except EOFError:
            text = ""
        if exitcode < 0:
            how = f"was killed by {signal.Signals(-exitcode).name}"
            text = text or "It left no traceback: out of memory, or killed from outside?"
        else:
            how = "failed" if text else f"ended with exit code {exitcode} and no traceback"
        return LearnerError(
            f"Learner {learner} of {self.number} {how} after {self._frames()} frames; the others "
            f"were stopped.\n\n{text}",
            learner=learner,
            exitcode=exitcode,
        )


@contextmanager
def no_interrupts() -> Iterator[None]:
    """Put Ctrl-C off until the end; processes started meanwhile never get it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
