"""One process of asynchronous training, and the log of what all of them write on their board.

Letters: *B batch of the environments, T steps of a segment, L learners.
"""

from __future__ import annotations

import contextlib
import copy
import math
import multiprocessing
import os
import random
import signal
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing import connection
from typing import Any

import cloudpickle
import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.optim import Optimizer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule
from torchrl.record.loggers import Logger

from torchrl_hmcts.processes import wake_with_parent

COUNTERS = ("frames", "updates", "episodes", "return", "length", "grad_norm")
_GRACE_SECONDS = 5.0


@dataclass
class LearnerSettings:
    """Settings of every learner; it travels to the processes by cloudpickle."""

    make_env: Callable[[], EnvBase]  # [*B]
    loss_module: LossModule  # a copy becomes the learner's own
    segment_steps: int  # T
    total_frames: int  # of all learners together, at which they end
    lr_schedule: Callable[[float], float]  # factor by the share of the frames that are done
    clip_norm: float | None
    seed: int
    configure_learner: Callable[[LossModule, int], None] | None


@dataclass
class SharedMemory:
    """Tensors that the parent and all learners have in common."""

    parameters: list[nn.Parameter]
    optimizer: Optimizer  # its state is shared too; each group has an ``initial_lr``
    board: Tensor  # float64 [L, columns] sums; one writer a row, so that no lock is needed
    stop: Tensor  # uint8 [1], 1 asks the learners to end
    steps: Tensor  # int64 [L] steps of each learner's env, a sign of life


def board_columns(loss_module: LossModule) -> list[str]:
    """Return the names of the board's columns: the counters, then the loss's entries."""
    return [*COUNTERS, *(str(key) for key in loss_module.out_keys)]


def trained_parameters(loss_module: LossModule) -> list[nn.Parameter]:
    """Return the parameters that are trained, each once, in the order of the module."""
    return [p for p in loss_module.parameters() if p.requires_grad]


def actor_of(loss_module: LossModule) -> TensorDictModuleBase:
    """Return the policy of a loss, as a module that holds the loss's own parameters."""
    actor = loss_module.actor_network
    params = getattr(loss_module, "actor_network_params", None)
    if params is not None:
        actor = copy.deepcopy(actor)
        params.to_module(actor)
    return actor


