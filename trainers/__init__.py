"""Trainers, experiments and the command line."""

from __future__ import annotations

import ast
import importlib
import inspect
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.a3c.learner_processes import LearnerError as LearnerError
    from torchrl_hmcts.trainers.a3c.shared_optimizers import SharedAdam as SharedAdam
    from torchrl_hmcts.trainers.a3c.shared_optimizers import SharedRMSprop as SharedRMSprop
    from torchrl_hmcts.trainers.a3c.shared_optimizers import share_optimizer as share_optimizer
    from torchrl_hmcts.trainers.a3c.trainer import A3CTrainer as A3CTrainer
    from torchrl_hmcts.trainers.diayn import DIAYNTrainer as DIAYNTrainer
    from torchrl_hmcts.trainers.diayn import make_skill_optimizer as make_skill_optimizer
    from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent as AtariAgent
    from torchrl_hmcts.trainers.experiments.atari.agent import AtariProgress as AtariProgress
    from torchrl_hmcts.trainers.experiments.atari.agent import AtariSearch as AtariSearch
    from torchrl_hmcts.trainers.experiments.atari.goals import Candidate as Candidate
    from torchrl_hmcts.trainers.experiments.atari.goals import GoalFinder as GoalFinder
    from torchrl_hmcts.trainers.experiments.atari.goals import GoalSearch as GoalSearch
    from torchrl_hmcts.trainers.experiments.atari.guide import SearchGuide as SearchGuide
    from torchrl_hmcts.trainers.experiments.atari.learned_sources import DIAYNSource as DIAYNSource
    from torchrl_hmcts.trainers.experiments.atari.learned_sources import (
        DistilledSource as DistilledSource,
    )
    from torchrl_hmcts.trainers.experiments.atari.options import Options as Options
    from torchrl_hmcts.trainers.experiments.atari.options import WorkerSource as WorkerSource
    from torchrl_hmcts.trainers.experiments.atari.options import load_options as load_options
    from torchrl_hmcts.trainers.experiments.atari.sources import ActionSetSource as ActionSetSource
    from torchrl_hmcts.trainers.experiments.atari.sources import ActionSource as ActionSource
    from torchrl_hmcts.trainers.experiments.atari.sources import BestSource as BestSource
    from torchrl_hmcts.trainers.experiments.atari.sources import GoalSource as GoalSource
    from torchrl_hmcts.trainers.experiments.atari.sources import RepeatSource as RepeatSource
    from torchrl_hmcts.trainers.experiments.atari.trained_sources import (
        FineTunedSource as FineTunedSource,
    )
    from torchrl_hmcts.trainers.experiments.atari.trained_sources import OptionGoals as OptionGoals
    from torchrl_hmcts.trainers.experiments.atari.trained_sources import (
        RetrainedSource as RetrainedSource,
    )
    from torchrl_hmcts.trainers.experiments.settings import DemoConfig as DemoConfig
    from torchrl_hmcts.trainers.experiments.waterworld.episodes import GoalEpisodes as GoalEpisodes
    from torchrl_hmcts.trainers.experiments.waterworld.episodes import GoalTrack as GoalTrack
    from torchrl_hmcts.trainers.experiments.waterworld.episodes import (
        run_goal_episodes as run_goal_episodes,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import (
        TilePlanner as TilePlanner,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import (
        make_goal_env as make_goal_env,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import (
        make_tile_planner as make_tile_planner,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.networks import MazeNetwork as MazeNetwork
    from torchrl_hmcts.trainers.experiments.waterworld.networks import (
        shortest_distances as shortest_distances,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.scripted_expert import (
        ScriptedExpert as ScriptedExpert,
    )
    from torchrl_hmcts.trainers.expert_iteration import (
        ExpertIterationTrainer as ExpertIterationTrainer,
    )
    from torchrl_hmcts.trainers.expert_iteration import SearchCollector as SearchCollector
    from torchrl_hmcts.trainers.expert_iteration import make_guided_planner as make_guided_planner
    from torchrl_hmcts.trainers.hmcts import HMCTSTrainer as HMCTSTrainer
    from torchrl_hmcts.trainers.restarting_collector import CollectorError as CollectorError
    from torchrl_hmcts.trainers.saving.checkpoints import DurableRotation as DurableRotation
    from torchrl_hmcts.trainers.saving.checkpoints import plain_checkpoint as plain_checkpoint
    from torchrl_hmcts.trainers.saving.locking import FolderInUse as FolderInUse
    from torchrl_hmcts.trainers.saving.resume import GeneratorStates as GeneratorStates
    from torchrl_hmcts.trainers.saving.resume import ResumableTrainer as ResumableTrainer
    from torchrl_hmcts.trainers.saving.resume import RunningEpisodes as RunningEpisodes
    from torchrl_hmcts.trainers.skills.controllability import Controllability as Controllability
    from torchrl_hmcts.trainers.skills.controllability import (
        probe_controllability as probe_controllability,
    )
    from torchrl_hmcts.trainers.skills.coverage import StateCoverage as StateCoverage
    from torchrl_hmcts.trainers.skills.growing import GrowSkills as GrowSkills
    from torchrl_hmcts.trainers.skills.growing import SearchCoverage as SearchCoverage
    from torchrl_hmcts.trainers.skills.growing import num_places as num_places
    from torchrl_hmcts.trainers.skills.hindsight import HindsightTransitions as HindsightTransitions
    from torchrl_hmcts.trainers.skills.hindsight import MazeView as MazeView
    from torchrl_hmcts.trainers.skills.reward_hook import SkillRewardHook as SkillRewardHook
    from torchrl_hmcts.trainers.skills.termination import TerminationConfig as TerminationConfig
    from torchrl_hmcts.trainers.skills.termination import TerminationResult as TerminationResult
    from torchrl_hmcts.trainers.skills.termination import (
        collect_option_steps as collect_option_steps,
    )
    from torchrl_hmcts.trainers.skills.termination import learn_termination as learn_termination
    from torchrl_hmcts.trainers.skills.termination import (
        make_terminating_env as make_terminating_env,
    )


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
    return getattr(importlib.import_module(_PLACES[name]), name)
