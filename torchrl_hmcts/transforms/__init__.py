"""Transforms: skills, their displacement and reward, options, and subgoals."""

from torchrl_hmcts.transforms.displacement import DisplacementTransform
from torchrl_hmcts.transforms.intrinsic_reward import SkillReward
from torchrl_hmcts.transforms.option import OptionTransform
from torchrl_hmcts.transforms.recorder import OptionRecorder
from torchrl_hmcts.transforms.skill import SkillTransform
from torchrl_hmcts.transforms.skill_mask import SkillMaskTransform
from torchrl_hmcts.transforms.stall import StallTransform
from torchrl_hmcts.transforms.subgoal import PlansGoals, SubgoalTransform

__all__ = [
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
