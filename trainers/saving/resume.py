"""Checkpoints from which training goes on as if it had never stopped.

TorchRL's ``Trainer`` saves the loss, the optimiser, the replay buffer and its counters. What else
the next update depends on is saved by the components here, each of them an object with
``state_dict`` and ``load_state_dict`` to hand to any ``torchrl.checkpoint.Checkpoint``:
the running episodes (:class:`RunningEpisodes`), the random number generators that envs, transforms
and policies own (:class:`GeneratorStates`) and the curves so far (:class:`HistoryState`).
:class:`ResumableTrainer` is a ``Trainer`` with all of them.
"""

from __future__ import annotations

import math
import random
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.checkpoint import CheckpointError, GlobalRNGState
from torchrl.collectors import BaseCollector, Collector
from torchrl.trainers import DefaultOptimizationStepper, Trainer

from torchrl_hmcts.arguments import name_arguments
from torchrl_hmcts.trainers.saving.checkpoints import (
    DurableRotation,
    PlainStateAdapter,
    check_settings,
    newest_checkpoint,
    plain_checkpoint,
)
from torchrl_hmcts.trainers.saving.locking import folder_locked
from torchrl_hmcts.trainers.saving.stopping import patient, raise_if_asked, stop_asked, unbroken

FIRST_SAVE_SECONDS = 5.0  # of training, after which there is a checkpoint whatever the interval
SAVE_SECONDS = 60.0  # between two checkpoints, at most

Generator = torch.Generator | np.random.Generator | random.Random


