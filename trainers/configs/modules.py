"""Configs of the networks, priors and terminations, groups ``model`` and ``termination``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from torchrl_hmcts.trainers.configs.base import ComponentConfig


@dataclass
class SkillActorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.SkillActor`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl.data import Categorical
        >>> instantiate(SkillActorConfig(
        ...     in_features=2, num_skills=3, in_keys=["velocity"], _partial_=True))(
        ...     action_spec=Categorical(4)).num_skills
        3
    """

    in_features: int = MISSING
    """Summed sizes of the entries in_keys."""
    action_spec: Any = MISSING
    """The env's action spec, a Categorical (action int64 [*B]) or a OneHot (action [*B, A]) with A
    actions."""
    num_skills: int = MISSING
    """Number of skills."""
    in_keys: Any = MISSING
    """Observation entries [*B, f_i], concatenated in order."""
    skill_key: Any = "skill"
    """Entry of the skill, int64 [*B]."""
    action_key: Any = "action"
    """Entry the action is written to."""
    hidden: Any = field(default_factory=lambda: [64, 64])
    """Widths of the shared layers."""
    activation: Any = "torch.nn.modules.activation.ReLU"
    """Builds the activations."""
    network: Any = "torchrl_hmcts.modules.skill_mlp.SkillMLP"
    """Builds the network, with the signature of SkillMLP."""
    _component_: str = "torchrl_hmcts.modules.SkillActor"


@dataclass
class GaussianSkillActorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.GaussianSkillActor`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl.data import Bounded
        >>> instantiate(GaussianSkillActorConfig(
        ...     in_features=2, num_skills=3, in_keys=["velocity"], _partial_=True))(
        ...     action_spec=Bounded(-1, 1, [2])).num_skills
        3
    """

    in_features: int = MISSING
    """Summed sizes of the entries in_keys."""
    action_spec: Any = MISSING
    """The env's action spec, a Bounded with the last dimension D; leading (batch) dimensions must
    have the same bounds."""
    num_skills: int = MISSING
    """Number of skills."""
    in_keys: Any = MISSING
    """Observation entries [*B, f_i], concatenated in order."""
    skill_key: Any = "skill"
    """Entry of the skill, int64 [*B]."""
    action_key: Any = "action"
    """Entry the action is written to, [*B, D]."""
    hidden: Any = field(default_factory=lambda: [64, 64])
    """Widths of the shared layers."""
    activation: Any = "torch.nn.modules.activation.ReLU"
    """Builds the activations."""
    network: Any = "torchrl_hmcts.modules.skill_mlp.SkillMLP"
    """Builds the network, with the signature of SkillMLP."""
    _component_: str = "torchrl_hmcts.modules.GaussianSkillActor"


@dataclass
class SkillCriticConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.SkillCritic`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(SkillCriticConfig(
        ...     in_features=2, num_actions=4, num_skills=3, in_keys=["velocity"])).out_keys
        ['action_value']
    """

    in_features: int = MISSING
    """Summed sizes of the entries in_keys."""
    num_actions: int = MISSING
    """Number of actions A."""
    num_skills: int = MISSING
    """Number of skills."""
    in_keys: Any = MISSING
    """Observation entries [*B, f_i], concatenated in order."""
    skill_key: Any = "skill"
    """Entry of the skill, int64 [*B]."""
    action_value_key: Any = "action_value"
    """Entry written, [*B, A]."""
    hidden: Any = field(default_factory=lambda: [64, 64])
    """Widths of the shared layers."""
    activation: Any = "torch.nn.modules.activation.ReLU"
    """Builds the activations."""
    network: Any = "torchrl_hmcts.modules.skill_mlp.SkillMLP"
    """Builds the network, with the signature of SkillMLP."""
    _component_: str = "torchrl_hmcts.modules.SkillCritic"


@dataclass
class SkillActionCriticConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.SkillActionCritic`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(SkillActionCriticConfig(
        ...     in_features=2, action_features=2, num_skills=3, in_keys=["velocity"])).in_keys
        ['velocity', 'action', 'skill']
    """

    in_features: int = MISSING
    """Summed sizes of the entries in_keys, without the action."""
    action_features: int = MISSING
    """Size of the action, D."""
    num_skills: int = MISSING
    """Number of skills."""
    in_keys: Any = MISSING
    """Observation entries [*B, f_i], concatenated in order."""
    skill_key: Any = "skill"
    """Entry of the skill, int64 [*B]."""
    action_key: Any = "action"
    """Entry of the action, [*B, D]."""
    state_action_value_key: Any = "state_action_value"
    """Entry written, [*B, 1]."""
    hidden: Any = field(default_factory=lambda: [64, 64])
    """Widths of the shared layers."""
    activation: Any = "torch.nn.modules.activation.ReLU"
    """Builds the activations."""
    network: Any = "torchrl_hmcts.modules.skill_mlp.SkillMLP"
    """Builds the network, with the signature of SkillMLP."""
    _component_: str = "torchrl_hmcts.modules.SkillActionCritic"


