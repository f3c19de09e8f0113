"""Losses of the worker: actor and critics beside interchangeable skill objectives."""

from torchrl_hmcts.objectives.a3c import A3CLoss, NStepReturn
from torchrl_hmcts.objectives.diayn import DIAYNLoss
from torchrl_hmcts.objectives.discovery import (
    LSDEncoderLoss,
    METRAEncoderLoss,
    SkillDiscriminatorLoss,
    SkillDynamicsLoss,
)
from torchrl_hmcts.objectives.goal_cloning import GoalCloningLoss
from torchrl_hmcts.objectives.loss import use_durations
from torchrl_hmcts.objectives.option_critic import IntraOptionQLoss, OptionTerminationLoss
from torchrl_hmcts.objectives.option_model_loss import OptionModelLoss
from torchrl_hmcts.objectives.search_distillation import ExpertIterationLoss
from torchrl_hmcts.objectives.skill_objective import SkillObjective
from torchrl_hmcts.objectives.skill_prior import SkillPriorLoss
from torchrl_hmcts.objectives.skill_sac import DiscreteSkillSACLoss, SkillSACLoss

__all__ = [
    "A3CLoss",
    "DIAYNLoss",
    "DiscreteSkillSACLoss",
    "ExpertIterationLoss",
    "GoalCloningLoss",
    "IntraOptionQLoss",
    "LSDEncoderLoss",
    "METRAEncoderLoss",
    "NStepReturn",
    "OptionModelLoss",
    "OptionTerminationLoss",
    "SkillDiscriminatorLoss",
    "SkillDynamicsLoss",
    "SkillObjective",
    "SkillPriorLoss",
    "SkillSACLoss",
    "use_durations",
]
