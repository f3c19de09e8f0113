"""Trainers, experiments and the command line."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.a3c import A3CTrainer
    from torchrl_hmcts.trainers.config import DemoConfig
    from torchrl_hmcts.trainers.coverage import StateCoverage
    from torchrl_hmcts.trainers.diayn import DIAYNTrainer, make_skill_optimizer
    from torchrl_hmcts.trainers.expert_iteration import (
        ExpertIterationTrainer,
        SearchCollector,
        make_guided_planner,
    )
    from torchrl_hmcts.trainers.goal_episodes import GoalEpisodes, GoalTrack, run_goal_episodes
    from torchrl_hmcts.trainers.goal_planning import (
        TilePlanner,
        make_goal_env,
        make_tile_planner,
    )
    from torchrl_hmcts.trainers.growing import GrowSkills, SearchCoverage, num_places
    from torchrl_hmcts.trainers.hindsight import HindsightTransitions, MazeView
    from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
    from torchrl_hmcts.trainers.learner_processes import LearnerError
    from torchrl_hmcts.trainers.maze_networks import MazeNetwork, shortest_distances
    from torchrl_hmcts.trainers.resume import GeneratorStates, ResumableTrainer, RunningEpisodes
    from torchrl_hmcts.trainers.scripted_expert import ScriptedExpert
    from torchrl_hmcts.trainers.shared_optimizers import (
        SharedAdam,
        SharedRMSprop,
        share_optimizer,
    )
    from torchrl_hmcts.trainers.termination import (
        TerminationConfig,
        TerminationResult,
        collect_option_steps,
        learn_termination,
        make_terminating_env,
    )

__all__ = [
    "A3CTrainer",
    "DIAYNTrainer",
    "DemoConfig",
    "ExpertIterationTrainer",
    "GeneratorStates",
    "GoalEpisodes",
    "GoalTrack",
    "GrowSkills",
    "HMCTSTrainer",
    "HindsightTransitions",
    "LearnerError",
    "MazeNetwork",
    "MazeView",
    "ResumableTrainer",
    "RunningEpisodes",
    "ScriptedExpert",
    "SearchCollector",
    "SearchCoverage",
    "SharedAdam",
    "SharedRMSprop",
    "StateCoverage",
    "TerminationConfig",
    "TerminationResult",
    "TilePlanner",
    "collect_option_steps",
    "learn_termination",
    "make_goal_env",
    "make_guided_planner",
    "make_skill_optimizer",
    "make_terminating_env",
    "make_tile_planner",
    "num_places",
    "run_goal_episodes",
    "share_optimizer",
    "shortest_distances",
]

# Imported when asked for: the command line answers --help without loading torch.
_MODULES = {
    "A3CTrainer": "a3c",
    "DIAYNTrainer": "diayn",
    "DemoConfig": "config",
    "ExpertIterationTrainer": "expert_iteration",
    "GeneratorStates": "resume",
    "GoalEpisodes": "goal_episodes",
    "GoalTrack": "goal_episodes",
    "GrowSkills": "growing",
    "HMCTSTrainer": "hmcts",
    "HindsightTransitions": "hindsight",
    "LearnerError": "learner_processes",
    "MazeNetwork": "maze_networks",
    "MazeView": "hindsight",
    "ResumableTrainer": "resume",
    "RunningEpisodes": "resume",
    "ScriptedExpert": "scripted_expert",
    "SearchCollector": "expert_iteration",
    "SearchCoverage": "growing",
    "SharedAdam": "shared_optimizers",
    "SharedRMSprop": "shared_optimizers",
    "StateCoverage": "coverage",
    "TerminationConfig": "termination",
    "TerminationResult": "termination",
    "TilePlanner": "goal_planning",
    "collect_option_steps": "termination",
    "learn_termination": "termination",
    "make_goal_env": "goal_planning",
    "make_guided_planner": "expert_iteration",
    "make_skill_optimizer": "diayn",
    "make_terminating_env": "termination",
    "make_tile_planner": "goal_planning",
    "num_places": "growing",
    "share_optimizer": "shared_optimizers",
    "run_goal_episodes": "goal_episodes",
    "shortest_distances": "maze_networks",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
