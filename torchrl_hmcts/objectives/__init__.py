"""Losses of the worker: actor and critics beside interchangeable skill objectives."""

from torchrl_hmcts.arguments import name_all_arguments
from torchrl_hmcts.objectives.a3c import A3CLoss, NStepReturn, n_step_returns
from torchrl_hmcts.objectives.dads import SkillDynamicsLoss
from torchrl_hmcts.objectives.diayn import ContinuousDIAYNLoss, DIAYNLoss
from torchrl_hmcts.objectives.discrete_skill_sac import DiscreteSkillSACLoss
from torchrl_hmcts.objectives.discriminator import SkillDiscriminatorLoss
from torchrl_hmcts.objectives.durations import use_durations
from torchrl_hmcts.objectives.lsd import LSDEncoderLoss
from torchrl_hmcts.objectives.metra import METRAEncoderLoss
from torchrl_hmcts.objectives.option_critic import IntraOptionQLoss, OptionTerminationLoss
from torchrl_hmcts.objectives.option_model import OptionModelLoss
from torchrl_hmcts.objectives.search_distillation import ExpertIterationLoss
from torchrl_hmcts.objectives.skill_objective import SkillObjective
from torchrl_hmcts.objectives.skill_prior import SkillPriorLoss
from torchrl_hmcts.objectives.skill_sac import SkillSACLoss

__all__ = [
    "A3CLoss",
    "ContinuousDIAYNLoss",
    "DIAYNLoss",
    "DiscreteSkillSACLoss",
    "ExpertIterationLoss",
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
    "n_step_returns",
    "use_durations",
]

name_all_arguments(globals(), __all__)
