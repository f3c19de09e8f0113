"""Transforms: skills, their displacement and reward, options, and subgoals."""

from torchrl_hmcts.arguments import name_all_arguments
from torchrl_hmcts.transforms.displacement import DisplacementTransform
from torchrl_hmcts.transforms.goal_plans import PlansGoals
from torchrl_hmcts.transforms.intrinsic_reward import DIAYNReward, SkillReward
from torchrl_hmcts.transforms.option import OptionTransform
from torchrl_hmcts.transforms.recorder import OptionRecorder
from torchrl_hmcts.transforms.skill import SkillTransform
from torchrl_hmcts.transforms.skill_mask import SkillMaskTransform
from torchrl_hmcts.transforms.stall import StallTransform
from torchrl_hmcts.transforms.subgoal import SubgoalTransform

__all__ = [
    "DIAYNReward",
    "DisplacementTransform",
    "OptionRecorder",
    "OptionTransform",
    "PlansGoals",
    "SkillMaskTransform",
    "SkillReward",
    "SkillTransform",
    "StallTransform",
    "SubgoalTransform",
]

name_all_arguments(globals(), __all__)