@dataclass
class SkillDiscriminatorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.SkillDiscriminator`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(SkillDiscriminatorConfig(in_features=2, num_skills=3)).out_keys
        ['skill_logits']
    """

    in_features: int = MISSING
    """Summed sizes of the entries in_keys."""
    num_skills: int = MISSING
    """Number of skills Z."""
    in_keys: Any = field(default_factory=lambda: ["displacement"])
    """Entries [*B, f_i], concatenated in order."""
    skill_logits_key: Any = "skill_logits"
    """Entry written, [*B, Z]."""
    hidden: Any = field(default_factory=list)
    """Widths of the hidden layers."""
    activation: Any = "torch.nn.modules.activation.ReLU"
    """Builds the activations."""
    _component_: str = "torchrl_hmcts.modules.SkillDiscriminator"


@dataclass
class SkillEncoderConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.SkillEncoder`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(SkillEncoderConfig(in_features=2, num_skills=3)).out_keys
        ['representation']
    """

    in_features: int = MISSING
    """Summed sizes of the entries in_keys."""
    num_skills: int = MISSING
    """Number of skills Z."""
    in_keys: Any = field(default_factory=lambda: ["position"])
    """Entries [*B, f_i], concatenated in order."""
    representation_key: Any = "representation"
    """Entry written, [*B, Z]."""
    hidden: Any = field(default_factory=lambda: [64, 64])
    """Widths of the hidden layers."""
    activation: Any = "torch.nn.modules.activation.ReLU"
    """Builds the activations."""
    linear: Any = "torch.nn.modules.linear.Linear"
    """Builds the linear layers from their two sizes."""
    _component_: str = "torchrl_hmcts.modules.SkillEncoder"


@dataclass
class SkillDynamicsConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.SkillDynamics`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(SkillDynamicsConfig(
        ...     in_features=2, target_features=2, num_skills=3)).out_keys
        ['skill_loc', 'skill_scale']
    """

    in_features: int = MISSING
    """Summed sizes of the entries in_keys."""
    target_features: int = MISSING
    """Size D of the entry whose change is predicted."""
    num_skills: int = MISSING
    """Number of skills Z."""
    in_keys: Any = field(default_factory=lambda: ["position"])
    """Entries [*B, f_i] the prediction depends on."""
    target_key: Any = "position"
    """Entry [*B, D] whose change is predicted."""
    std: float = 0.1
    """Standard deviation of each dimension, in units of the target; at the start, if it is
    learned."""
    learned_std: bool = True
    """Learn one standard deviation per dimension instead of keeping std."""
    min_std: float = 0.001
    """Lower bound of a learned one."""
    loc_key: Any = "skill_loc"
    """Entries written, both [*B, Z, D]."""
    scale_key: Any = "skill_scale"
    """Entries written, both [*B, Z, D]."""
    hidden: Any = field(default_factory=lambda: [64, 64])
    """Widths of the shared layers."""
    activation: Any = "torch.nn.modules.activation.ReLU"
    """Builds the activations."""
    network: Any = "torchrl_hmcts.modules.skill_mlp.SkillMLP"
    """Builds the network, with the signature and the method all_skills of SkillMLP."""
    _component_: str = "torchrl_hmcts.modules.SkillDynamics"


