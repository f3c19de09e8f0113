"""Trainers, experiments and the command line."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.config import DemoConfig
    from torchrl_hmcts.trainers.coverage import StateCoverage
    from torchrl_hmcts.trainers.diayn import DIAYNTrainer, make_skill_optimizer
    from torchrl_hmcts.trainers.expert_iteration import (
        ExpertIterationTrainer,
        SearchCollector,
        make_guided_planner,
    )
    from torchrl_hmcts.trainers.growing import GrowSkills, SearchCoverage, num_places
    from torchrl_hmcts.trainers.hindsight import HindsightTransitions, MazeView
    from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
    from torchrl_hmcts.trainers.maze_networks import MazeNetwork, shortest_distances
    from torchrl_hmcts.trainers.resume import GeneratorStates, ResumableTrainer, RunningEpisodes
    from torchrl_hmcts.trainers.termination import (
        TerminationConfig,
        TerminationResult,
        collect_option_steps,
        learn_termination,
        make_terminating_env,
    )

__all__ = [
    "DIAYNTrainer",
    "DemoConfig",
    "ExpertIterationTrainer",
    "GeneratorStates",
    "GrowSkills",
    "HMCTSTrainer",
    "HindsightTransitions",
    "MazeNetwork",
    "MazeView",
    "ResumableTrainer",
    "RunningEpisodes",
    "SearchCollector",
    "SearchCoverage",
    "StateCoverage",
    "TerminationConfig",
    "TerminationResult",
    "collect_option_steps",
    "learn_termination",
    "make_guided_planner",
    "make_skill_optimizer",
    "make_terminating_env",
    "num_places",
    "shortest_distances",
]

# Imported when asked for: the command line answers --help without loading torch.
_MODULES = {
    "DIAYNTrainer": "diayn",
    "DemoConfig": "config",
    "ExpertIterationTrainer": "expert_iteration",
    "GeneratorStates": "resume",
    "GrowSkills": "growing",
    "HMCTSTrainer": "hmcts",
    "HindsightTransitions": "hindsight",
    "MazeNetwork": "maze_networks",
    "MazeView": "hindsight",
    "ResumableTrainer": "resume",
    "RunningEpisodes": "resume",
    "SearchCollector": "expert_iteration",
    "SearchCoverage": "growing",
    "StateCoverage": "coverage",
    "TerminationConfig": "termination",
    "TerminationResult": "termination",
    "collect_option_steps": "termination",
    "learn_termination": "termination",
    "make_guided_planner": "expert_iteration",
    "make_skill_optimizer": "diayn",
    "make_terminating_env": "termination",
    "num_places": "growing",
    "shortest_distances": "maze_networks",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
