"""What one process of asynchronous training does: act, differentiate, update the shared parameters.

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
from collections.abc import Callable, Sequence
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
    """What every learner needs to know; it travels to the processes by cloudpickle.

    Args:
        make_env: builds the learner's own environment, ``[*B]``.
        loss_module: a copy of it becomes the learner's own.
        segment_steps: T, steps between two updates.
        total_frames: frames of all learners together, at which they end.
        lr_schedule: factor of the learning rates by the share of the frames that are done.
        clip_norm: bound of the gradient's norm, or ``None``.
        seed: with the learner's number and the frames done, seeds everything random.
        configure_learner: called with the learner's loss and number before it starts.
    """

    make_env: Callable[[], EnvBase]
    loss_module: LossModule
    segment_steps: int
    total_frames: int
    lr_schedule: Callable[[float], float]
    clip_norm: float | None
    seed: int
    configure_learner: Callable[[LossModule, int], None] | None


@dataclass
class SharedMemory:
    """Tensors that the parent and all learners have in common.

    Args:
        parameters: of the loss.
        optimizer: over these parameters, its state shared too; each group has an ``initial_lr``.
        board: float64 ``[L, columns]``, sums over what each learner has done. Each row has one
            writer, so that no lock is needed; the counter T is the sum of the first column.
        stop: uint8 ``[1]``, 1 to ask the learners to end.
        steps: int64 ``[L]``, a sign of life: steps of its env that each learner has taken.
    """

    parameters: list[nn.Parameter]
    optimizer: Optimizer
    board: Tensor
    stop: Tensor
    steps: Tensor


def board_columns(loss_module: LossModule) -> list[str]:
    """Return the names of the board's columns: the counters, then the loss's entries.

    Args:
        loss_module: whose ``out_keys`` are logged.
    """
    return [*COUNTERS, *(str(key) for key in loss_module.out_keys)]


def trained_parameters(loss_module: LossModule) -> list[nn.Parameter]:
    """Return the parameters that are trained, each once, in the order of the module.

    Args:
        loss_module: whose parameters they are.
    """
    return [p for p in loss_module.parameters() if p.requires_grad]


def actor_of(loss_module: LossModule) -> TensorDictModuleBase:
    """Return the policy of a loss, as a module that holds the loss's own parameters.

    Args:
        loss_module: has an ``actor_network``, functional or not.
    """
    actor = loss_module.actor_network
    params = getattr(loss_module, "actor_network_params", None)
    if params is not None:
        actor = copy.deepcopy(actor)
        params.to_module(actor)
    return actor


class ActorLearner:
    """One actor-learner of Algorithm 2: an environment, a copy of the networks, and the update.

    Args:
        settings: what to do.
        shared: where the results go.
        learner: its number, the row of the board that it writes.
        start_frames: frames that were done before the board was empty, by an earlier run.

    Raises:
        TypeError: if ``make_env`` does not return an ``EnvBase``.
    """

    def __init__(
        self, settings: LearnerSettings, shared: SharedMemory, learner: int, start_frames: int = 0
    ) -> None:
        self.settings, self.shared, self.learner = settings, shared, learner
        self.start_frames = start_frames
        seed = learner_seed(settings.seed, learner, start_frames)
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002  environments may draw from the global generator
        torch.manual_seed(seed)
        env = settings.make_env()
        if not isinstance(env, EnvBase):
            raise TypeError(
                f"make_env must return a torchrl EnvBase; it returned {type(env).__name__}. Wrap a "
                "Gymnasium environment, e.g. lambda: GymEnv('CartPole-v1')."
            )
        self.env = env
        env.set_seed(seed)
        self.loss_module = settings.loss_module
        if settings.configure_learner is not None:
            settings.configure_learner(self.loss_module, learner)
        self.actor = actor_of(self.loss_module)
        self.parameters = trained_parameters(self.loss_module)
        self.columns = board_columns(self.loss_module)
        self.row = np.zeros(len(self.columns))
        self.board, self.steps = shared.board.numpy(), shared.steps.numpy()
        self.frames_per_segment = env.numel() * settings.segment_steps
        self.running_return = np.zeros(env.numel())
        self.running_length = np.zeros(env.numel())
        self.carrier = env.reset()
        self.keys: list[NestedKey] | None = None

    @property
    def frames(self) -> int:
        """T: frames of all learners."""
        return self.start_frames + int(self.board[:, 0].sum())

    @property
    def done(self) -> bool:
        """Whether there is nothing left to do."""
        return bool(self.shared.stop[0]) or self.frames >= self.settings.total_frames

    def run(self) -> None:
        """Updates until T has reached its end or the parent asks to stop."""
        while not self.done:
            self.update()

    def update(self) -> None:
        """Synchronises, acts for a segment, and applies its gradients to the shared parameters."""
        with torch.no_grad():
            for mine, theirs in zip(self.parameters, self.shared.parameters, strict=True):
                mine.copy_(theirs)
        segment = self.collect()
        losses = self.loss_module(segment)
        names = [key for key in losses.keys() if key.startswith("loss")]
        total = sum(losses.get(name) for name in names)
        for parameter in self.parameters:
            parameter.grad = None
        total.backward()
        norm = self._gradient_norm(losses, names)
        self._apply()
        self._count(segment, losses, norm)

    def collect(self) -> TensorDictBase:
        """Returns the next segment ``[*B, T]``, with the entries that the loss reads."""
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

    def _gradient_norm(self, losses: TensorDictBase, names: Sequence[str]) -> float:
        """Clips the gradients; returns their norm before. What is not finite goes no further."""
        bound = self.settings.clip_norm
        norm = nn.utils.clip_grad_norm_(self.parameters, float("inf") if bound is None else bound)
        if not torch.isfinite(norm):
            values = {name: float(losses.get(name).detach()) for name in names}
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
        keys = self.loss_module.tensor_keys
        after, steps = segment.get("next"), self.settings.segment_steps
        reward = after.get(keys.reward).reshape(-1, steps).numpy()
        done = after.get(keys.done).reshape(-1, steps).numpy()
        row, column = self.row, {name: i for i, name in enumerate(self.columns)}
        for t in range(steps):
            self.running_return += reward[:, t]
            self.running_length += 1
            ended = done[:, t]
            if ended.any():
                row[column["episodes"]] += ended.sum()
                row[column["return"]] += self.running_return[ended].sum()
                row[column["length"]] += self.running_length[ended].sum()
                self.running_return[ended] = 0.0
                self.running_length[ended] = 0.0
        row[column["frames"]] += self.frames_per_segment
        row[column["updates"]] += 1
        row[column["grad_norm"]] += norm
        for name in losses.keys():
            row[column[name]] += float(losses.get(name).detach().mean())
        self.board[self.learner] = row


def learner_seed(seed: int, learner: int, frames: int) -> int:
    """Return the seed of a learner that starts after so many frames.

    Args:
        seed: of the run.
        learner: its number.
        frames: done before, so that a resumed run does not repeat the first one's episodes.
    """
    return int(np.random.SeedSequence([seed, learner, frames]).generate_state(1)[0]) % 2**31


def run_learner(
    payload: bytes,
    shared: SharedMemory,
    learner: int,
    start_frames: int,
    errors: connection.Connection,
) -> None:
    """Run a learner as a process; what goes wrong is sent to the parent as text.

    Args:
        payload: :class:`LearnerSettings` by cloudpickle.
        shared: what it has in common with the others.
        learner: its number.
        start_frames: frames done by an earlier run.
        errors: receives a traceback.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    torch.set_num_threads(1)
    wake_with_parent()
    threading.Thread(target=_end_with_parent, args=(shared.stop,), daemon=True).start()
    actor_learner = None
    try:
        actor_learner = ActorLearner(cloudpickle.loads(payload), shared, learner, start_frames)
        actor_learner.run()
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
