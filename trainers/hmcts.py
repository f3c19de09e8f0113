"""Algorithm 3: skills learn from the searches that use them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.objectives import LossModule

from torchrl_hmcts.checks import instance, real_number, whole_number
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import UCT, MCTSPlanner, SearchBudget
from torchrl_hmcts.trainers.diayn import make_skill_optimizer
from torchrl_hmcts.trainers.evaluation import plan_and_execute
from torchrl_hmcts.trainers.off_policy import OffPolicyTrainer, Progress, made_by
from torchrl_hmcts.trainers.skills.dataset import load_dataset, sample_union
from torchrl_hmcts.trainers.skills.rounds import PlanningRounds, RoundRecords, seeded
from torchrl_hmcts.transforms import OptionRecorder, OptionTransform, SkillReward

_OWNER = "HMCTSTrainer"
_PASSED_ON = ("batch_size", "buffer_size", "clip_norm", "target_tau", "progress", "save_dir")
_KEPT = ("option_steps", "c_p", "updates_per_step", "dataset_fraction")  # when it is resumed


class HMCTSTrainer(OffPolicyTrainer):
    r"""Learns skills and plans over them in turn: the dissertation's Algorithm 3.

    With D a dataset that may be empty and S the samples of this run:

    1. train the worker h on D, if D is not empty;
    2. draw ``num_init_samples`` options uniformly, execute them, and keep them as S;
    3. for t = 0, 1, ..., T - ``num_init_samples``: if ``retrain_interval`` divides t, train h on
       :math:`S \cup D`; then play round t (there is none after the last training): search a plan
       by UCT whose expansions are options executed by h, and execute the plan.

    A sample is a trajectory of one option. A round adds all samples that it simulated and executed,
    by an :class:`OptionRecorder` in the simulator and in the env. During training the worker
    samples its actions; in test rounds it takes the most probable ones.

    A run that is resumed (``load``) is the same bit for bit as one that never stopped, if it had
    stopped after a multiple of ``retrain_interval`` rounds.

    The rounds between two trainings have the same worker and are searched side by side. The
    ``Trainer`` counts the base steps of S as its frames, and passes them to its logger as steps.

    Args:
        make_env (callable): returns a fresh base env in which plans are executed, stateless
            (``batch_locked=False``), e.g. ``partial(WaterworldMazeEnv, observation=False)``.
        loss_module (LossModule): of the skills, e.g. ``DIAYNTrainer.make_loss(...)``; the
            dissertation's N_policies is its number of skills.
        rounds (int): T, with the initial samples.
        num_init_samples (int): N_init, options executed before the first round.
        retrain_interval (int): N_retrain, rounds between two trainings.
        option_steps (int): N_worker_samples, base steps of an option at most. 25 needs fewer
            simulated steps in Waterworld than the dissertation's 100.
        c_p (float): constant of UCT.
        dataset (ReplayBuffer, TensorDict or path, optional): D, transitions ``[n]`` with the
            loss's ``in_keys``, e.g. recorded by an :class:`OptionRecorder`; a path is a folder of
            ``replay_buffer.dumps`` or ``tensordict.memmap``.
        dataset_fraction (float, optional): share of each batch that is drawn from D. Default:
            uniformly from the union, so the share of D falls as S grows.
        make_options (callable): ``make_options(worker, num_skills, option_steps,
            trajectory_keys=...)`` builds the ``OptionTransform``.
        make_recorder (callable): ``make_recorder(keys)`` builds the two recorders.
        make_planner, make_test_planner (callable): ``make_planner(simulator, tree_policy=UCT(c_p),
            seed=...)``, e.g. ``partial(MCTSPlanner, novelty=..., budget=...)``. Bound its budget:
            an untrained worker finds few plans. Default: :class:`MCTSPlanner` with 50 expansions.
        worker, test_worker (TensorDictModule, optional): execute options in training and in test
            rounds. Default: :class:`SkillPolicy` over the loss's actor, sampling and greedy.
        make_test_env (callable, optional): as ``make_env``, with held-out episodes. Default: no
            test rounds.
        test_rounds (int): episodes of a test, the same in each.
        test_interval (int): trainings between two tests; there is one before the first round and
            one after the last as well.
        updates_per_step (float): updates of a training per base step that S has gained.
        pretrain_updates (int, optional): updates on D. Default: ``updates_per_step`` for each
            transition of D.
        batch_size, buffer_size (int): transitions per update, and those of S that are kept.
        optimizer (Optimizer, optional): Default: ``make_skill_optimizer(loss_module)``.
        reward (Transform, optional): writes the reward of the sampled transitions. Default: the
            intrinsic reward of the loss.
        target_tau (float): share of the critics moved into their targets per update.
        clip_norm (float): bound of the gradient's norm.
        total_frames (int, optional): base steps of S after which no more rounds are played.
        save_dir (path, optional): folder of the checkpoints, one after every training.
        progress (callable, optional): ``progress(total=...)`` returns a progress bar over
            ``total_frames`` if they are given, else over rounds.
        seed (int): all random numbers of a round or training are a function of it and of t.
        **trainer_kwargs: passed to :class:`ResumableTrainer` (``logger``, ``keep_last``, ...).

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
        >>> from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env
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

    _trained_steps = 0  # base steps of S at the latest training
    _test_env: EnvBase | None = None

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
        progress: Callable[..., Progress] | None = None,
        seed: int = 0,
        **trainer_kwargs: Any,
    ) -> None:
        _check(given := dict(locals()))
        keys, actor = list(loss_module.in_keys), loss_module.actor_network
        self.dataset = load_dataset(dataset, keys)
        worker = SkillPolicy(actor) if worker is None else worker
        num_skills = getattr(worker, "num_skills", None) or actor.num_skills
        macro = _MacroEnvs(make_options, make_recorder, keys, num_skills, option_steps)
        make_planner = make_planner or partial(MCTSPlanner, budget=SearchBudget(expansions=50))
        collector = PlanningRounds(
            macro.recorded(worker, make_env),
            macro.recorded(worker, make_env),
            partial(make_planner, tree_policy=UCT(c_p)),
            num_init_samples=num_init_samples,
            interval=retrain_interval,
            rounds=rounds - num_init_samples,
            seed=seed,
        )
        reward = SkillReward(loss_module.objective) if reward is None else reward
        self._by_frames = total_frames is not None
        union = {"dataset": self.dataset, "batch_size": batch_size, "fraction": dataset_fraction}
        super().__init__(
            lambda: collector,
            loss_module,
            make_skill_optimizer(loss_module) if optimizer is None else optimizer,
            total_frames=2**62 if total_frames is None else total_frames,
            optim_steps_per_batch=1,  # set before every training
            sample=partial(sample_union, reward=reward, **union),
            settings={name: given[name] for name in _KEPT},
            progress_total=collector.rounds if total_frames is None else total_frames,
            **{name: given[name] for name in _PASSED_ON},
            **{"log_interval": -1, "save_trainer_interval": 0, **trainer_kwargs},
        )
        self.seed = seed
        self.retrain_interval, self.test_interval = retrain_interval, test_interval
        self.updates_per_step, self.pretrain_updates = updates_per_step, pretrain_updates
        self.records, self.test_records = collector.records, RoundRecords()
        self.retrained_at: list[int] = []  # the t of every training
        make_test_planner = make_test_planner or make_planner
        self._planner_for_tests = partial(make_test_planner, tree_policy=UCT(c_p), seed=seed)
        if make_test_env is not None:
            acts = SkillPolicy(actor, deterministic=True) if test_worker is None else test_worker
            self._test_env = macro.plain(acts, make_test_env, "make_test_env")
            self._test_env.set_seed(seed)
            self._test_starts = self._test_env.reset(TensorDict(batch_size=[test_rounds]))
        self.register_op("setup", self._begin)
        self.register_op("post_steps_log", self._report)
        self.register_module("hmcts", _Progressed(self))

    def progress_position(self) -> int:
        """Return the number of rounds played, or where ``total_frames`` are given base steps."""
        return int(self.collected_frames) if self._by_frames else max(0, self.collector.round)

    def progress_figures(self) -> dict[str, str]:
        return {name: f"{value:,.2f}" for name, value in self.collector.latest.items()}

    # ---------------------------------------------------------------- stages of the training

    def _begin(self) -> None:
        """Before the first round: train on D, and test."""
        if self.collector.round >= 0:  # it was resumed
            return
        if len(self.dataset):
            updates = self.pretrain_updates
            if updates is None:
                updates = round(self.updates_per_step * len(self.dataset))
            self._train_worker("pretrain", 0, updates, self.dataset[: self.batch_size])
        self._test()

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
        """After every batch: log the rounds, and test."""
        t, figures = self.collector.round, self.collector.latest
        if figures:
            self._log(**{f"rounds/{name}": value for name, value in figures.items()})
        last = t >= self.collector.rounds or self.collected_frames >= self.total_frames
        due = (len(self.retrained_at) - 1) % self.test_interval == 0
        if self.retrained_at[-1] == t and (due or last):
            self._test()
        if t >= self.collector.rounds:
            self.request_stop("All rounds have been played.")