class ActorLearner:
    """One actor-learner of Algorithm 2: an environment, a copy of the networks, and the update.

    ``start_frames`` were done before the board was empty, by an earlier run.
    """

    def __init__(
        self, settings: LearnerSettings, shared: SharedMemory, learner: int, start_frames: int = 0
    ) -> None:
        self.settings, self.shared, self.learner = settings, shared, learner
        self.start_frames = start_frames
        # With the frames done, so that a resumed run does not repeat the first one's episodes.
        entropy = np.random.SeedSequence([settings.seed, learner, start_frames])
        seed = int(entropy.generate_state(1)[0]) % 2**31
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002  environments may draw from the global generator
        torch.manual_seed(seed)
        self.env = settings.make_env()
        if not isinstance(self.env, EnvBase):
            raise TypeError(
                f"make_env must return a torchrl EnvBase; it returned {type(self.env).__name__}. "
                "Wrap a Gymnasium environment, e.g. lambda: GymEnv('CartPole-v1')."
            )
        self.env.set_seed(seed)
        self.loss_module = settings.loss_module
        if settings.configure_learner is not None:
            settings.configure_learner(self.loss_module, learner)
        self.actor = actor_of(self.loss_module)
        self.parameters = trained_parameters(self.loss_module)
        self.row = dict.fromkeys(board_columns(self.loss_module), 0.0)
        self.board, self.steps = shared.board.numpy(), shared.steps.numpy()
        self.running_return = np.zeros(self.env.numel())
        self.running_length = np.zeros(self.env.numel())
        self.carrier = self.env.reset()
        self.keys: list[NestedKey] | None = None

    @property
    def frames(self) -> int:
        """T: frames of all learners."""
        return self.start_frames + int(self.board[:, 0].sum())

    @property
    def done(self) -> bool:
        """True if there is nothing left to do."""
        return bool(self.shared.stop[0]) or self.frames >= self.settings.total_frames

    def update(self) -> None:
        """Synchronise, act for a segment, and apply its gradients to the shared parameters."""
        with torch.no_grad():
            for mine, theirs in zip(self.parameters, self.shared.parameters, strict=True):
                mine.copy_(theirs)
        segment = self.collect()
        losses = self.loss_module(segment)
        terms = {key: losses.get(key) for key in losses.keys() if key.startswith("loss")}
        for parameter in self.parameters:
            parameter.grad = None
        sum(terms.values()).backward()
        norm = self._clip(terms)
        self._apply()
        self._count(segment, losses, norm)

    def collect(self) -> TensorDictBase:
        """Return the next segment ``[*B, T]``, with the entries that the loss reads."""
        steps, state = [], self.carrier
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            for _ in range(self.settings.segment_steps):
                step, state = self.env.step_and_maybe_reset(self.actor(state))
                self.steps[self.learner] += 1
                if self.keys is None:
                    self.keys = self._segment_keys()
                steps.append(step.select(*self.keys, strict=False))
        self.carrier = state
        return torch.stack(steps, -1)

    def _segment_keys(self) -> list[NestedKey]:
        """Names what the loss may read; the rest of a state need not be stacked."""
        loss = self.loss_module
        extra = [getattr(loss.tensor_keys, name, None) for name in ("duration", "sample_log_prob")]
        critic = getattr(loss, "critic_network", None)
        after = [("next", key) for key in getattr(critic, "in_keys", ())]
        keys = [*loss.in_keys, *after, *(key for key in extra if key is not None)]
        return list(dict.fromkeys(unravel_key(key) for key in keys))

    def _clip(self, terms: dict[str, Tensor]) -> float:
        """Clips the gradients; returns their norm before. One that is not finite is refused."""
        bound = self.settings.clip_norm
        norm = nn.utils.clip_grad_norm_(self.parameters, float("inf") if bound is None else bound)
        if not torch.isfinite(norm):
            values = {name: float(term.detach()) for name, term in terms.items()}
            raise FloatingPointError(
                f"The gradient's norm is {float(norm)} with the losses {values}, after "
                f"{self.frames} frames. The update was not applied: the shared parameters are as "
                "they were. Look for rewards or observations that are not finite, or lower lr or "
                "clip_norm."
            )
        return float(norm)

    def _apply(self) -> None:
        optimizer = self.shared.optimizer
        factor = self.settings.lr_schedule(min(1.0, self.frames / self.settings.total_frames))
        for group in optimizer.param_groups:
            group["lr"] = factor * group["initial_lr"]
        for mine, theirs in zip(self.parameters, self.shared.parameters, strict=True):
            theirs.grad = mine.grad
        optimizer.step()

    def _count(self, segment: TensorDictBase, losses: TensorDictBase, norm: float) -> None:
        keys, row = self.loss_module.tensor_keys, self.row
        after, steps = segment.get("next"), self.settings.segment_steps
        reward = after.get(keys.reward).reshape(-1, steps).numpy()
        done = after.get(keys.done).reshape(-1, steps).numpy()
        for t in range(steps):
            self.running_return += reward[:, t]
            self.running_length += 1
            ended = done[:, t]
            if ended.any():
                row["episodes"] += ended.sum()
                row["return"] += self.running_return[ended].sum()
                row["length"] += self.running_length[ended].sum()
                self.running_return[ended] = 0.0
                self.running_length[ended] = 0.0
        row["frames"] += self.env.numel() * steps
        row["updates"] += 1
        row["grad_norm"] += norm
        for name in losses.keys():
            row[name] += float(losses.get(name).detach().mean())
        self.board[self.learner] = list(row.values())


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


def run_learner(
    payload: bytes,
    shared: SharedMemory,
    learner: int,
    start_frames: int,
    errors: connection.Connection,
) -> None:
    """Run a learner as a process; what goes wrong is sent to the parent as text.

    ``payload`` are the :class:`LearnerSettings` by cloudpickle; ``errors`` receives a traceback.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    torch.set_num_threads(1)
    wake_with_parent()
    threading.Thread(target=_end_with_parent, args=(shared.stop,), daemon=True).start()
    actor_learner = None
    try:
        actor_learner = ActorLearner(cloudpickle.loads(payload), shared, learner, start_frames)
        while not actor_learner.done:
            actor_learner.update()
    except BaseException:
        with contextlib.suppress(OSError):  # the parent may be gone
            errors.send(traceback.format_exc()[-30_000:])
        raise SystemExit(1) from None
    finally:
        if actor_learner is not None:
            with contextlib.suppress(Exception):
                actor_learner.env.close()


def _end_with_parent(stop: Tensor) -> None:
    """Waits for the parent's end, however sudden, and ends this process after it."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    connection.wait([parent.sentinel])
    stop[0] = 1
    time.sleep(_GRACE_SECONDS)
    os._exit(1)
