"""A trainer whose checkpoints continue the training as if it had never stopped."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import Collector
from torchrl.trainers import DefaultOptimizationStepper, Trainer

from torchrl_hmcts import notebook
from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.trainers.saving.checkpoints import (
    DurableRotation,
    plain_checkpoint,
    to_continue,
)
from torchrl_hmcts.trainers.saving.run_state import (
    BufferAdapter,
    GeneratorStates,
    HistoryState,
    RunningEpisodes,
)
from torchrl_hmcts.trainers.saving.stopping import patient, raise_if_asked, stop_asked, unbroken

FIRST_SAVE_SECONDS = 5.0  # of training, after which there is a checkpoint at any interval
SAVE_SECONDS = 60.0  # between two checkpoints, at most


class ResumableTrainer(Trainer):
    """A TorchRL ``Trainer`` that resumes exactly, and stops before it learns from NaN.

    Training to 2 n base steps, and training to n, loading in a new process and training to 2 n,
    give the same run bit for bit, if the env's whole state is in its tensordict. Checkpoints are
    written so that a crash cannot damage one (:class:`DurableRotation`), and read without pickle.

    Ctrl-C and SIGTERM stop a training after the batch under way, which is saved; then
    ``KeyboardInterrupt`` is raised. A second Ctrl-C, a second later or more, stops it at once.

    Args:
        save_dir (path, optional): folder of the checkpoints; one is written after 5 seconds of
            training, whenever ``save_trainer_interval`` base steps or a minute have passed, and at
            the end. One trainer at a time writes to it.
        keep_last, overwrite: see :class:`DurableRotation`.
        **trainer_kwargs: passed to ``torchrl.trainers.Trainer``.

    Attributes:
        run_settings (dict): values that a run must keep when it continues, by name (JSON).

    Raises:
        ValueError: if TorchRL's ``checkpoint``, ``checkpoint_rotation`` or ``save_trainer_file`` is
            given.
        OSError: if ``save_dir`` cannot be written to.
        FolderInUse: on training, if another run writes to ``save_dir``.

    Example:
        >>> import torch
        >>> from torchrl.collectors import Collector
        >>> from torchrl.modules import QValueActor
        >>> from torchrl.objectives import DQNLoss
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> from torchrl_hmcts.trainers import ResumableTrainer
        >>> env = ChainEnv(length=4)
        >>> q = QValueActor(torch.nn.Embedding(4, 2), in_keys=["state"], spec=env.action_spec)
        >>> loss = DQNLoss(q, action_space="categorical", delay_value=False)
        >>> collector = Collector(
        ...     env, q, frames_per_batch=8, auto_register_policy_transforms=True)
        >>> trainer = ResumableTrainer(
        ...     save_dir="run/checkpoints", collector=collector, total_frames=16, frame_skip=1,
        ...     optim_steps_per_batch=1, loss_module=loss, progress_bar=False,
        ...     optimizer=torch.optim.Adam(loss.parameters()))
        >>> trainer.train()
        >>> trainer.collected_frames
        16
    """

    def __init__(
        self,
        *,
        save_dir: str | Path | None = None,
        keep_last: int = 2,
        overwrite: bool = False,
        **trainer_kwargs: Any,
    ) -> None:
        keep_last = whole_number(type(self).__name__, "keep_last", keep_last, least=1)
        self.run_settings: dict[str, Any] = {"trainer": type(self).__name__}
        for part in ("loss_module", "optimizer"):
            if trainer_kwargs.get(part) is not None:
                self.run_settings[part] = type(trainer_kwargs[part]).__name__
        for other in ("checkpoint", "checkpoint_rotation", "save_trainer_file"):
            if trainer_kwargs.get(other) is not None:
                raise ValueError(
                    f"{type(self).__name__} writes its checkpoints to save_dir; leave {other} out."
                )
        self.rotation = None
        if save_dir is not None:
            self.rotation = DurableRotation(save_dir, keep_last=keep_last, overwrite=overwrite)
            self.rotation.settings = self.run_settings
        checkpoint = plain_checkpoint(rng=GlobalRNGState())
        if (buffer := trainer_kwargs.get("replay_buffer")) is not None:
            # A buffer's own dump() writes a pickle beside the tensors; its state dict needs none.
            checkpoint.register("replay_buffer", buffer, adapter=BufferAdapter())
        trainer_kwargs.setdefault("optimization_stepper", DetachedStepper())
        super().__init__(checkpoint=checkpoint, checkpoint_rotation=self.rotation, **trainer_kwargs)
        self._save_at = math.inf  # time at which a checkpoint is due
        # TorchRL keeps this dict on the class, where the next trainer built would empty it.
        self._last_log: dict[str, Any] = {}
        self._saved_frames = -1  # base steps at the newest checkpoint
        collector = self.collector
        self.register_module("history", HistoryState(self))
        self._episodes: RunningEpisodes | None = None
        if isinstance(collector, Collector):
            self._episodes = RunningEpisodes(collector)
            self.register_module("running_episodes", self._episodes)
            generators = GeneratorStates(env=collector.env, policy=collector.policy)
            self.register_module("generators", generators)

    def __repr__(self) -> str:
        total = "" if self.total_frames > 2**60 else f" of {self.total_frames:,}"
        loss, name = type(self.loss_module).__name__, type(self).__name__
        return f"{name}({loss}, {self.collected_frames:,}{total} base steps)"

    def _repr_html_(self) -> str:
        return notebook.shown(repr(self), lambda axes: notebook.draw_losses(axes, self.history))

    @property
    def history(self) -> dict[str, list[float]]:
        """All values logged so far, by name."""
        return {key: [float(x) for x in values] for key, values in self._log_dict.items()}

    def _shutdown_hook(self) -> None:
        # A collector that ends by itself leaves TorchRL's loop without the checkpoint of the end.
        if self.rotation is not None and self._saved_frames != self.collected_frames:
            self.save_trainer(force_save=True)
        super()._shutdown_hook()

    def load(self, path: str | Path, *, new_episodes: bool | None = None) -> ResumableTrainer:
        """Continue from a checkpoint; call it before ``train()``.

        Args:
            path (path): a checkpoint, or a folder of checkpoints (``save_dir``), of which the
                newest whole one is taken.
            new_episodes (bool, optional): leave the episodes that were under way out, and begin
                new ones. Default: only in an env that cannot be set to a state (e.g. ``GymEnv``),
                and a line on stderr says so. False: refuse such an env.

        Raises:
            FileNotFoundError: if there is no checkpoint.
            CheckpointError: if it is damaged, of a newer version or of other settings, or does not
                fit.
        """
        found = to_continue(path, self.run_settings, self.rotation)
        if self._episodes is not None:
            self._episodes.new_episodes = new_episodes
        self.load_from_file(found)
        return self

    def _num_updates(self) -> int:
        count: int = self.state_dict()["state"]["_optim_count"]
        return count

    def train(self) -> None:
        """Train until ``total_frames`` are collected.

        Raises:
            KeyboardInterrupt: after Ctrl-C or SIGTERM; a checkpoint has been written.
            FileExistsError: if ``save_dir`` holds the checkpoints of a run that was not loaded,
                unless ``overwrite`` is true.
            FolderInUse: if another run writes to ``save_dir``.
        """
        with self.rotation.taken() if self.rotation else patient():
            self._save_at = time.monotonic() + FIRST_SAVE_SECONDS
            try:
                if self.collected_frames < self.total_frames:
                    super().train()
                else:  # a run that was stopped once its training had ended
                    self._shutdown_hook()
                    self.collector.shutdown()
            except KeyboardInterrupt:
                with unbroken():
                    self._shutdown_hook()
                    self.collector.shutdown()
                raise

    def save_trainer(self, force_save: bool = False) -> None:
        """Write a checkpoint if one is due; stops here if a signal has asked for it."""
        due = stop_asked() or time.monotonic() >= self._save_at
        super().save_trainer(force_save or due)
        raise_if_asked()

    def _save_trainer(self) -> None:
        with unbroken():
            super()._save_trainer()
        self._saved_frames = self.collected_frames
        self._save_at = time.monotonic() + SAVE_SECONDS

    def compute_loss(self, sub_batch: TensorDictBase) -> TensorDictBase:
        """Return the losses of a batch; one that is not finite is refused.

        Raises:
            FloatingPointError: if one is not finite; nothing has been changed by it.
        """
        losses = super().compute_loss(sub_batch)
        for name in losses.keys():
            if name.startswith("loss") and not math.isfinite(losses.get(name).detach().sum()):
                raise self.not_finite(name, losses.get(name).detach().sum())
        return losses

    def last_good_checkpoint(self) -> str:
        """Return a sentence that says how to continue after an error."""
        saved = None if self.rotation is None else self.rotation.latest()
        if saved is None:
            return "There is no checkpoint: pass save_dir to have some."
        return f"The last good checkpoint is {str(saved)!r}: trainer.load() continues from it."

    def not_finite(self, name: str, value: Any) -> FloatingPointError:
        """Return the error of a figure that is not finite, which names the last checkpoint."""
        again = self.last_good_checkpoint()
        return FloatingPointError(
            f"{name} is {float(value)} in update {self._num_updates()}, after "
            f"{self.collected_frames} base steps. The update was not applied. {again} Look for "
            "rewards or observations that are not finite, or lower the learning rate."
        )


class DetachedStepper(DefaultOptimizationStepper):
    """TorchRL's default step, which refuses a gradient that is not finite.

    What it logs is kept for the history and must not hold a graph.
    """

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        return super().step(trainer, sub_batch).detach()

    def _compute_and_clip_grad_norm(self, optimizer: Any, *clipping: Any) -> float:  # type: ignore[override]
        norm = super()._compute_and_clip_grad_norm(optimizer, *clipping)
        if not math.isfinite(norm):
            optimizer.zero_grad()
            if isinstance(self._trainer, ResumableTrainer):
                raise self._trainer.not_finite("The gradient's norm", norm)
            raise FloatingPointError(f"The gradient's norm is {norm}; it was not applied.")
        return norm
