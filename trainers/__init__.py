"""Trainers, experiments and the command line."""

# ruff: noqa: F401  the imports below are the list of public names

from __future__ import annotations

import ast
import importlib
import inspect
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.a3c.learner_processes import LearnerError
    from torchrl_hmcts.trainers.a3c.shared_optimizers import SharedRMSprop
    from torchrl_hmcts.trainers.a3c.trainer import A3CTrainer
    from torchrl_hmcts.trainers.agent import HMCTS, Solution, load_worker
    from torchrl_hmcts.trainers.collectors import CollectorError
    from torchrl_hmcts.trainers.diayn import DIAYNTrainer, make_skill_optimizer
    from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent, AtariSearch
    from torchrl_hmcts.trainers.experiments.atari.fine_tuning import OptionGoals
    from torchrl_hmcts.trainers.experiments.atari.guide import SearchGuide
    from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit
    from torchrl_hmcts.trainers.experiments.atari.options import Options
    from torchrl_hmcts.trainers.experiments.atari.reactive import ReactiveManager
    from torchrl_hmcts.trainers.experiments.atari.rules import RuleSource
    from torchrl_hmcts.trainers.experiments.atari.sources import TrainedSource
    from torchrl_hmcts.trainers.experiments.goals import make_maze_networks
    from torchrl_hmcts.trainers.experiments.kits import Kit, make_kit
    from torchrl_hmcts.trainers.experiments.kits.waterworld import (
        make_option_env,
        make_starts,
        make_training_env,
    )
    from torchrl_hmcts.trainers.experiments.settings import DemoConfig, SkillsConfig
    from torchrl_hmcts.trainers.experiments.skills import learn, solve
    from torchrl_hmcts.trainers.experiments.waterworld.episodes import (
        GoalTrack,
        play_mazes,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import (
        TilePlanner,
        make_goal_env,
        make_tile_planner,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.scripted_expert import ScriptedExpert
    from torchrl_hmcts.trainers.expert_iteration import (
        ExpertIterationTrainer,
        make_guided_planner,
    )
    from torchrl_hmcts.trainers.figures.goals import draw_goals
    from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
    from torchrl_hmcts.trainers.saving.checkpoints import DurableRotation, plain_checkpoint
    from torchrl_hmcts.trainers.saving.locking import FolderInUse
    from torchrl_hmcts.trainers.saving.resume import ResumableTrainer
    from torchrl_hmcts.trainers.skills.controllability import (
        Controllability,
        probe_controllability,
    )
    from torchrl_hmcts.trainers.skills.coverage import StateCoverage
    from torchrl_hmcts.trainers.skills.growing import GrowSkills, SearchCoverage
    from torchrl_hmcts.trainers.skills.reward_hook import SkillRewardHook


def _places() -> dict[str, str]:
    """The module of each public name, read from the imports above."""
    tree = ast.parse(inspect.getsource(sys.modules[__name__]))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.name: str(line.module)
        for line in block.body
        if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }


# Imported when asked for: the command line answers --help without loading torch.
_PLACES = _places()
__all__ = sorted(_PLACES)


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(_PLACES[name]), name)
    except ModuleNotFoundError as error:
        if str(error.name).startswith("torchrl_hmcts"):
            raise
        raise ModuleNotFoundError(
            f"{name} needs {error.name}, which is not installed: pip install "
            "'torchrl_hmcts[train]'.",
            name=error.name,
        ) from error


def __dir__() -> list[str]:
    return __all__
