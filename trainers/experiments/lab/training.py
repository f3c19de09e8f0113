"""Training of the lab maze's worker, by Algorithm 3 or by DIAYN alone, and its curve on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.record.loggers import Logger

from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.objectives import DiscreteSkillSACLoss
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.diayn import DIAYNTrainer, Progress
from torchrl_hmcts.trainers.evaluation import plan_and_execute
from torchrl_hmcts.trainers.experiments.lab.config import (
    BATCH_STEPS,
    LabMazeConfig,
)
from torchrl_hmcts.trainers.experiments.lab.evaluation import make_maze_env, make_planner
from torchrl_hmcts.trainers.experiments.lab.script import ShortestPathScript
from torchrl_hmcts.trainers.experiments.lab.worker import (
    CURVE_SEED,
    PLACE_KEY,
    held_out_seeds,
    make_lab_env,
    make_training_env,
    make_worker_loss,
)
from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
from torchrl_hmcts.trainers.ray_collector import make_ray_collector
from torchrl_hmcts.trainers.saving.resume import ResumableTrainer
from torchrl_hmcts.trainers.skills.curves import Curves
from torchrl_hmcts.trainers.skills.rounds import RoundRecords, seeded
from torchrl_hmcts.transforms import OptionRecorder, OptionTransform

_CURVE_EXPANSIONS = 300  # of a search while the worker learns


@dataclass
class TrainedWorker:
    """A worker and how it became what it is.

    ``loss`` with its networks; ``history`` of all logged curves; ``tests`` in held-out mazes;
    ``steps`` base steps of training, simulated ones included; ``worker_step``, those that the
    networks have seen that are kept; ``rounds`` of Algorithm 3; ``seconds`` of the processor, tests
    included.
    """

    loss: DiscreteSkillSACLoss
    history: Mapping[str, list[float]]
    tests: RoundRecords
    steps: int
    rounds: int
    seconds: float
    worker_step: int

    @property
    def policy(self) -> SkillPolicy:
        """The worker with its most probable actions."""
        return SkillPolicy(self.loss.actor_network, deterministic=True)


def train_worker(
    config: LabMazeConfig,
    *,
    save_dir: str | Path | None = None,
    progress: Callable[..., Progress] | None = None,
    logger: Logger | None = None,
) -> TrainedWorker:
    """Train a worker as the configuration says.

    Args:
        config: of the experiment; with ``resume`` it goes on from the newest checkpoint.
        save_dir: folder of the checkpoints. Default: none are written.
        progress: makes a progress bar, e.g. ``tqdm.tqdm``.
        logger: of TorchRL; gets the training's values and, as ``test_solved`` and ``test_frames``,
            those of the tests on the way. Default: none.

    Reference:
        Dissertation, algorithm 3 and figures 4.6 to 4.10.
    """
    begin = time.process_time()
    loss = make_worker_loss(config.num_skills, seed=config.seed)
    make = _make_hmcts if config.algorithm == "hmcts" else _make_diayn
    trainer, tests = make(config, loss, save_dir, progress, logger)
    kept = [key for key in config.KEPT if key != "toy"]
    trainer.run_settings.update({name: getattr(config, name) for name in kept})
    if config.resume and save_dir is not None and any(Path(save_dir).glob("checkpoint-*")):
        trainer.load(save_dir)
    trainer.train()
    step = trainer.collected_frames
    if isinstance(tests, CurveTests) and config.keep == "best":
        step = tests.restore_best()
    return TrainedWorker(
        loss,
        Curves(trainer.history),
        tests.records if isinstance(tests, CurveTests) else tests,
        trainer.collected_frames,
        len(trainer.records) if isinstance(trainer, HMCTSTrainer) else 0,
        round(time.process_time() - begin, 1),
        step,
    )


def curve_script_frames(config: LabMazeConfig) -> float:
    """Return the mean frames of a script on the shortest path where the worker is tried."""
    env = make_lab_env(held_out_seeds(config.curve_mazes, first=CURVE_SEED))
    env.set_seed(config.seed)
    starts = env.reset(TensorDict(batch_size=[config.curve_mazes]))
    return float(np.mean(ShortestPathScript(env).frames(starts)))


def _make_hmcts(
    config: LabMazeConfig,
    loss: DiscreteSkillSACLoss,
    save_dir: str | Path | None,
    progress: Callable[..., Progress] | None,
    logger: Logger | None,
) -> tuple[ResumableTrainer, RoundRecords]:
    make_env = partial(make_lab_env, num_steps=config.frames_per_step, max_frames=config.max_frames)
    options = config.num_skills * config.option_steps
    batch = config.retrain_interval * config.round_expansions * options
    expected = max(1, (config.train_steps - config.init_options * config.option_steps) // batch)
    trainer = HMCTSTrainer(
        make_env,
        loss,
        rounds=2**31,  # ended by total_frames
        num_init_samples=config.init_options,
        retrain_interval=config.retrain_interval,
        option_steps=config.option_steps,
        make_options=partial(OptionTransform, gamma=config.gamma),
        make_recorder=partial(OptionRecorder, position_key=PLACE_KEY),
        make_planner=partial(
            MCTSPlanner,
            novelty=RadiusNovelty(PLACE_KEY, config.novelty_radius),
            budget=SearchBudget(expansions=config.round_expansions),
        ),
        make_test_env=partial(make_env, held_out_seeds(config.curve_mazes, first=CURVE_SEED)),
        make_test_planner=partial(
            MCTSPlanner,
            novelty=RadiusNovelty(PLACE_KEY, config.novelty_radius, shorter_paths=True),
            budget=_curve_budget(config),
            leaves_per_wave=config.leaves_per_wave,
        ),
        test_rounds=config.curve_mazes,
        test_interval=max(1, round(expected / config.curve_points)),
        updates_per_step=config.updates_per_step,
        total_frames=config.train_steps,
        save_dir=save_dir,
        progress=progress,
        logger=logger,
        seed=config.seed,
    )
    return trainer, trainer.test_records


def _make_diayn(
    config: LabMazeConfig,
    loss: DiscreteSkillSACLoss,
    save_dir: str | Path | None,
    progress: Callable[..., Progress] | None,
    logger: Logger | None,
) -> tuple[ResumableTrainer, CurveTests]:
    env = make_training_env(
        num_skills=config.num_skills,
        skill_steps=config.skill_steps,
        num_steps=config.frames_per_step,
    )
    interval = max(BATCH_STEPS, config.train_steps // config.curve_points)
    trainer = DIAYNTrainer(
        env,
        loss,
        total_frames=config.train_steps,
        frames_per_batch=BATCH_STEPS,
        updates_per_batch=max(1, round(config.updates_per_step * BATCH_STEPS)),
        save_dir=save_dir,
        save_trainer_interval=interval,
        progress=progress,
        logger=logger,
        make_collector=make_ray_collector if config.collector == "ray" else Collector,
        seed=config.seed,
    )
    tests = CurveTests(trainer, config, interval)
    return trainer, tests


def _curve_budget(config: LabMazeConfig) -> SearchBudget:
    return SearchBudget(
        expansions=min(_CURVE_EXPANSIONS, config.expansions),
        improve_expansions=config.improve_expansions,
    )


class CurveTests:
    """Tries the worker in held-out mazes while a ``DIAYNTrainer`` trains it, for Figure 4.10.

    Random numbers of the training are not touched. The networks that solved the most mazes are
    kept, of several the latest: skills keep changing, and the last ones need not be the best. Those
    of the test before the training are never kept: they are no learned skills.

    Args:
        trainer: whose loss has the actor.
        config: of the experiment.
        interval: base steps between two tests; there is one before and one after the training.
    """

    def __init__(self, trainer: DIAYNTrainer, config: LabMazeConfig, interval: int) -> None:
        self.trainer, self.config, self.interval = trainer, config, interval
        self.records = RoundRecords()
        self._at = -1  # base steps at the latest test
        self._best: dict[str, Any] = {}  # "solved", how many, the "loss" that did, and its "step"
        worker = SkillPolicy(trainer.loss_module.actor_network, deterministic=True)
        mazes = held_out_seeds(config.curve_mazes, first=CURVE_SEED)
        self.model, self.real = (make_maze_env(config, worker, mazes, 9) for _ in range(2))
        self.real.set_seed(config.seed)
        self.starts = self.real.reset(TensorDict(batch_size=[config.curve_mazes]))
        trainer.register_op("setup", self)
        trainer.register_op("post_steps_log", self)
        trainer.register_module("curve_tests", self)

    def __call__(self, batch: TensorDictBase | None = None) -> None:
        steps = self.trainer.collected_frames
        due = self._at < 0 or steps - self._at >= self.interval
        if not due and not self._at < steps >= self.trainer.total_frames:
            return
        self._at = steps
        with seeded(self.config.seed, "test", 0):
            planner = make_planner(
                self.config, self.model, expansions=_curve_budget(self.config).expansions
            )
            results = plan_and_execute(planner, self.real, self.starts)
        self.records.add(results, np.arange(len(results.solved)), steps)
        solved = int(results.solved.sum())
        if steps > 0 and solved >= self._best.get("solved", 0):
            state = self.trainer.loss_module.state_dict()
            self._best = {
                "solved": solved,
                "step": steps,
                "loss": {name: value.clone() for name, value in state.items()},
            }
        logger = self.trainer.logger
        if logger is not None:
            frames = np.where(
                results.solved,
                results.episode_steps * self.config.frames_per_step,
                self.config.max_frames,
            )
            logger.log_scalar("test_solved", float(results.solved.mean()), step=steps)
            logger.log_scalar("test_frames", float(frames.mean()), step=steps)

    def restore_best(self) -> int:
        """Give the loss back the networks that solved the most mazes; return their base steps.

        Those of the end stay where nothing is known of others, in a run of an older version.
        """
        if not self._best:
            return self.trainer.collected_frames
        self.trainer.loss_module.load_state_dict(self._best["loss"])
        return int(self._best["step"])

    def state_dict(self) -> dict[str, Any]:
        return {"at": self._at, "records": self.records.state_dict(), "best": self._best}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        self._at = int(state_dict["at"])
        self.records.load_state_dict(state_dict["records"])
        best = dict(state_dict.get("best", {}))
        self._best = best if "step" in best else {}  # an older version may have kept the untrained