@dataclass
class _MacroEnvs:
    """Makes envs of a worker's options, with or without a recorder."""

    make_options: Callable[..., OptionTransform]
    make_recorder: Callable[..., OptionRecorder]
    keys: list[NestedKey]
    num_skills: int
    option_steps: int

    def plain(
        self,
        worker: Any,
        make_env: Callable[[], EnvBase],
        argument: str,
        recorder: OptionRecorder | None = None,
    ) -> TransformedEnv:
        base = made_by(make_env, _OWNER, argument, EnvBase)
        if base.batch_locked:
            raise ValueError(
                f"{_OWNER} plays rounds side by side in an env whose state is in the tensordict; "
                f"{type(base).__name__} is batch_locked. Use a stateless one, e.g. "
                "WaterworldMazeEnv()."
            )
        keys = None if recorder is None else recorder.trajectory_keys
        args = (OptionTransform, worker, self.num_skills, self.option_steps)
        options = made_by(self.make_options, _OWNER, "make_options", *args, trajectory_keys=keys)
        return TransformedEnv(base, options if recorder is None else Compose(options, recorder))

    def recorded(self, worker: Any, make_env: Callable[[], EnvBase]) -> TransformedEnv:
        recorder = made_by(self.make_recorder, _OWNER, "make_recorder", OptionRecorder, self.keys)
        return self.plain(worker, make_env, "make_env", recorder)