@dataclass
class SkillPolicyConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.SkillPolicy`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import SkillActor
        >>> actor = SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"])
        >>> instantiate(SkillPolicyConfig(deterministic=True, _partial_=True))(
        ...     actor=actor).deterministic
        True
    """

    actor: Any = MISSING
    """The actor whose parameters are used; later updates are seen."""
    deterministic: bool = False
    """Take the most probable action (of a Gaussian: its mean, squashed) instead of sampling."""
    generator: Any = None
    """Source of the samples."""
    _component_: str = "torchrl_hmcts.modules.SkillPolicy"


@dataclass
class FixedSkillPriorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.FixedSkillPrior`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(FixedSkillPriorConfig(num_skills=4)).probs()
        tensor([0.2500, 0.2500, 0.2500, 0.2500])
    """

    num_skills: int = MISSING
    """Number of skills Z."""
    weights: Any = None
    """[Z], not negative, normalised here; 0 switches a skill off."""
    _component_: str = "torchrl_hmcts.modules.FixedSkillPrior"


@dataclass
class LearnedSkillPriorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.LearnedSkillPrior`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(LearnedSkillPriorConfig(num_skills=4)).num_skills
        4
    """

    num_skills: int = MISSING
    """Number of skills Z."""
    logits: Any = None
    """Logits of the skills at first, [Z]."""
    _component_: str = "torchrl_hmcts.modules.LearnedSkillPrior"


@dataclass
class GrowingSkillPriorConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.GrowingSkillPrior`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(GrowingSkillPriorConfig(num_skills=4)).probs()
        tensor([0.5000, 0.5000, 0.0000, 0.0000])
    """

    num_skills: int = MISSING
    """Number of skills there is room for, Z."""
    num_active: int = 2
    """Number of skills switched on at first."""
    _component_: str = "torchrl_hmcts.modules.GrowingSkillPrior"


@dataclass
class TerminationNetworkConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.TerminationNetwork`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(TerminationNetworkConfig(
        ...     in_features=2, num_options=3, in_keys=["velocity"])).out_keys
        ['termination_logits']
    """

    in_features: int = MISSING
    """Summed sizes of the entries in_keys."""
    num_options: int = MISSING
    """Number of options."""
    in_keys: Any = MISSING
    """Float entries [*B, f_i], concatenated in order."""
    skill_key: Any = "skill"
    """The option, int64 [*B]."""
    termination_logits_key: Any = "termination_logits"
    """Entry written, [*B, 1]."""
    initial_probability: float = 0.5
    """Probability of ending with which training begins, about, in (0, 1)."""
    hidden: Any = field(default_factory=lambda: [64, 64])
    """Widths of the shared layers."""
    activation: Any = "torch.nn.modules.activation.ReLU"
    """Builds the activations."""
    _component_: str = "torchrl_hmcts.modules.TerminationNetwork"


@dataclass
class LearnedTerminationConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.LearnedTermination`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import TerminationNetwork
        >>> instantiate(LearnedTerminationConfig(_partial_=True))(
        ...     network=TerminationNetwork(2, 3, in_keys=["velocity"])).in_keys
        ['velocity', 'skill', 'duration']
    """

    network: Any = MISSING
    """Writes logits [*B, 1], e.g. a TerminationNetwork, or a TensorDictSequential of what computes
    its features and one."""
    deterministic: bool = True
    """Do not sample."""
    generator: Any = None
    """Source of the samples."""
    every: int = 1
    """Base steps between two questions, so that an option may end after that many, twice that many
    and so on; asking costs a call of the network."""
    termination_logits_key: Any = "termination_logits"
    """Default "termination_logits"."""
    duration_key: Any = "duration"
    """Base steps taken, int64 [*B, 1]."""
    _component_: str = "torchrl_hmcts.modules.LearnedTermination"


@dataclass
class StallTerminationConfig(ComponentConfig):
    """Keys of :class:`~torchrl_hmcts.modules.StallTermination`.

    Example:
        >>> from hydra.utils import instantiate
        >>> instantiate(StallTerminationConfig(num_steps=3))
        StallTermination(3)
    """

    num_steps: int = MISSING
    """Base steps N in a row without a change, at least 1."""
    stalled_key: Any = "stalled_steps"
    """The count, int64 [*B, 1]."""
    duration_key: Any = "duration"
    """Base steps taken, int64 [*B, 1]."""
    _component_: str = "torchrl_hmcts.modules.StallTermination"
