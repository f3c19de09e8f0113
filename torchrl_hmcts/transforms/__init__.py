"""Transforms: skills, their displacement and reward, options, and subgoals."""

from torchrl_hmcts.transforms.intrinsic_reward import SkillReward
from torchrl_hmcts.transforms.movement import DisplacementTransform, StallTransform
from torchrl_hmcts.transforms.option import OptionTransform
from torchrl_hmcts.transforms.recorder import OptionRecorder
from torchrl_hmcts.transforms.skill import SkillMaskTransform, SkillTransform
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
