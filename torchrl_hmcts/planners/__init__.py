"""The manager: Monte Carlo tree search over the options of a macro environment."""

from torchrl_hmcts.planners.backups import MaxBackup, MeanBackup
from torchrl_hmcts.planners.budget import SearchBudget
from torchrl_hmcts.planners.choices import BestPlan, HighestValue, MostVisited
from torchrl_hmcts.planners.control import HierarchicalPolicy
from torchrl_hmcts.planners.mcts import MCTSPlanner, SearchProgress
from torchrl_hmcts.planners.novelty import NoveltyTest, RadiusNovelty
from torchrl_hmcts.planners.plan import Plan
from torchrl_hmcts.planners.search import Search
from torchrl_hmcts.planners.tree import SearchTree, TreeView
from torchrl_hmcts.planners.tree_policies import PUCT, UCT

__all__ = [
    "PUCT",
    "UCT",
    "BestPlan",
    "HierarchicalPolicy",
    "HighestValue",
    "MCTSPlanner",
    "MaxBackup",
    "MeanBackup",
    "MostVisited",
    "NoveltyTest",
    "Plan",
    "RadiusNovelty",
    "Search",
    "SearchBudget",
    "SearchProgress",
    "SearchTree",
    "TreeView",
]
