"""Algorithm 3: skills that are learned from the searches that use them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.objectives import LossModule, SoftUpdate
from torchrl.trainers import TargetNetUpdaterHook

from torchrl_hmcts.arguments import name_arguments
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import UCT, MCTSPlanner, SearchBudget
from torchrl_hmcts.processes import system_errors
from torchrl_hmcts.trainers.diayn import Progress, make_skill_optimizer
from torchrl_hmcts.trainers.evaluation import plan_and_execute
from torchrl_hmcts.trainers.saving.resume import ResumableTrainer
from torchrl_hmcts.trainers.skills.dataset import UnionSampler, load_dataset
from torchrl_hmcts.trainers.skills.rounds import PlanningRounds, RoundRecords, seeded
from torchrl_hmcts.transforms import OptionRecorder, OptionTransform, SkillReward


@name_arguments
class HMCTSTrainer(ResumableTrainer):
    r"""Learns skills and plans over them in turn: the source's Algorithm 3.

    With D a dataset that may be empty and S the samples of this run:

    1. train the worker h on D, if D is not empty;
    2. draw ``num_init_samples`` options uniformly, carry them out, and keep them as S;
    3. for t = 0, 1, ..., T - ``num_init_samples``: if ``retrain_interval`` divides t, train h on
       :math:`S \cup D`; then play round t (there is none after the last training): search a plan
       by UCT whose expansions are options carried out by h, and carry the plan out.

    A sample is a trajectory of one option; a round adds all those that it simulated and executed,
    by an :class:`OptionRecorder` in the simulator and in the env. During training the worker
    samples its actions; in test rounds it takes the most probable ones.

    A run that is resumed (``load``) is the same bit for bit as one that never stopped, if it had
    stopped after a multiple of ``retrain_interval`` rounds.

    The rounds between two trainings have the same worker and are searched side by side. The frames
    that the ``Trainer`` counts and passes to its logger as steps are the base steps of S.

    Args:
        make_env (callable): returns a fresh base env in which plans are carried out, stateless
            (``batch_locked=False``), e.g. ``partial(WaterworldMazeEnv, observation=False)``.
        loss_module (LossModule): of the skills, e.g. ``DIAYNTrainer.make_loss(...)``; the source's
            N_policies is its number of skills.
        rounds (int): T, with the initial samples, as in the source. Default ``200``.
        num_init_samples (int): N_init, options carried out before the first round. Default ``64``.
        retrain_interval (int): N_retrain, rounds between two trainings. Default ``4``.
        option_steps (int): N_worker_samples, base steps of an option at most. Default ``25``, which
            needs fewer simulated steps in Waterworld than the source's 100.
        c_p (float): constant of UCT. Default ``1.0``.
        dataset (ReplayBuffer, TensorDict or path, optional): D, transitions ``[n]`` with the
            loss's ``in_keys``, e.g. recorded by an :class:`OptionRecorder`; see
            :func:`load_dataset`. Default ``None``: empty.
        dataset_fraction (float, optional): share of each batch that is drawn from D. Default
            ``None``: uniformly from the union, so the share of D falls as S grows.
        make_simulator (callable, optional): as ``make_env``, for the search. Default: ``make_env``.
        make_options (callable): ``make_options(worker, num_skills, option_steps,
            trajectory_keys=...)`` builds the ``OptionTransform``. Default: the class itself; pass a
            ``functools.partial`` of it for a discount or a termination.
        make_recorder (callable): ``make_recorder(keys)`` builds the two recorders. Default: the
            class itself; pass a ``functools.partial`` of it for another ``position_key``.
        make_planner (callable): ``make_planner(simulator, tree_policy=UCT(c_p), seed=...)`` builds
            the planner, e.g. ``partial(MCTSPlanner, novelty=..., budget=...)``. Bound its budget:
            an untrained worker finds few plans. Default: :class:`MCTSPlanner` with 50 expansions.
        worker, test_worker (TensorDictModule, optional): carry options out in training and in test
            rounds. Default: :class:`SkillPolicy` over the loss's actor, sampling and greedy.
        make_test_env (callable, optional): as ``make_env``, with held-out episodes. Default
            ``None``: no test rounds.
        make_test_planner (callable, optional): as ``make_planner``. Default: ``make_planner``.
        test_rounds (int): episodes of a test, the same in each. Default ``32``.
        test_interval (int): trainings between two tests. Default ``1``. There is one before the
            first round and one after the last as well.
        updates_per_step (float): updates of a training per base step that S has gained. Default
            ``3 / 64``, that of :class:`DIAYNTrainer`.
        pretrain_updates (int, optional): updates on D. Default: ``updates_per_step`` for each
            transition of D.
        batch_size (int): transitions per update. Default ``256``.
        buffer_size (int): transitions of S that are kept. Default ``20_000``.
        optimizer (Optimizer, optional): Default: ``make_skill_optimizer(loss_module)``.
        reward (Transform, optional): writes the reward of the sampled transitions. Default: the
            intrinsic reward of the loss.
        target_tau (float): share of the critics moved into their targets per update. Default
            ``0.05``.
        clip_norm (float): bound of the gradient's norm. Default ``10.0``.
        total_frames (int, optional): base steps of S after which no more rounds are played; those
            of the last ``retrain_interval`` rounds may go beyond. Default ``None``: no limit.
        save_dir (path, optional): folder of the checkpoints, one after every training. Default
            ``None``: none.
        keep_last (int): checkpoints kept. Default ``2``.
        progress (callable, optional): ``progress(total=rounds)`` returns a progress bar, e.g.
            ``tqdm.tqdm``. Default ``None``: quiet.
        seed (int): all random numbers of a round or training are a function of it and of t.
            Default ``0``.
        **trainer_kwargs: passed to ``torchrl.trainers.Trainer`` (``logger``, ...).

    Raises:
        ValueError: if a number is out of range, the env is not stateless, or D lacks an entry.

    Reference:
        Bartley 2023, algorithm 3 and figure 4.10.

    Examples:
        >>> from functools import partial
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
        >>> from torchrl_hmcts.trainers.diayn import DIAYNTrainer
        >>> from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
        >>> from torchrl_hmcts.trainers.experiments.waterworld.worker import make_training_env
        >>> loss = DIAYNTrainer.make_loss(make_training_env(), num_skills=4, seed=0)
        >>> trainer = HMCTSTrainer(
        ...     partial(WaterworldMazeEnv, observation=False), loss,
        ...     rounds=6, num_init_samples=4, retrain_interval=2,
        ...     make_planner=partial(MCTSPlanner, novelty=RadiusNovelty("position", 0.7),
        ...                          budget=SearchBudget(expansions=2)))
        >>> trainer.train()
        >>> trainer.retrained_at, trainer.records.columns["round"].tolist()
        ([0, 2], [0, 1])
    """

    def __init__(
        self,
        make_env: Callable[[], EnvBase],
        loss_module: LossModule,
        *,
        rounds: int = 200,
        num_init_samples: int = 64,
        retrain_interval: int = 4,
        option_steps: int = 25,
        c_p: float = 1.0,
        dataset: ReplayBuffer | TensorDictBase | str | Path | None = None,
        dataset_fraction: float | None = None,
        make_simulator: Callable[[], EnvBase] | None = None,
        make_options: Callable[..., OptionTransform] = OptionTransform,
        make_recorder: Callable[..., OptionRecorder] = OptionRecorder,
        make_planner: Callable[..., MCTSPlanner] | None = None,
        worker: TensorDictModuleBase | None = None,
        test_worker: TensorDictModuleBase | None = None,
        make_test_env: Callable[[], EnvBase] | None = None,
        make_test_planner: Callable[..., MCTSPlanner] | None = None,
        test_rounds: int = 32,
        test_interval: int = 1,
        updates_per_step: float = 3 / 64,
        pretrain_updates: int | None = None,
        batch_size: int = 256,
        buffer_size: int = 20_000,
        optimizer: torch.optim.Optimizer | None = None,
        reward: torch.nn.Module | None = None,
        target_tau: float = 0.05,
        clip_norm: float = 10.0,
        total_frames: int | None = None,
        save_dir: str | Path | None = None,
        keep_last: int = 2,
        progress: Callable[..., Progress] | None = None,
        seed: int = 0,
        **trainer_kwargs: Any,
    ) -> None:
        for name, value, low in (
            ("num_init_samples", num_init_samples, 1),
            ("rounds", rounds, num_init_samples),
            ("retrain_interval", retrain_interval, 1),
            ("test_rounds", test_rounds, 1),
            ("test_interval", test_interval, 1),
        ):
            if value < low:
                raise ValueError(
                    f"HMCTSTrainer needs {name} >= {low}; got {value}."
                    + (" The rounds include num_init_samples." if name == "rounds" else "")
                )
        if dataset_fraction is not None and not 0.0 <= dataset_fraction <= 1.0:
            raise ValueError(
                f"HMCTSTrainer needs dataset_fraction between 0 and 1; got {dataset_fraction}."
            )
        keys = list(loss_module.in_keys)
        self.dataset = load_dataset(dataset, keys)
        actor = loss_module.actor_network
        worker = SkillPolicy(actor) if worker is None else worker
        if test_worker is None:
            test_worker = SkillPolicy(actor, deterministic=True)
        num_skills = worker.num_skills if hasattr(worker, "num_skills") else actor.num_skills
        recorders = make_recorder(keys), make_recorder(keys)

        def make_macro(make: Callable[[], EnvBase], recorder: OptionRecorder) -> TransformedEnv:
            base = make()
            if base.batch_locked:
                raise ValueError(
                    f"HMCTSTrainer plays rounds side by side in an env whose state is in the "
                    f"tensordict; {type(base).__name__} is batch_locked. Use a stateless "
                    "one, e.g. WaterworldMazeEnv()."
                )
            options = make_options(
                worker, num_skills, option_steps, trajectory_keys=recorder.trajectory_keys
            )
            return TransformedEnv(base, Compose(options, recorder))

        if make_planner is None:
            make_planner = partial(MCTSPlanner, budget=SearchBudget(expansions=50))
        env = make_macro(make_env, recorders[0])
        simulator = make_macro(make_simulator or make_env, recorders[1])
        collector = PlanningRounds(
            env,
            simulator,
            partial(make_planner, tree_policy=UCT(c_p)),
            recorders,
            num_init_samples=num_init_samples,
            interval=retrain_interval,
            rounds=rounds - num_init_samples,
            seed=seed,
        )
        with system_errors("HMCTSTrainer cannot have the shared memory of its replay buffer"):
            buffer = ReplayBuffer(storage=LazyTensorStorage(buffer_size), batch_size=batch_size)
        if optimizer is None:
            optimizer = make_skill_optimizer(loss_module)
        if reward is None:
            reward = SkillReward(loss_module.objective)
        if save_dir is not None:
            trainer_kwargs.setdefault("save_trainer_interval", 0)
        updater = SoftUpdate(loss_module, tau=target_tau)
        super().__init__(
            collector=collector,
            total_frames=2**62 if total_frames is None else total_frames,
            frame_skip=1,
            optim_steps_per_batch=1,  # set before every training
            loss_module=loss_module,
            optimizer=optimizer,
            replay_buffer=buffer,
            target_net_updater=updater,
            batch_size=batch_size,
            clip_norm=clip_norm,
            progress_bar=False,
            save_dir=save_dir,
            keep_last=keep_last,
            **{"log_interval": -1, **trainer_kwargs},
        )
        self.seed = seed
        self.run_settings.update(
            option_steps=option_steps,
            c_p=c_p,
            updates_per_step=updates_per_step,
            batch_size=batch_size,
            buffer_size=buffer_size,
            dataset_fraction=dataset_fraction,
            target_tau=target_tau,
            clip_norm=clip_norm,
        )
        self.rounds, self.num_init_samples = rounds, num_init_samples
        self.retrain_interval, self.test_interval = retrain_interval, test_interval
        self.updates_per_step, self.pretrain_updates = updates_per_step, pretrain_updates
        self.retrained_at: list[int] = []  # the t of every training
        self._trained_steps = 0  # base steps of S at the latest training
        self.records = collector.records
        self.test_records = RoundRecords()
        self._planner_for_tests = partial(
            make_test_planner or make_planner, tree_policy=UCT(c_p), seed=seed
        )
        self._test_env: EnvBase | None = None
        if make_test_env is not None:
            options = make_options(test_worker, num_skills, option_steps)
            self._test_env = TransformedEnv(make_test_env(), options)
            self._test_env.set_seed(seed)
            self._test_starts = self._test_env.reset(TensorDict(batch_size=[test_rounds]))
        union = UnionSampler(buffer, self.dataset, batch_size, dataset_fraction, reward)
        self.register_op("setup", self._begin)
        self.register_op("batch_process", self._extend)
        self.register_op("process_optim_batch", union.sample)
        self.register_op("post_optim", TargetNetUpdaterHook(updater))
        self.register_op("post_steps_log", self._report)
        self.register_module("hmcts", _Progressed(self))
        self._bar: Progress | None = None
        self._bar_at = 0
        if progress is not None:
            self._bar = progress(total=collector.rounds)
            self.register_op("shutdown", self._bar.close)

    # ---------------------------------------------------------------- stages of the training

    def _begin(self) -> None:
        """Before the first round: train on D, and test."""
        self._stop_training = False
        if self.collector.round >= 0:  # it goes on
            return
        if len(self.dataset):
            updates = self.pretrain_updates
            if updates is None:
                updates = round(self.updates_per_step * len(self.dataset))
            self._train_worker("pretrain", 0, updates, self.dataset[: self.batch_size])
        self._test()

    def _extend(self, batch: TensorDictBase) -> TensorDictBase:
        self.replay_buffer.extend(batch)
        return batch

    def optim_steps(self, batch: TensorDictBase) -> None:
        """Train the worker if ``retrain_interval`` divides the number of rounds played so far."""
        t = self.collector.round
        if t % self.retrain_interval == 0:
            updates = round(self.updates_per_step * (self.collected_frames - self._trained_steps))
            self._trained_steps = self.collected_frames
            self.retrained_at.append(t)
            self._train_worker("train", t, updates, batch)

    def _train_worker(self, phase: str, t: int, updates: int, batch: TensorDictBase) -> None:
        self.optim_steps_per_batch = max(1, updates)
        with seeded(self.seed, phase, t):
            super().optim_steps(batch)

    def _test(self) -> None:
        if self._test_env is None:
            return
        planner = self._planner_for_tests(self._test_env)
        with seeded(self.seed, "test", 0):
            results = plan_and_execute(planner, self._test_env, self._test_starts)
        figures = self.test_records.add(
            results, np.arange(len(results.solved)), self.collected_frames
        )
        self._log(**{f"test/{name}": value for name, value in figures.items()})

    def _report(self, batch: TensorDictBase) -> None:
        """After every batch: log the rounds, test, show the progress."""
        t, figures = self.collector.round, self.collector.latest
        if figures:
            self._log(**{f"rounds/{name}": value for name, value in figures.items()})
        last = t >= self.collector.rounds or self.collected_frames >= self.total_frames
        due = (len(self.retrained_at) - 1) % self.test_interval == 0
        if self.retrained_at[-1] == t and (due or last):
            self._test()
        if self._bar is not None:
            shown = {name: f"{value:,.2f}" for name, value in figures.items()}
            self._bar.set_postfix(refresh=False, **shown)
            self._bar.update(t - self._bar_at)
            self._bar_at = t
        if t >= self.collector.rounds:
            self.request_stop("All rounds have been played.")


class _Progressed:
    """How far the trainer is, and what its tests gave."""

    def __init__(self, trainer: HMCTSTrainer) -> None:
        self.trainer = trainer

    def state_dict(self) -> dict[str, Any]:
        return {
            "retrained_at": torch.tensor(self.trainer.retrained_at, dtype=torch.int64),
            "trained_steps": self.trainer._trained_steps,
            "tests": self.trainer.test_records.state_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        self.trainer.retrained_at = state_dict["retrained_at"].tolist()
        self.trainer._trained_steps = int(state_dict["trained_steps"])
        self.trainer.test_records.load_state_dict(state_dict["tests"])
