"""Tests of a worker while it learns: Figure 4.10, and which worker to keep."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.trainers.evaluation import plan_and_execute
from torchrl_hmcts.trainers.experiments.kits import Kit
from torchrl_hmcts.trainers.experiments.settings import SkillsConfig
from torchrl_hmcts.trainers.off_policy import OffPolicyTrainer
from torchrl_hmcts.trainers.skills.rounds import RoundRecords, seeded

_EXPANSIONS = 300  # of a search while the worker learns


def curve_budget(config: SkillsConfig) -> dict[str, int]:
    """Return what is changed of the budget of a search while the worker learns."""
    return {"expansions": min(_EXPANSIONS, config.expansions)}


class CurveTests:
    """Tries the worker in held-out mazes while a trainer trains it, for Figure 4.10.

    There is a test before and after the training, and every ``interval`` base steps. Random numbers
    of the training are not touched. The networks that solved the most mazes are kept, of several
    the latest: skills keep changing, and the last ones need not be the best. Those of the test
    before the training are never kept: they are no learned skills.
    """

    def __init__(self, trainer: OffPolicyTrainer, kit: Kit, interval: int) -> None:
        self.trainer, self.kit, self.interval = trainer, kit, interval
        self.records = RoundRecords()
        self._at = -1  # base steps at the latest test
        self._best: dict[str, Any] = {}  # "solved", how many, the "loss" that did, and its "step"
        self.worker = SkillPolicy(trainer.loss_module.actor_network, deterministic=True)
        self.model = kit.make_simulator(self.worker, "curve")
        self.real = kit.make_real(self.worker, split="curve")
        with torch.random.fork_rng(devices=[]):  # a new env draws its seed
            self.starts = kit.starts("curve", kit.config.curve_mazes)
        trainer.register_op("setup", self)
        trainer.register_op("post_steps_log", self)
        trainer.register_module("curve_tests", self)

    def __call__(self, batch: TensorDictBase | None = None) -> None:
        config, steps = self.kit.config, self.trainer.collected_frames
        due = self._at < 0 or steps - self._at >= self.interval
        if not due and not self._at < steps >= self.trainer.total_frames:
            return
        self._at = steps
        with seeded(config.seed, "test", 0):
            if config.features == "learned":  # their radius changes while they learn
                self.kit.prepare(self.worker)
            planner = self.kit.make_planner(self.model, **curve_budget(config))
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
            frames = results.episode_steps * config.frames_per_step
            frames = np.where(results.solved, frames, config.max_frames)
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
