"""The manager: Monte Carlo tree search over the options of a macro environment."""

from torchrl_hmcts.planners.array_search import Root, Transition, tree_search
from torchrl_hmcts.planners.budget import ProgressiveWidening, SearchBudget, TreeRollout
from torchrl_hmcts.planners.control import GoalPlanner, HierarchicalPolicy
from torchrl_hmcts.planners.drawing import option_color
from torchrl_hmcts.planners.evaluation import Evaluation
from torchrl_hmcts.planners.evaluators import (
    MixedEvaluator,
    ModulePrior,
    PolicyValueEvaluator,
    RolloutEvaluator,
    ValueEvaluator,
)
from torchrl_hmcts.planners.mcts import MCTSPlanner
from torchrl_hmcts.planners.novelty import NoveltyTest, RadiusNovelty, WidthNovelty
from torchrl_hmcts.planners.plan import Plan, SearchProgress, extract_plans
from torchrl_hmcts.planners.reference import ReferenceSearch
from torchrl_hmcts.planners.root_options import (
    BestPlan,
    DirichletNoise,
    HighestValue,
    MostVisited,
    SampledVisits,
)
from torchrl_hmcts.planners.search import Search
from torchrl_hmcts.planners.search_data import search_examples
from torchrl_hmcts.planners.settings import SearchSettings
from torchrl_hmcts.planners.transpositions import Transpositions
from torchrl_hmcts.planners.tree_policies import PUCT, UCT, Gumbel, NodeStatistics, TorchRLScore
from torchrl_hmcts.planners.tree_view import SearchTree, TreeView

__all__ = [
    "PUCT",
    "UCT",
    "BestPlan",
    "DirichletNoise",
    "Evaluation",
    "GoalPlanner",
    "Gumbel",
    "HierarchicalPolicy",
    "HighestValue",
    "MCTSPlanner",
    "MixedEvaluator",
    "ModulePrior",
    "MostVisited",
    "NodeStatistics",
    "NoveltyTest",
    "Plan",
    "PolicyValueEvaluator",
    "ProgressiveWidening",
    "RadiusNovelty",
    "ReferenceSearch",
    "RolloutEvaluator",
    "Root",
    "SampledVisits",
    "Search",
    "SearchBudget",
    "SearchProgress",
    "SearchSettings",
    "SearchTree",
    "TorchRLScore",
    "Transition",
    "Transpositions",
    "TreeRollout",
    "TreeView",
    "ValueEvaluator",
    "WidthNovelty",
    "extract_plans",
    "option_color",
    "search_examples",
    "tree_search",
]
