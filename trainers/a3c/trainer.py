"""Asynchronous advantage actor-critic: processes that learn together without waiting."""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any

import cloudpickle
import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.optim import Optimizer
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule
from torchrl.record.loggers import Logger

from torchrl_hmcts import notebook
from torchrl_hmcts.checks import instance, real_number, whole_number
from torchrl_hmcts.processes import share
from torchrl_hmcts.trainers.a3c.actor_learner import (
    ActorLearner,
    LearnerLog,
    LearnerSettings,
    SharedMemory,
    actor_of,
    board_columns,
    trained_parameters,
)
from torchrl_hmcts.trainers.a3c.learner_processes import LearnerProcesses
from torchrl_hmcts.trainers.a3c.shared_optimizers import OptimizerState, SharedRMSprop, share_over
from torchrl_hmcts.trainers.off_policy import made_by
from torchrl_hmcts.trainers.saving.checkpoints import (
    DurableRotation,
    plain_checkpoint,
    to_continue,
)
from torchrl_hmcts.trainers.saving.resume import FIRST_SAVE_SECONDS, SAVE_SECONDS
from torchrl_hmcts.trainers.saving.run_state import HistoryState
from torchrl_hmcts.trainers.saving.stopping import patient, raise_if_asked, unbroken

MakeOptimizer = Callable[[list[nn.Parameter]], Optimizer]

_SCHEDULES: dict[str, Callable[[float], float]] = {
    "linear": lambda progress: 1.0 - progress,
    "constant": lambda progress: 1.0,
}
_OPTIMIZERS: dict[str, Callable[..., Optimizer]] = {
    "rmsprop": SharedRMSprop,
    "adam": partial(torch.optim.Adam, fused=True),
}
_POLL_SECONDS = 0.2
_OWNER = "A3CTrainer"


