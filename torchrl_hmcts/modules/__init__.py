"""Networks of the worker: actors and critics conditioned on skills, and what tells skills apart."""

from torchrl_hmcts.modules.effects import EffectModel
from torchrl_hmcts.modules.landmarks import LandmarkEnv, LandmarkModel, find_jumps
from torchrl_hmcts.modules.objective_networks import (
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SpectralLinear,
)
from torchrl_hmcts.modules.option_model import OptionMemory, OptionModel
from torchrl_hmcts.modules.option_model_env import OptionModelEnv
from torchrl_hmcts.modules.skill_actor import (
    SkillActionCritic,
    SkillActor,
    SkillCritic,
    SkillPolicy,
)
from torchrl_hmcts.modules.skill_mlp import ConcatSkillMLP, SkillMLP
from torchrl_hmcts.modules.skill_prior import (
    FixedSkillPrior,
    GrowingSkillPrior,
    LearnedSkillPrior,
    SkillPrior,
)
from torchrl_hmcts.modules.skill_spec import UnitSphere, spread_skills
from torchrl_hmcts.modules.termination import (
    LearnedTermination,
    StallTermination,
    TerminationNetwork,
)

__all__ = [
    "ConcatSkillMLP",
    "EffectModel",
    "FixedSkillPrior",
    "GrowingSkillPrior",
    "LandmarkEnv",
    "LandmarkModel",
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
    "SkillPolicy",
    "SkillPrior",
    "SpectralLinear",
    "StallTermination",
    "TerminationNetwork",
    "UnitSphere",
    "find_jumps",
    "spread_skills",
]