@name_arguments
class RunningEpisodes:
    """State of the episodes that a collector is in the middle of.

    A collector's own state dict has its counters and the env's transforms, but not where the
    episodes stand, so that a resumed run would begin new ones. This adds the tensordict from which
    the collector takes its next step. It needs an env whose whole state is in the tensordict: one
    whose ``_supports_set_state`` is True or whose ``batch_locked`` is False, as those of
    ``torchrl_hmcts.envs``. In other envs, e.g. ``GymEnv``, new episodes begin on loading.

    Args:
        collector (Collector): single-process collector.

    Attributes:
        new_episodes (bool, optional): whether loading leaves the saved episodes out and begins new
            ones. Default ``None``: only where the env cannot be set to their states; a line on
            stderr says so.

    Raises:
        TypeError: if the collector runs its envs in other processes.

    Examples:
        >>> from torchrl.collectors import Collector
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> from torchrl_hmcts.trainers.saving.resume import RunningEpisodes
        >>> collector = Collector(
        ...     WaterworldMazeEnv(batch_size=[2], observation=False),
        ...     frames_per_batch=4, total_frames=8, auto_register_policy_transforms=False)
        >>> RunningEpisodes(collector).state_dict()["entries"]["position"].shape
        torch.Size([2, 2])
        >>> collector.shutdown()
    """

    def __init__(self, collector: BaseCollector) -> None:
        if not isinstance(collector, Collector):
            raise TypeError(
                f"RunningEpisodes saves the episodes of a Collector, which runs in this process; "
                f"{type(collector).__name__} keeps its own in others. Collect with "
                "torchrl.collectors.Collector, or do without exact resume."
            )
        self.collector = collector
        self.new_episodes: bool | None = None

    @property
    def complete(self) -> bool:
        """Whether the env's whole state is in the tensordict."""
        env = self.collector.env
        return bool(env._supports_set_state or not env.batch_locked)

    def state_dict(self) -> dict[str, Any]:
        """Returns the episodes as they stand: their entries, and what the collector counts."""
        carrier = self.collector._carrier
        state: dict[str, Any] = {
            "batch_size": list(carrier.batch_size),
            "entries": carrier.to_dict(convert_tensors=False),
        }
        if self.collector.track_traj_ids:
            state["traj_pool"] = self.collector._traj_pool.state_dict()
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Lets the collector continue the episodes that :meth:`state_dict` returned.

        Raises:
            ValueError: if the env has another batch size; or if it cannot be set to a state and
                ``new_episodes`` is False.
        """
        env = getattr(self.collector.env, "base_env", self.collector.env)
        if self.new_episodes or (self.new_episodes is None and not self.complete):
            if self.new_episodes is None:
                print(
                    f"{type(env).__name__} keeps state of its own, so the episodes "
                    "that were under way are left out; new ones begin.",
                    file=sys.stderr,
                )
            return  # a collector that has not collected yet stands at the beginning of some
        if not self.complete:
            raise ValueError(
                f"{type(env).__name__} keeps state of its own, so its episodes "
                "cannot continue from a checkpoint. Use an env that can be set to any state, or "
                "load with new_episodes=True."
            )
        old = self.collector._carrier
        saved = torch.Size(state_dict["batch_size"])
        if saved != old.batch_size:
            raise ValueError(
                f"The checkpoint has episodes of an env of batch size {list(saved)}; this one has "
                f"{list(old.batch_size)}. Resume with as many copies as before."
            )
        self.collector._carrier = TensorDict(
            dict(state_dict["entries"]), batch_size=saved, device=old.device
        )
        if "traj_pool" in state_dict and self.collector.track_traj_ids:
            # The collector's own load has given out numbers for the episodes it would have begun.
            self.collector._traj_pool.load_state_dict(state_dict["traj_pool"])


class GeneratorStates:
    """States of all random number generators that objects own.

    Looks through the attributes of the owners and of every ``nn.Module`` (env, transform, policy)
    and list, tuple or dict below them for ``torch.Generator``, ``numpy.random.Generator`` and
    ``random.Random``. The global generators are ``torchrl.checkpoint.GlobalRNGState``'s.

    Args:
        **owners: objects to look through, by the names their states get. After loading, owners of
            the same names must have the same generators.

    Raises:
        ValueError: on loading, if a generator of the checkpoint is missing here.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> from torchrl_hmcts.trainers.saving.resume import GeneratorStates
        >>> env = WaterworldMazeEnv(seed=0)
        >>> states = GeneratorStates(env=env)
        >>> before = states.state_dict()
        >>> first = env.reset()["position"]
        >>> states.load_state_dict(before)
        >>> bool((env.reset()["position"] == first).all())
        True
    """

    def __init__(self, **owners: Any) -> None:
        self.owners = owners

    def generators(self) -> dict[str, Generator]:
        """Returns the generators by their path, e.g. ``"env._generator"``."""
        seen: set[int] = set()
        return dict(
            found for name, owner in self.owners.items() for found in _find(name, owner, seen, True)
        )

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of every generator, by the path to it."""
        return {path: _get_state(generator) for path, generator in self.generators().items()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Sets the generators to the states that :meth:`state_dict` returned."""
        generators = self.generators()
        missing = sorted(set(state_dict).difference(generators))
        if missing:
            raise ValueError(
                f"The checkpoint has states of the generators {missing}; found here: "
                f"{sorted(generators)}. Build env, transforms and policy as in the saved run."
            )
        for path, state in state_dict.items():
            _set_state(generators[path], state)


class HistoryState:
    """The curves that a ``Trainer`` has logged so far.

    Args:
        trainer (Trainer): whose log is saved.

    Examples:
        >>> from torchrl_hmcts.trainers.saving.resume import HistoryState
        >>> class Logged:
        ...     _log_dict = {"loss_actor": [torch.tensor(0.5), 0.25]}
        >>> HistoryState(Logged()).state_dict()["loss_actor"].tolist()
        [0.5, 0.25]
    """

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {
            key: torch.tensor([float(value) for value in values], dtype=torch.float64)
            for key, values in self.trainer._log_dict.items()
        }

    def load_state_dict(self, state_dict: Mapping[str, torch.Tensor]) -> None:
        self.trainer._log_dict.clear()
        for key, values in state_dict.items():
            self.trainer._log_dict[key] = values.tolist()


class _BufferAdapter(PlainStateAdapter):
    """Writes a replay buffer; rows without an entry are zeros, not what the memory held before."""

    def save(
        self, component: Any, path: Path, *, args: tuple[Any, ...], kwargs: Mapping[str, Any]
    ) -> Any:
        storage = component.storage
        rows = getattr(storage, "_storage", None)
        if isinstance(rows, torch.Tensor | TensorDictBase) and storage.ndim == 1:
            rows[len(storage) :].zero_()
        return super().save(component, path, args=args, kwargs=kwargs)


class ResumableTrainer(Trainer):
    """A TorchRL ``Trainer`` that resumes exactly, and stops before it learns from NaN.

    Training to 2 n base steps and training to n, loading in a new process and training to 2 n give
    the same weights, optimiser state, replay buffer, random numbers, counters and curves, bit for
    bit, if the env's whole state is in its tensordict. Checkpoints are written so that a crash
    cannot damage one (:class:`DurableRotation`) and are read without pickle.

    Ctrl-C and SIGTERM stop a training after the batch under way, which is saved; then
    ``KeyboardInterrupt`` is raised. A second Ctrl-C, a second later or more, stops it at once. One
    trainer at a time writes to a ``save_dir``.

    Args:
        save_dir (path, optional): folder of the checkpoints; one is written after 5 seconds of
            training, whenever ``save_trainer_interval`` base steps or a minute have passed, and at
            the end. Default ``None``: no checkpoints.
        keep_last (int): checkpoints kept. Default ``2``.
        overwrite (bool): replace the checkpoints of another run in ``save_dir``; they are removed
            once this run has written one. Default ``False``: ``train()`` refuses such a folder.
        **trainer_kwargs: passed to ``torchrl.trainers.Trainer``.

    Attributes:
        run_settings (dict): values that a run must keep when it goes on, by name (JSON). They are
            written into its checkpoints; :meth:`load` refuses others.

    Raises:
        ValueError: if ``save_dir`` is given together with TorchRL's ``checkpoint_rotation`` or
            ``save_trainer_file``.
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
        self.run_settings: dict[str, Any] = {"trainer": type(self).__name__}
        for part in ("loss_module", "optimizer"):
            if trainer_kwargs.get(part) is not None:
                self.run_settings[part] = type(trainer_kwargs[part]).__name__
        if save_dir is not None:
            for other in ("checkpoint_rotation", "save_trainer_file"):
                if trainer_kwargs.get(other) is not None:
                    raise ValueError(
                        f"save_dir={str(save_dir)!r} and {other} both say where checkpoints go. "
                        "Pass one of them."
                    )
            rotation = DurableRotation(save_dir, keep_last=keep_last, overwrite=overwrite)
            rotation.settings = self.run_settings
            trainer_kwargs["checkpoint_rotation"] = rotation
        if trainer_kwargs.get("checkpoint") is None and not trainer_kwargs.get("save_trainer_file"):
            trainer_kwargs["checkpoint"] = plain_checkpoint()
        trainer_kwargs.setdefault("optimization_stepper", DetachedStepper())
        checkpoint, buffer = (trainer_kwargs.get(k) for k in ("checkpoint", "replay_buffer"))
        if checkpoint is not None and buffer is not None and "replay_buffer" not in checkpoint:
            # A buffer's own dump() writes a pickle beside the tensors; its state dict needs none.
            checkpoint.register("replay_buffer", buffer, adapter=_BufferAdapter())
        super().__init__(**trainer_kwargs)
        self._save_at = math.inf  # time at which a checkpoint is due
        # TorchRL keeps this dict on the class, where the next trainer built would empty it.
        self._last_log: dict[str, Any] = {}
        self._saved_frames = -1  # base steps at the newest checkpoint
        if self.checkpoint is not None and "rng" not in self.checkpoint:
            self.checkpoint.register("rng", GlobalRNGState())
        collector = self.collector
        self.register_module("history", HistoryState(self))
        if isinstance(collector, Collector):
            self.register_module("running_episodes", RunningEpisodes(collector))
            self.register_module(
                "generators", GeneratorStates(env=collector.env, policy=collector._wrapped_policy)
            )

    @property
    def history(self) -> dict[str, list[float]]:
        """All values logged so far, by name."""
        return {key: [float(x) for x in values] for key, values in self._log_dict.items()}

    def _shutdown_hook(self) -> None:
        # A collector that ends by itself leaves TorchRL's loop without the checkpoint of the end.
        if self.checkpoint_rotation is not None and self._saved_frames != self.collected_frames:
            self.save_trainer(force_save=True)
        super()._shutdown_hook()

    def load(self, path: str | Path, *, new_episodes: bool | None = None) -> ResumableTrainer:
        """Continues from a checkpoint; call it before ``train()``.

        Args:
            path (path): a checkpoint, or a folder of checkpoints (``save_dir``), of which the
                newest whole one is taken.
            new_episodes (bool, optional): leave the episodes that were under way out, and begin
                new ones. Default ``None``: only in an env that cannot be set to a state (e.g.
                ``GymEnv``), and a line on stderr says so; all else continues exactly. False:
                refuse such an env.

        Returns:
            ResumableTrainer: itself.

        Raises:
            FileNotFoundError: if there is no checkpoint.
            CheckpointError: if the checkpoint is damaged, of a newer version or of other settings,
                or does not fit, e.g. another number of copies.
        """
        found = newest_checkpoint(path)
        check_settings(found, self.run_settings)
        episodes = self._modules.get("running_episodes")
        if isinstance(episodes, RunningEpisodes):
            episodes.new_episodes = new_episodes
        self.load_from_file(found)
        if not all(type(n) is int and n >= 0 for n in (self.collected_frames, self._optim_count)):
            raise CheckpointError(
                f"The checkpoint {str(found)!r} has {self.collected_frames!r} base steps and "
                f"{self._optim_count!r} updates, which are no counts. Load an older one."
            )
        if isinstance(self.checkpoint_rotation, DurableRotation):
            self.checkpoint_rotation.continue_from(found)
        return self

    def train(self) -> None:
        """Trains until ``total_frames`` are collected.

        Raises:
            KeyboardInterrupt: after Ctrl-C or SIGTERM; a checkpoint has been written.
            FileExistsError: if ``save_dir`` holds the checkpoints of a run that was not loaded,
                unless ``overwrite`` is true.
            FolderInUse: if another run writes to ``save_dir``.
        """
        if isinstance(self.checkpoint_rotation, DurableRotation):
            self.checkpoint_rotation.begin()
        self._save_at = time.monotonic() + FIRST_SAVE_SECONDS
        folder = getattr(self.checkpoint_rotation, "directory", None)
        with folder_locked(folder) if folder else nullcontext(), patient():
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
        """Writes a checkpoint if one is due; stops here if a signal has asked for it.

        Args:
            force_save: write one in any case.
        """
        due = stop_asked() or time.monotonic() >= self._save_at
        super().save_trainer(force_save or due)
        raise_if_asked()

    def _save_trainer(self) -> None:
        with unbroken():
            super()._save_trainer()
        self._saved_frames = self.collected_frames
        self._save_at = time.monotonic() + SAVE_SECONDS

    def compute_loss(self, sub_batch: TensorDictBase) -> TensorDictBase:
        """Returns the losses of a batch.

        Raises:
            FloatingPointError: if one is not finite; nothing has been changed by it.
        """
        losses = super().compute_loss(sub_batch)
        for name in losses.keys():
            if name.startswith("loss") and not math.isfinite(losses.get(name).detach().sum()):
                raise self.not_finite(name, losses.get(name).detach().sum())
        return losses

    def last_good_checkpoint(self) -> str:
        """Returns a sentence that says how to go on after an error."""
        rotation = self.checkpoint_rotation
        saved = None if rotation is None else rotation.latest()
        if saved is None:
            return "There is no checkpoint: pass save_dir to have some."
        return f"The last good checkpoint is {str(saved)!r}: trainer.load() goes on from it."

    def not_finite(self, name: str, value: Any) -> FloatingPointError:
        """Returns the error of a figure that is not finite, which names the last checkpoint."""
        again = self.last_good_checkpoint()
        return FloatingPointError(
            f"{name} is {float(value)} in update {self._optim_count}, after "
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


def _find(
    path: str, value: Any, seen: set[int], owner: bool = False
) -> Iterator[tuple[str, Generator]]:
    """Yields the generators below a value with their paths."""
    if id(value) in seen:
        return
    if isinstance(value, torch.Generator | np.random.Generator | random.Random):
        seen.add(id(value))
        yield path, value
        return
    items: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, list | tuple):
        items = list(enumerate(value))
    elif isinstance(value, nn.Module) or (owner and hasattr(value, "__dict__")):
        items = list(vars(value).items())
    if items:
        seen.add(id(value))
        for name, item in items:
            yield from _find(f"{path}.{name}", item, seen)


def _get_state(generator: Generator) -> Any:
    if isinstance(generator, torch.Generator):
        return generator.get_state()
    if isinstance(generator, np.random.Generator):
        return generator.bit_generator.state
    return generator.getstate()


def _set_state(generator: Generator, state: Any) -> None:
    if isinstance(generator, torch.Generator):
        generator.set_state(state)
    elif isinstance(generator, np.random.Generator):
        generator.bit_generator.state = state
    else:
        generator.setstate(state)
