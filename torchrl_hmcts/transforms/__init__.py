"""Transforms: skills, their displacement and reward, and options."""

from torchrl_hmcts.transforms.displacement import DisplacementTransform
from torchrl_hmcts.transforms.intrinsic_reward import DIAYNReward
from torchrl_hmcts.transforms.option import OptionTransform
from torchrl_hmcts.transforms.skill import SkillTransform

__all__ = ["DIAYNReward", "DisplacementTransform", "OptionTransform", "SkillTransform"]