class A3CTrainer:
    r"""Actor-learners in processes of their own, with one set of parameters in shared memory.

    Each learner repeats, until the counter T of all frames reaches ``total_frames``: copy the
    shared parameters; act for ``segment_steps`` steps in its own environments; differentiate the
    loss of this segment; clip; change the shared parameters and the shared state of the optimiser,
    without any lock. This process logs, evaluates, saves and watches meanwhile. T may pass
    ``total_frames`` by a segment of each learner.

    Logged every ``log_interval`` frames, as means since the last time: ``frames`` (T), ``seconds``,
    ``frames_per_second``, ``episodes``, ``episode_return``, ``episode_length`` (NaN without one),
    ``updates``, ``grad_norm`` before clipping, ``lr``, ``learner_i_frames``, the entries of the
    loss, and ``eval_frames`` and ``eval_x`` of what ``evaluate`` returned.

    A learner's exception, its death, ``step_seconds`` without a step or a gradient that is not
    finite ends the run: the others stop, a checkpoint is written, and :class:`LearnerError` names
    the learner and carries its traceback. Ctrl-C and SIGTERM stop all, write a checkpoint and raise
    ``KeyboardInterrupt``. If this process is killed, the learners notice and end.

    A run continues from its newest checkpoint with ``load(save_dir)``: parameters, optimiser state,
    T, schedule and curves are as they were. Not exactly: new episodes begin, and checkpoints are
    read while learners write. With one learner a run is a function of its seed. Buffers of networks
    that change in training (batch normalisation) would stay each learner's own.

    Args:
        make_env (callable): ``make_env() -> EnvBase`` of any batch shape, ``[]`` or ``[*B]``;
            called in each learner, a lambda will do.
        loss_module (LossModule): :class:`~torchrl_hmcts.objectives.A3CLoss`, or any other with an
            ``actor_network`` that trains on segments ``[*B, T]``. Its parameters are moved to
            shared memory and trained in place.
        total_frames (int): :math:`T_{max}`, steps of all environments of all learners.
        segment_steps (int): :math:`t_{max}`, steps of each environment between two updates.
        num_learners (int): processes. With 0 one learner runs in this process: to debug.
        optimizer (str, callable or Optimizer): ``"rmsprop"`` (:class:`SharedRMSprop`), ``"adam"``,
            ``optimizer(parameters) -> Optimizer``, or an optimiser over the loss's parameters.
        lr (float): learning rate at the start, of a named optimiser.
        lr_schedule (str or callable): ``"linear"`` falls to 0 at ``total_frames``, ``"constant"``,
            or a factor by the share of frames done, 0 to 1.
        clip_norm (float, optional): bound of the gradient's norm; ``None``: none.
        configure_learner (callable, optional): ``configure_learner(loss_module, i)``, called in
            learner i with its own copy, for exploration that differs between learners.
        evaluate (callable, optional): ``evaluate(policy) -> dict`` of floats, with a copy of the
            policy, in this process while the learners act.
        eval_interval, save_interval (int, optional): frames between evaluations and between
            checkpoints, besides those at the end. Default: a tenth of ``total_frames``.
        stop_when (callable, optional): ``stop_when(metrics) -> bool``, called with what
            ``evaluate`` returned; true ends the run with the parameters that were evaluated.
        logger (Logger, optional): of TorchRL; gets every value at its T.
        log_interval (int): frames.
        save_dir (path, optional): folder of the checkpoints.
        keep_last, overwrite: see :class:`DurableRotation`.
        progress (callable, optional): called with ``total=total_frames`` it returns a progress bar,
            e.g. ``tqdm.tqdm``.
        seed (int): learner i is seeded by (seed, i, T at its start).
        start_method (str): ``"spawn"`` starts each learner as a new interpreter, which takes some
            seconds; ``"forkserver"`` imports once for all; ``"fork"`` is unsafe with threads.
        step_seconds (float): longest time for one step of a learner's env, seconds.

    Raises:
        ValueError: if a number is out of range, or the loss does not reduce to one number.
        TypeError: if the loss has no actor, or the optimiser cannot be shared.
        OSError: if there is too little shared memory or too few file descriptors.

    Reference:
        Mnih et al., "Asynchronous methods for deep reinforcement learning", 2016, arXiv 1602.01783;
        Recht et al., "Hogwild!", 2011, arXiv 1106.5730; Bartley, dissertation, 2023, Algorithm 2.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from torchrl_hmcts.objectives import A3CLoss
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> from torchrl_hmcts.trainers import A3CTrainer
        >>> from torch.nn import Embedding
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(Embedding(4, 2), ["state"], ["logits"]), in_keys=["logits"],
        ...     distribution_class=torch.distributions.Categorical)
        >>> loss = A3CLoss(actor, ValueOperator(Embedding(4, 1), in_keys=["state"]))
        >>> trainer = A3CTrainer(
        ...     lambda: ChainEnv(length=4, batch_size=[8]), loss, total_frames=800,
        ...     segment_steps=5, num_learners=0, lr=0.05, optimizer="adam", log_interval=400)
        >>> history = trainer.train()
        >>> history["frames"]
        [400.0, 800.0]
    """

    def __init__(
        self,
        make_env: Callable[[], EnvBase],
        loss_module: LossModule,
        *,
        total_frames: int,
        segment_steps: int = 20,
        num_learners: int = 2,
        optimizer: str | MakeOptimizer | Optimizer = "rmsprop",
        lr: float = 7e-4,
        lr_schedule: str | Callable[[float], float] = "linear",
        clip_norm: float | None = 0.5,
        configure_learner: Callable[[LossModule, int], None] | None = None,
        evaluate: Callable[[TensorDictModuleBase], Mapping[str, float]] | None = None,
        eval_interval: int | None = None,
        stop_when: Callable[[Mapping[str, float]], bool] | None = None,
        logger: Logger | None = None,
        log_interval: int = 10_000,
        save_dir: str | Path | None = None,
        save_interval: int | None = None,
        keep_last: int = 2,
        overwrite: bool = False,
        progress: Callable[..., Any] | None = None,
        seed: int = 0,
        start_method: str = "spawn",
        step_seconds: float = 60.0,
    ) -> None:
        _check(locals())
        tenth = max(1, total_frames // 10)
        if not callable(lr_schedule):
            lr_schedule = _SCHEDULES[_known("lr_schedule", lr_schedule, _SCHEDULES)]
        self.loss_module = loss_module
        self.settings = LearnerSettings(
            make_env=make_env,
            loss_module=loss_module,
            segment_steps=segment_steps,
            total_frames=total_frames,
            lr_schedule=lr_schedule,
            clip_norm=clip_norm,
            seed=seed,
            configure_learner=configure_learner,
        )
        parameters = trained_parameters(loss_module)
        if isinstance(optimizer, str):
            optimizer = partial(_OPTIMIZERS[_known("optimizer", optimizer, _OPTIMIZERS)], lr=lr)
        if not isinstance(optimizer, Optimizer):
            optimizer = made_by(optimizer, _OWNER, "optimizer", Optimizer, parameters)
        assert isinstance(optimizer, Optimizer)
        self.optimizer = share_over(optimizer, parameters)
        columns = board_columns(loss_module)
        board = torch.zeros(max(1, num_learners), len(columns), dtype=torch.float64)
        stop = torch.zeros(1, dtype=torch.uint8)
        steps = torch.zeros(len(board), dtype=torch.int64)
        share([board, stop, steps], _OWNER)
        self.shared = SharedMemory(parameters, self.optimizer, board, stop, steps)
        self.learners = LearnerProcesses(num_learners, start_method, step_seconds, self.shared)
        self.evaluate, self.stop_when = evaluate, stop_when
        self.log, self.progress = LearnerLog(board, columns, logger), progress
        self.run_settings = {"trainer": _OWNER, "loss_module": type(loss_module).__name__}
        self.rotation = None
        if save_dir is not None:
            self.rotation = DurableRotation(save_dir, keep_last=keep_last, overwrite=overwrite)
            self.rotation.settings = self.run_settings
        self._save_at = float("inf")  # time at which a checkpoint is due
        self.intervals = {
            "log": log_interval,
            "eval": tenth if eval_interval is None else eval_interval,
            "save": tenth if save_interval is None else save_interval,
        }
        self._checkpoint = plain_checkpoint(
            loss_module=loss_module,
            optimizer=OptimizerState(self.optimizer),
            counters=self.log,
            history=HistoryState(self.log),  # type: ignore[arg-type]
        )

    @property
    def frames(self) -> int:
        """T: frames of all learners so far, those before a checkpoint included."""
        return self.log.frames

    @property
    def seconds(self) -> float:
        """Time spent in ``train()`` so far, that before a checkpoint included."""
        return self.log.seconds

    def __repr__(self) -> str:
        done = f"{self.frames:,} of {self.settings.total_frames:,} base steps"
        return f"A3CTrainer({type(self.loss_module).__name__}, {done})"

    def _repr_html_(self) -> str:
        return notebook.shown(repr(self), lambda axes: notebook.draw_losses(axes, self.history))

    @property
    def history(self) -> dict[str, list[float]]:
        """All values logged so far, by name."""
        return self.log.history

    def policy(self) -> TensorDictModuleBase:
        """Returns a copy of the policy as it is now, which further training does not change."""
        return actor_of(self._copy_loss()).requires_grad_(False)

    def _copy_loss(self) -> LossModule:
        return cloudpickle.loads(cloudpickle.dumps(self.loss_module))

    def train(self) -> dict[str, list[float]]:
        """Trains until T reaches ``total_frames`` or ``stop_when`` is true; returns the history.

        Raises:
            LearnerError: if a learner ended before its time; a checkpoint has been written.
            KeyboardInterrupt: after Ctrl-C or SIGTERM; a checkpoint has been written.
            FileExistsError: if ``save_dir`` holds the checkpoints of a run that was not loaded,
                unless ``overwrite`` is true.
            FolderInUse: if another run writes to ``save_dir``.
        """
        with self.rotation.taken() if self.rotation else patient():
            return self._train()

    def _train(self) -> dict[str, list[float]]:
        self._save_at = time.monotonic() + FIRST_SAVE_SECONDS
        self.log.start()
        self._next = {name: self._after(name) for name in self.intervals}
        self._accepted: LossModule | None = None  # what stop_when was content with
        self._bar = None
        if self.progress is not None:
            self._bar = self.progress(total=self.settings.total_frames)
        try:
            if self.frames < self.settings.total_frames:
                (self._watch if self.learners.number else self._run_here)()
            self.learners.stop()
            if self._accepted is not None:
                self.loss_module.load_state_dict(self._accepted.state_dict())
            self._report(at_end=True)
        except BaseException as error:
            with unbroken():
                self.learners.stop()
                self._end_badly(error)
            if not isinstance(error, KeyboardInterrupt):
                raise_if_asked()  # the signal came to the learners as well, and ended them first
            raise
        finally:
            self.learners.stop()
            self.log.stop()
            if self._bar is not None:
                self._bar.close()
        return self.history

    def save(self) -> Path:
        """Writes a checkpoint into ``save_dir``, atomically; returns its path."""
        if self.rotation is None:
            raise ValueError("There is nowhere to save to. Pass save_dir when building A3CTrainer.")
        self.rotation.begin()
        with unbroken():
            saved = self.rotation.save(self._checkpoint, step=self.frames)
        self._save_at = time.monotonic() + SAVE_SECONDS
        return saved

    def load(self, path: str | Path) -> A3CTrainer:
        """Continues from a checkpoint; call it before ``train()``.

        The optimiser's settings are the checkpoint's, the learning rate at the start included; the
        schedule and all else are this trainer's. ``path`` may be a folder of checkpoints.

        Raises:
            FileNotFoundError: if there is no checkpoint.
            CheckpointError: if it is damaged, of a newer version or another loss, or does not fit,
                e.g. other networks or optimiser.
        """
        self._checkpoint.load(to_continue(path, self.run_settings, self.rotation))
        return self

    # Running learners

    def _run_here(self) -> None:
        settings = cloudpickle.loads(cloudpickle.dumps(self.settings))
        with torch.random.fork_rng(devices=[]):
            learner = ActorLearner(settings, self.shared, 0, self.frames)
            try:
                while not learner.done:
                    learner.update()
                    if self._report():
                        break
                    raise_if_asked()
            finally:
                learner.env.close()

    def _watch(self) -> None:
        start = self.frames
        self.learners.start(cloudpickle.dumps(self.settings), start)
        while not self.learners.wait(_POLL_SECONDS, self.frames >= self.settings.total_frames):
            raise_if_asked()
            if self.frames == start:  # they are still importing
                self.log.restart_clock()
            elif self._report():
                return

    def _end_badly(self, error: BaseException) -> None:
        """Saves what there is, and says where."""
        if self.rotation is None:
            return
        try:
            self.save()
        except OSError as failure:  # what ended the run is the error to raise
            print(f"\n{type(error).__name__}; and {failure}.", file=sys.stderr)
            return
        again = f"Continue with trainer.load({str(self.rotation.directory)!r}).train()."
        how = "Stopped" if isinstance(error, KeyboardInterrupt) else type(error).__name__
        print(f"\n{how}; saved at {self.frames} frames. {again}", file=sys.stderr)

    # Reporting

    def _after(self, name: str) -> int:
        """The next multiple of an interval."""
        return (self.frames // self.intervals[name] + 1) * self.intervals[name]

    def _due(self, name: str, at_end: bool) -> bool:
        if not at_end and self.frames < self._next[name]:
            return False
        self._next[name] = self._after(name)
        return True

    def _report(self, at_end: bool = False) -> bool:
        """Logs, evaluates and saves what is due; returns whether the run is to end."""
        end = False
        if self._bar is not None:
            self._bar.update(self.frames - self._bar.n)
        if self._due("log", at_end and self.frames > self.log.logged_frames):
            progress = min(1.0, self.frames / self.settings.total_frames)
            lr = self.optimizer.param_groups[0]["initial_lr"]
            values = self.log.log(self.settings.lr_schedule(progress) * lr)
            if self._bar is not None:
                self._bar.set_postfix({"return": f"{values['episode_return']:.3g}"})
        again = self._accepted is None and not (at_end and self._evaluated())
        if self.evaluate is not None and again and self._due("eval", at_end):
            end = self._evaluate()
        overdue = time.monotonic() >= self._save_at
        if self.rotation is not None and (self._due("save", at_end) or overdue):
            self.save()
        return end

    def _evaluated(self) -> bool:
        done = self.history.get("eval_frames") or [-1.0]
        return done[-1] == self.frames

    def _evaluate(self) -> bool:
        assert self.evaluate is not None
        frames, loss_module = self.frames, self._copy_loss()
        with torch.no_grad():
            metrics = dict(self.evaluate(actor_of(loss_module).requires_grad_(False)))
        named = {f"eval_{name}": value for name, value in metrics.items()}
        self.log.record({"eval_frames": frames, **named}, frames)
        if self.stop_when is not None and self.stop_when(metrics):
            self._accepted = loss_module
        return self._accepted is not None


def _check(given: Mapping[str, Any]) -> None:
    """Refuses arguments of the constructor that make no sense."""
    for name in ("total_frames", "segment_steps", "log_interval", "keep_last"):
        whole_number(_OWNER, name, given[name], least=1)
    for name in ("eval_interval", "save_interval"):
        if given[name] is not None:
            whole_number(_OWNER, name, given[name], least=1)
    whole_number(_OWNER, "num_learners", given["num_learners"])
    whole_number(_OWNER, "seed", given["seed"])
    real_number(_OWNER, "lr", given["lr"], least=0.0)
    real_number(_OWNER, "step_seconds", given["step_seconds"], above=0.0)
    if given["clip_norm"] is not None:
        real_number(_OWNER, "clip_norm", given["clip_norm"], above=0.0)
    instance(_OWNER, "make_env", given["make_env"], Callable)
    for name in ("configure_learner", "evaluate", "stop_when", "progress"):
        instance(_OWNER, name, given[name], Callable, NoneType)
    instance(_OWNER, "logger", given["logger"], Logger, NoneType)
    _known("start_method", given["start_method"], multiprocessing.get_all_start_methods())
    loss_module = given["loss_module"]
    if not hasattr(loss_module, "actor_network"):
        raise TypeError(
            f"A3CTrainer acts with the loss's actor_network; {type(loss_module).__name__} has "
            "none. Use A3CLoss, or another actor-critic loss."
        )
    if getattr(loss_module, "reduction", "mean") == "none":
        raise ValueError(
            "A3CTrainer needs a loss that is one number; this one has reduction='none'. Use "
            "'mean' or 'sum'."
        )
    if given["stop_when"] is not None and given["evaluate"] is None:
        raise ValueError("stop_when looks at what evaluate returns; pass evaluate too.")


def _known(name: str, value: Any, known: Collection[str]) -> str:
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"A3CTrainer needs {name} to be one of {sorted(known)}; got {value!r}.")
    return value
