"""Trainers, experiments and the command line."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.a3c.learner_processes import LearnerError
    from torchrl_hmcts.trainers.a3c.shared_optimizers import (
        SharedAdam,
        SharedRMSprop,
        share_optimizer,
    )
    from torchrl_hmcts.trainers.a3c.trainer import A3CTrainer
    from torchrl_hmcts.trainers.diayn import DIAYNTrainer, make_skill_optimizer
    from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent, AtariSearch
    from torchrl_hmcts.trainers.experiments.atari.fine_tuning import OptionGoals
    from torchrl_hmcts.trainers.experiments.atari.guide import SearchGuide
    from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit
    from torchrl_hmcts.trainers.experiments.atari.options import Options
    from torchrl_hmcts.trainers.experiments.atari.rules import RuleSource
    from torchrl_hmcts.trainers.experiments.atari.sources import TrainedSource
    from torchrl_hmcts.trainers.experiments.waterworld.goal_episodes import (
        GoalEpisodes,
        GoalTrack,
        run_goal_episodes,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import (
        TilePlanner,
        make_goal_env,
        make_tile_planner,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.networks import (
        MazeNetwork,
        shortest_distances,
    )
    from torchrl_hmcts.trainers.experiments.waterworld.scripted_expert import ScriptedExpert
    from torchrl_hmcts.trainers.expert_iteration import (
        ExpertIterationTrainer,
        SearchCollector,
        make_guided_planner,
    )
    from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
    from torchrl_hmcts.trainers.restarting_collector import CollectorError
    from torchrl_hmcts.trainers.runs.config import DemoConfig
    from torchrl_hmcts.trainers.saving.checkpoints import DurableRotation, plain_checkpoint
    from torchrl_hmcts.trainers.saving.locking import FolderInUse
    from torchrl_hmcts.trainers.saving.resume import ResumableTrainer
    from torchrl_hmcts.trainers.saving.run_state import GeneratorStates, RunningEpisodes
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

__all__ = [
    "A3CTrainer",
    "AtariAgent",
    "AtariKit",
    "AtariSearch",
    "CollectorError",
    "Controllability",
    "DIAYNTrainer",
    "DemoConfig",
    "DurableRotation",
    "ExpertIterationTrainer",
    "GeneratorStates",
    "GoalEpisodes",
    "OptionGoals",
    "SearchGuide",
    "FolderInUse",
    "GoalTrack",
    "GrowSkills",
    "HMCTSTrainer",
    "HindsightTransitions",
    "LearnerError",
    "MazeNetwork",
    "MazeView",
    "Options",
    "ResumableTrainer",
    "RunningEpisodes",
    "RuleSource",
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
    "TrainedSource",
    "collect_option_steps",
    "learn_termination",
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
    "A3CTrainer": "a3c.trainer",
    "AtariAgent": "experiments.atari.agent",
    "AtariKit": "experiments.atari.kit",
    "AtariSearch": "experiments.atari.agent",
    "CollectorError": "restarting_collector",
    "Controllability": "skills.controllability",
    "DIAYNTrainer": "diayn",
    "DemoConfig": "runs.config",
    "DurableRotation": "saving.checkpoints",
    "ExpertIterationTrainer": "expert_iteration",
    "GeneratorStates": "saving.run_state",
    "GoalEpisodes": "experiments.waterworld.goal_episodes",
    "OptionGoals": "experiments.atari.fine_tuning",
    "SearchGuide": "experiments.atari.guide",
    "GoalTrack": "experiments.waterworld.goal_episodes",
    "GrowSkills": "skills.growing",
    "HMCTSTrainer": "hmcts",
    "HindsightTransitions": "skills.hindsight",
    "FolderInUse": "saving.locking",
    "LearnerError": "a3c.learner_processes",
    "MazeNetwork": "experiments.waterworld.networks",
    "MazeView": "skills.hindsight",
    "Options": "experiments.atari.options",
    "ResumableTrainer": "saving.resume",
    "RuleSource": "experiments.atari.rules",
    "RunningEpisodes": "saving.run_state",
    "ScriptedExpert": "experiments.waterworld.scripted_expert",
    "SearchCollector": "expert_iteration",
    "SearchCoverage": "skills.growing",
    "SharedAdam": "a3c.shared_optimizers",
    "SharedRMSprop": "a3c.shared_optimizers",
    "SkillRewardHook": "skills.reward_hook",
    "StateCoverage": "skills.coverage",
    "TerminationConfig": "skills.termination",
    "TerminationResult": "skills.termination",
    "TilePlanner": "experiments.waterworld.goal_planning",
    "TrainedSource": "experiments.atari.sources",
    "collect_option_steps": "skills.termination",
    "learn_termination": "skills.termination",
    "make_goal_env": "experiments.waterworld.goal_planning",
    "make_guided_planner": "expert_iteration",
    "make_skill_optimizer": "diayn",
    "make_terminating_env": "skills.termination",
    "make_tile_planner": "experiments.waterworld.goal_planning",
    "num_places": "skills.growing",
    "plain_checkpoint": "saving.checkpoints",
    "probe_controllability": "skills.controllability",
    "run_goal_episodes": "experiments.waterworld.goal_episodes",
    "share_optimizer": "a3c.shared_optimizers",
    "shortest_distances": "experiments.waterworld.networks",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
