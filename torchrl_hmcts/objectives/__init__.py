"""Losses of the worker."""

from torchrl_hmcts.objectives.diayn import DIAYNLoss
from torchrl_hmcts.objectives.discriminator import SkillDiscriminatorLoss

__all__ = ["DIAYNLoss", "SkillDiscriminatorLoss"]