def _check(given: Mapping[str, Any]) -> None:
    """Refuses arguments of the constructor that make no sense."""
    instance(_OWNER, "loss_module", given["loss_module"], LossModule)
    instance(_OWNER, "optimizer", given["optimizer"], torch.optim.Optimizer, NoneType)
    for name in ("make_planner", "make_test_planner", "reward", "worker", "test_worker"):
        instance(_OWNER, name, given[name], Callable, NoneType)
    for name in ("num_init_samples", "retrain_interval", "test_rounds", "test_interval"):
        whole_number(_OWNER, name, given[name], least=1)
    first = given["num_init_samples"]
    if whole_number(_OWNER, "rounds", given["rounds"]) < first:
        raise ValueError(
            f"{_OWNER} needs rounds >= {first}; got {given['rounds']}. The rounds include "
            "num_init_samples."
        )
    whole_number(_OWNER, "seed", given["seed"])
    if given["pretrain_updates"] is not None:
        whole_number(_OWNER, "pretrain_updates", given["pretrain_updates"])
    if given["dataset_fraction"] is not None:
        real_number(_OWNER, "dataset_fraction", given["dataset_fraction"], least=0.0, most=1.0)
    real_number(_OWNER, "updates_per_step", given["updates_per_step"], least=0.0)


class _Progressed:
    """The trainer's progress, and the results of its tests."""

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
