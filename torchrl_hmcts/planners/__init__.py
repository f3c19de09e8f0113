"""The manager: Monte Carlo tree search over the options of a macro environment."""

from torchrl_hmcts.arguments import name_all_arguments
from torchrl_hmcts.planners.array_search import Root, Transition, tree_search
from torchrl_hmcts.planners.backups import MaxBackup, MeanBackup
from torchrl_hmcts.planners.budget import SearchBudget
from torchrl_hmcts.planners.chance import ProgressiveWidening
from torchrl_hmcts.planners.choices import BestPlan, HighestValue, MostVisited, SampledVisits
from torchrl_hmcts.planners.control import HierarchicalPolicy
from torchrl_hmcts.planners.evaluators import (
    MixedEvaluator,
    ModulePrior,
    RolloutEvaluator,
    ValueEvaluator,
)
from torchrl_hmcts.planners.goals import GoalPlanner
from torchrl_hmcts.planners.growth import SearchProgress
from torchrl_hmcts.planners.mcts import MCTSPlanner
from torchrl_hmcts.planners.model_control import ModelBasedControl
from torchrl_hmcts.planners.noise import DirichletNoise
from torchrl_hmcts.planners.novelty import NoveltyTest, RadiusNovelty, WidthNovelty
from torchrl_hmcts.planners.plan import Plan, extract_plans
from torchrl_hmcts.planners.policy_value import PolicyValueEvaluator
from torchrl_hmcts.planners.search import Search
from torchrl_hmcts.planners.search_data import best_plans_below, search_examples
from torchrl_hmcts.planners.torchrl_scores import TorchRLScore
from torchrl_hmcts.planners.transpositions import Transpositions
from torchrl_hmcts.planners.tree import SearchTree, TreeView
from torchrl_hmcts.planners.tree_policies import PUCT, UCT, Gumbel, NodeStatistics
from torchrl_hmcts.planners.tree_rollout import TreeRollout

__all__ = [
    "PUCT",
    "UCT",
    "BestPlan",
    "DirichletNoise",
    "GoalPlanner",
    "Gumbel",
    "HierarchicalPolicy",
    "HighestValue",
    "MCTSPlanner",
    "MaxBackup",
    "MeanBackup",
    "MixedEvaluator",
    "ModelBasedControl",
    "ModulePrior",
    "MostVisited",
    "NodeStatistics",
    "NoveltyTest",
    "Plan",
    "PolicyValueEvaluator",
    "ProgressiveWidening",
    "RadiusNovelty",
    "RolloutEvaluator",
    "Root",
    "SampledVisits",
    "Search",
    "SearchBudget",
    "SearchProgress",
    "SearchTree",
    "TorchRLScore",
    "Transition",
    "Transpositions",
    "TreeRollout",
    "TreeView",
    "ValueEvaluator",
    "WidthNovelty",
    "best_plans_below",
    "extract_plans",
    "search_examples",
    "tree_search",
]

name_all_arguments(globals(), __all__)
