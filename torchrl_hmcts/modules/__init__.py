"""Networks of the worker: skill-conditioned actor and critic, and the skill discriminator."""

from torchrl_hmcts.modules.skill_actor import SkillActor, SkillPolicy
from torchrl_hmcts.modules.skill_critic import SkillCritic
from torchrl_hmcts.modules.skill_discriminator import SkillDiscriminator
from torchrl_hmcts.modules.skill_mlp import SkillMLP, SkillNetwork

__all__ = [
    "SkillActor",
    "SkillCritic",
    "SkillDiscriminator",
    "SkillMLP",
    "SkillNetwork",
    "SkillPolicy",
]
