"""Networks of the worker: actors and critics conditioned on skills, and what tells skills apart."""

from torchrl_hmcts.arguments import name_all_arguments
from torchrl_hmcts.modules.gaussian_skill_actor import GaussianSkillActor
from torchrl_hmcts.modules.option_memory import OptionMemory
from torchrl_hmcts.modules.option_model import OptionModel
from torchrl_hmcts.modules.option_model_env import OptionModelEnv
from torchrl_hmcts.modules.skill_actor import SkillActor, SkillPolicy
from torchrl_hmcts.modules.skill_critic import SkillActionCritic, SkillCritic
from torchrl_hmcts.modules.skill_discriminator import SkillDiscriminator
from torchrl_hmcts.modules.skill_dynamics import SkillDynamics
from torchrl_hmcts.modules.skill_encoder import SkillEncoder, SpectralLinear
from torchrl_hmcts.modules.skill_mlp import ConcatSkillMLP, SkillMLP, SkillNetwork
from torchrl_hmcts.modules.skill_prior import (
    FixedSkillPrior,
    GrowingSkillPrior,
    LearnedSkillPrior,
    SkillPrior,
)
from torchrl_hmcts.modules.termination import (
    AnyTermination,
    LearnedTermination,
    StallTermination,
    TerminationNetwork,
)

__all__ = [
    "AnyTermination",
    "ConcatSkillMLP",
    "FixedSkillPrior",
    "GaussianSkillActor",
    "GrowingSkillPrior",
    "LearnedSkillPrior",
    "LearnedTermination",
    "OptionMemory",
    "OptionModel",
    "OptionModelEnv",
    "SkillActionCritic",
    "SkillActor",
    "SkillCritic",
    "SkillDiscriminator",
    "SkillDynamics",
    "SkillEncoder",
    "SkillMLP",
    "SkillNetwork",
    "SkillPolicy",
    "SkillPrior",
    "SpectralLinear",
    "StallTermination",
    "TerminationNetwork",
]

name_all_arguments(globals(), __all__)
