"""Counters and curves from what asynchronous learners write on their board."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torchrl.record.loggers import Logger

from torchrl_hmcts.trainers.a3c.actor_learner import COUNTERS


class LearnerLog:
    """The sums on the learners' board, and the curves that follow from them."""

    def __init__(self, board: Tensor, columns: list[str], logger: Logger | None = None) -> None:
        self.board, self.columns, self.logger = board, columns, logger
        self._log_dict: dict[str, list[float]] = {}  # the name that HistoryState saves
        self._before = torch.zeros(len(columns), dtype=torch.float64)  # by earlier learners
        self._seconds = 0.0  # in earlier calls of train()
        self._started: float | None = None
        self._last: dict[str, float] = {}

    @property
    def frames(self) -> int:
        """T: frames of all learners so far."""
        return int(self._before[0] + self.board[:, 0].sum())

    @property
    def seconds(self) -> float:
        """Time between ``start()`` and ``stop()`` so far."""
        running = 0.0 if self._started is None else time.perf_counter() - self._started
        return self._seconds + running

    @property
    def history(self) -> dict[str, list[float]]:
        """All values so far, by name."""
        return {key: list(values) for key, values in self._log_dict.items()}

    @property
    def logged_frames(self) -> float:
        """T when ``log()`` was called last, or at the start."""
        return self._last["frames"]

    def start(self) -> None:
        """Start the clock, with an empty board for learners that may be others than before."""
        self._before += self.board.sum(0)
        self.board.zero_()
        self._started = time.perf_counter()
        self._last = self._marks()

    def stop(self) -> None:
        """Stop the clock."""
        self._seconds, self._started = self.seconds, None

    def restart_clock(self) -> None:
        """Leave the time until now out of the next ``frames_per_second``."""
        self._last["seconds"] = self.seconds

    def log(self, lr: float) -> dict[str, float]:
        """Record the means since the last time, and the learning rate; return them."""
        now, last = self._marks(), self._last
        self._last = now

        def mean(name: str, per: str) -> float:
            count = now[per] - last[per]
            return (now[name] - last[name]) / count if count else math.nan

        values = {
            "frames": int(now["frames"]),
            "seconds": now["seconds"],
            "frames_per_second": mean("frames", "seconds"),
            "episodes": now["episodes"],
            "episode_return": mean("return", "episodes"),
            "episode_length": mean("length", "episodes"),
            "updates": now["updates"],
            "grad_norm": mean("grad_norm", "updates"),
            "lr": lr,
        }
        for i, done in enumerate(self.board[:, 0].tolist()):
            values[f"learner_{i}_frames"] = done
        for name in self.columns[len(COUNTERS) :]:
            values[name] = mean(name, "updates")
        self.record(values, int(now["frames"]))
        return values

    def record(self, values: Mapping[str, float], frames: int) -> None:
        """Append values of T to the history, and tell the logger those that are finite."""
        for name, value in values.items():
            self._log_dict.setdefault(name, []).append(float(value))
            if self.logger is not None and math.isfinite(value):
                self.logger.log_scalar(name, float(value), step=frames)

    def state_dict(self) -> dict[str, Any]:
        """Return the sums and the time; the curves are saved by themselves."""
        totals = self._marks()
        return {"seconds": totals.pop("seconds"), "totals": totals}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Take the sums and the time of a checkpoint for what was done before."""
        totals = [state_dict["totals"][name] for name in self.columns]
        self._before.copy_(torch.tensor(totals, dtype=torch.float64))
        self.board.zero_()
        self._seconds = state_dict["seconds"]

    def _marks(self) -> dict[str, float]:
        totals = (self._before + self.board.sum(0)).tolist()
        return {**dict(zip(self.columns, totals, strict=True)), "seconds": self.seconds}
