"""Trainers, experiments and the command line."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.a3c import A3CTrainer
    from torchrl_hmcts.trainers.asynchronous.learner_processes import LearnerError
    from torchrl_hmcts.trainers.asynchronous.shared_optimizers import (
        SharedAdam,
        SharedRMSprop,
        share_optimizer,
    )
    from torchrl_hmcts.trainers.atari.agent import (
        AtariAgent,
        AtariProgress,
        AtariSearch,
    )
    from torchrl_hmcts.trainers.atari.goals import (
        Candidate,
        GoalFinder,
        GoalSearch,
    )
    from torchrl_hmcts.trainers.atari.guide import SearchGuide
    from torchrl_hmcts.trainers.atari.learned_sources import DIAYNSource, DistilledSource
    from torchrl_hmcts.trainers.atari.options import Options, WorkerSource, load_options
    from torchrl_hmcts.trainers.atari.sources import (
        ActionSetSource,
        ActionSource,
        BestSource,
        GoalSource,
        RepeatSource,
    )
    from torchrl_hmcts.trainers.atari.trained_sources import (
        FineTunedSource,
        OptionGoals,
        RetrainedSource,
    )
    from torchrl_hmcts.trainers.checkpoints import DurableRotation, plain_checkpoint
    from torchrl_hmcts.trainers.config import DemoConfig
    from torchrl_hmcts.trainers.diayn import DIAYNTrainer, make_skill_optimizer
    from torchrl_hmcts.trainers.expert_iteration import (
        ExpertIterationTrainer,
        SearchCollector,
        make_guided_planner,
    )
    from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
    from torchrl_hmcts.trainers.locking import FolderInUse
    from torchrl_hmcts.trainers.restarting_collector import CollectorError
    from torchrl_hmcts.trainers.resume import GeneratorStates, ResumableTrainer, RunningEpisodes
    from torchrl_hmcts.trainers.skills.controllability import (
        Controllability,
        probe_controllability,
    )
    from torchrl_hmcts.trainers.skills.coverage import StateCoverage
    from torchrl_hmcts.trainers.skills.growing import GrowSkills, SearchCoverage, num_places
    from torchrl_hmcts.trainers.skills.hindsight import HindsightTransitions, MazeView
    from torchrl_hmcts.trainers.skills.reward_hook import SkillRewardHook
    from torchrl_hmcts.trainers.skills.termination import (
        TerminationConfig,
        TerminationResult,
        collect_option_steps,
        learn_termination,
        make_terminating_env,
    )
    from torchrl_hmcts.trainers.waterworld.goal_episodes import (
        GoalEpisodes,
        GoalTrack,
        run_goal_episodes,
    )
    from torchrl_hmcts.trainers.waterworld.goal_planning import (
        TilePlanner,
        make_goal_env,
        make_tile_planner,
    )
    from torchrl_hmcts.trainers.waterworld.networks import MazeNetwork, shortest_distances
    from torchrl_hmcts.trainers.waterworld.scripted_expert import ScriptedExpert

__all__ = [
    "A3CTrainer",
    "ActionSetSource",
    "ActionSource",
    "AtariAgent",
    "AtariProgress",
    "AtariSearch",
    "BestSource",
    "Candidate",
    "CollectorError",
    "Controllability",
    "DIAYNSource",
    "DIAYNTrainer",
    "DemoConfig",
    "DistilledSource",
    "DurableRotation",
    "ExpertIterationTrainer",
    "GeneratorStates",
    "GoalEpisodes",
    "FineTunedSource",
    "OptionGoals",
    "RetrainedSource",
    "SearchGuide",
    "FolderInUse",
    "GoalFinder",
    "GoalSearch",
    "GoalSource",
    "GoalTrack",
    "GrowSkills",
    "HMCTSTrainer",
    "HindsightTransitions",
    "LearnerError",
    "MazeNetwork",
    "MazeView",
    "Options",
    "RepeatSource",
    "ResumableTrainer",
    "RunningEpisodes",
    "ScriptedExpert",
    "SearchCollector",
    "SearchCoverage",
    "SharedAdam",
    "SharedRMSprop",
    "SkillRewardHook",
    "StateCoverage",
    "TerminationConfig",
    "TerminationResult",
    "TilePlanner",
    "WorkerSource",
    "collect_option_steps",
    "learn_termination",
    "load_options",
    "make_goal_env",
    "make_guided_planner",
    "make_skill_optimizer",
    "make_terminating_env",
    "make_tile_planner",
    "num_places",
    "plain_checkpoint",
    "probe_controllability",
    "run_goal_episodes",
    "share_optimizer",
    "shortest_distances",
]

# Imported when asked for: the command line answers --help without loading torch.
_MODULES = {
    "A3CTrainer": "a3c",
    "ActionSetSource": "atari.sources",
    "ActionSource": "atari.sources",
    "AtariAgent": "atari.agent",
    "AtariProgress": "atari.agent",
    "AtariSearch": "atari.agent",
    "BestSource": "atari.sources",
    "Candidate": "atari.goals",
    "CollectorError": "restarting_collector",
    "Controllability": "skills.controllability",
    "DIAYNSource": "atari.learned_sources",
    "DIAYNTrainer": "diayn",
    "DemoConfig": "config",
    "DistilledSource": "atari.learned_sources",
    "DurableRotation": "checkpoints",
    "ExpertIterationTrainer": "expert_iteration",
    "GeneratorStates": "resume",
    "GoalEpisodes": "waterworld.goal_episodes",
    "FineTunedSource": "atari.trained_sources",
    "OptionGoals": "atari.trained_sources",
    "RetrainedSource": "atari.trained_sources",
    "SearchGuide": "atari.guide",
    "GoalFinder": "atari.goals",
    "GoalSearch": "atari.goals",
    "GoalSource": "atari.sources",
    "GoalTrack": "waterworld.goal_episodes",
    "GrowSkills": "skills.growing",
    "HMCTSTrainer": "hmcts",
    "HindsightTransitions": "skills.hindsight",
    "FolderInUse": "locking",
    "LearnerError": "asynchronous.learner_processes",
    "MazeNetwork": "waterworld.networks",
    "MazeView": "skills.hindsight",
    "Options": "atari.options",
    "RepeatSource": "atari.sources",
    "ResumableTrainer": "resume",
    "RunningEpisodes": "resume",
    "ScriptedExpert": "waterworld.scripted_expert",
    "SearchCollector": "expert_iteration",
    "SearchCoverage": "skills.growing",
    "SharedAdam": "asynchronous.shared_optimizers",
    "SharedRMSprop": "asynchronous.shared_optimizers",
    "SkillRewardHook": "skills.reward_hook",
    "StateCoverage": "skills.coverage",
    "TerminationConfig": "skills.termination",
    "TerminationResult": "skills.termination",
    "TilePlanner": "waterworld.goal_planning",
    "WorkerSource": "atari.options",
    "collect_option_steps": "skills.termination",
    "learn_termination": "skills.termination",
    "load_options": "atari.options",
    "make_goal_env": "waterworld.goal_planning",
    "make_guided_planner": "expert_iteration",
    "make_skill_optimizer": "diayn",
    "make_terminating_env": "skills.termination",
    "make_tile_planner": "waterworld.goal_planning",
    "num_places": "skills.growing",
    "plain_checkpoint": "checkpoints",
    "probe_controllability": "skills.controllability",
    "run_goal_episodes": "waterworld.goal_episodes",
    "share_optimizer": "asynchronous.shared_optimizers",
    "shortest_distances": "waterworld.networks",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
