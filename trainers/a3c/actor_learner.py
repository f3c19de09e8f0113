"""One process of asynchronous training: it acts, differentiates, updates the shared parameters.

Letters: *B batch of the environments, T steps of a segment, L learners.
"""

from __future__ import annotations

import contextlib
import copy
import multiprocessing
import os
import random
import signal
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import connection

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
