"""Configs of the losses, group ``loss``; values are explained below each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from torchrl_hmcts.trainers.configs.base import LossComponentConfig


@dataclass
class DIAYNLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.DIAYNLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import SkillActor, SkillCritic, SkillDiscriminator
        >>> actor = SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"])
        >>> critic = SkillCritic(2, 4, num_skills=3, in_keys=["velocity"])
        >>> instantiate(DIAYNLossConfig(action_space="categorical", _partial_=True))(
        ...     actor_network=actor, qvalue_network=critic,
        ...     discriminator=SkillDiscriminator(2, num_skills=3)).out_keys[0]
        'loss_actor'
    """

    actor_network: Any = MISSING
    """The policy pi(a | s, z), e.g. a SkillActor."""
    qvalue_network: Any = MISSING
    """Writes action_value [*B, A], e.g. a SkillCritic; copied num_qvalue_nets times."""
    discriminator: Any = MISSING
    """Writes skill_logits [*B, Z] from its in_keys in the "next" part of a transition."""
    action_space: Any = MISSING
    """"categorical", "one-hot" or the action spec."""
    num_skills: int | None = None
    """Number of skills."""
    prior: Any = None
    """Probabilities of the skills; null: uniform."""
    num_actions: int | None = None
    """Number of actions A."""
    gamma: float = 0.95
    """Discount per base step."""
    alpha_init: float = 0.3
    """Entropy coefficient at the start, in units of reward."""
    fixed_alpha: bool = True
    """Keep alpha instead of tuning it to a target entropy."""
    min_alpha: float | None = None
    """Least value of a tuned alpha."""
    max_alpha: float | None = None
    """Largest value of a tuned alpha."""
    target_entropy_weight: float = 0.5
    """Target entropy as a fraction of log A."""
    target_entropy: Any = "auto"
    """Target entropy in nats."""
    num_qvalue_nets: int = 2
    """Number of critics."""
    loss_function: str = "l2"
    """"l2", "l1" or "smooth_l1" for the critics."""
    delay_qvalue: bool = True
    """Bootstrap from target critics, to be moved by SoftUpdate."""
    reduction: str = "mean"
    """"mean", "sum" or "none"."""
    skip_done_states: bool = False
    """Leave states after the end of an episode out of the networks' batches."""
    deactivate_vmap: bool = False
    """Run the critics one after the other."""
    _component_: str = "torchrl_hmcts.objectives.DIAYNLoss"


@dataclass
class ContinuousDIAYNLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.ContinuousDIAYNLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl.data import Bounded
        >>> from torchrl_hmcts.modules import GaussianSkillActor, SkillActionCritic
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> actor = GaussianSkillActor(2, Bounded(-1, 1, [2]), 3, in_keys=["velocity"])
        >>> critic = SkillActionCritic(2, 2, 3, in_keys=["velocity"])
        >>> instantiate(ContinuousDIAYNLossConfig(_partial_=True))(
        ...     actor_network=actor, qvalue_network=critic,
        ...     discriminator=SkillDiscriminator(2, num_skills=3)).out_keys[0]
        'loss_actor'
    """

    actor_network: Any = MISSING
    """The policy pi(a | s, z), e.g. a GaussianSkillActor."""
    qvalue_network: Any = MISSING
    """Writes state_action_value [*B, 1], e.g. a SkillActionCritic; copied for the twins."""
    discriminator: Any = MISSING
    """Writes skill_logits [*B, Z] from its in_keys in the "next" part of a transition."""
    num_skills: int | None = None
    """Number of skills."""
    prior: Any = None
    """Probabilities of the skills; null: uniform."""
    reduction: str = "mean"
    """"mean", "sum" or "none"."""
    _component_: str = "torchrl_hmcts.objectives.ContinuousDIAYNLoss"


@dataclass
class DiscreteSkillSACLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.DiscreteSkillSACLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import SkillActor, SkillCritic, SkillDiscriminator
        >>> actor = SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"])
        >>> critic = SkillCritic(2, 4, num_skills=3, in_keys=["velocity"])
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss
        >>> objective = SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=3))
        >>> instantiate(DiscreteSkillSACLossConfig(action_space="categorical", _partial_=True))(
        ...     actor_network=actor, qvalue_network=critic,
        ...     objective=objective).objective.num_skills
        3
    """

    actor_network: Any = MISSING
    """The policy pi(a | s, z), e.g. a SkillActor."""
    qvalue_network: Any = MISSING
    """Writes action_value [*B, A], e.g. a SkillCritic; copied num_qvalue_nets times."""
    objective: Any = MISSING
    """What makes skills different, e.g. a SkillDiscriminatorLoss or METRAEncoderLoss."""
    action_space: Any = MISSING
    """"categorical", "one-hot" or the action spec."""
    num_actions: int | None = None
    """Number of actions A."""
    gamma: float = 0.95
    """Discount per base step."""
    alpha_init: float = 0.3
    """Entropy coefficient at the start, in units of reward."""
    fixed_alpha: bool = True
    """Keep alpha instead of tuning it to a target entropy."""
    min_alpha: float | None = None
    """Least value of a tuned alpha."""
    max_alpha: float | None = None
    """Largest value of a tuned alpha."""
    target_entropy_weight: float = 0.5
    """Target entropy as a fraction of log A."""
    target_entropy: Any = "auto"
    """Target entropy in nats."""
    policy_prior: Any = None
    """Writes the logits of a policy that pi is kept near; none: the uniform one."""
    num_qvalue_nets: int = 2
    """Number of critics."""
    loss_function: str = "l2"
    """"l2", "l1" or "smooth_l1" for the critics."""
    delay_qvalue: bool = True
    """Bootstrap from target critics, to be moved by SoftUpdate."""
    reduction: str | None = None
    """"mean", "sum" or "none"."""
    skip_done_states: bool = False
    """Leave states after the end of an episode out of the networks' batches."""
    deactivate_vmap: bool = False
    """Run critics that cannot be stacked one after the other."""
    _component_: str = "torchrl_hmcts.objectives.DiscreteSkillSACLoss"


@dataclass
class SkillSACLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.SkillSACLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl.data import Bounded
        >>> from torchrl_hmcts.modules import GaussianSkillActor, SkillActionCritic
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> actor = GaussianSkillActor(2, Bounded(-1, 1, [2]), 3, in_keys=["velocity"])
        >>> critic = SkillActionCritic(2, 2, 3, in_keys=["velocity"])
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss
        >>> objective = SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=3))
        >>> instantiate(SkillSACLossConfig(_partial_=True))(
        ...     actor_network=actor, qvalue_network=critic,
        ...     objective=objective).objective.num_skills
        3
    """

    actor_network: Any = MISSING
    """The policy pi(a | s, z), e.g. a GaussianSkillActor."""
    qvalue_network: Any = MISSING
    """Reads the action too and writes state_action_value [*B, 1], e.g. a SkillActionCritic; copied
    num_qvalue_nets times."""
    objective: Any = MISSING
    """What makes skills different, e.g. a SkillDiscriminatorLoss or METRAEncoderLoss."""
    action_spec: Any = None
    """Spec of the action, [D]."""
    gamma: float = 0.95
    """Discount per base step."""
    alpha_init: float = 0.3
    """Entropy coefficient at the start, in units of reward."""
    fixed_alpha: bool = True
    """Keep alpha instead of tuning it to a target entropy."""
    min_alpha: float | None = None
    """Least value of a tuned alpha."""
    max_alpha: float | None = None
    """Largest value of a tuned alpha."""
    target_entropy: Any = "auto"
    """Target entropy in nats."""
    num_qvalue_nets: int = 2
    """Number of critics."""
    loss_function: str = "l2"
    """"l2", "l1" or "smooth_l1" for the critics."""
    delay_qvalue: bool = True
    """Bootstrap from target critics, to be moved by SoftUpdate."""
    reduction: str | None = None
    """"mean", "sum" or "none"."""
    skip_done_states: bool = False
    """Leave states after the end of an episode out of the networks' batches."""
    deactivate_vmap: bool = False
    """Run critics that cannot be stacked one after the other."""
    _component_: str = "torchrl_hmcts.objectives.SkillSACLoss"


@dataclass
class A3CLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.A3CLoss`.

    Example:
        >>> A3CLossConfig(gamma=0.95).gamma
        0.95
    """

    actor_network: Any = MISSING
    """The policy."""
    critic_network: Any = MISSING
    """Writes state_value [*B, T, 1], or the value as its first entry of another name."""
    gamma: float = 0.99
    """Discount per base step, in (0, 1]."""
    entropy_coeff: float = 0.01
    """Weight of the entropy bonus, nats to return, not negative."""
    critic_coeff: float = 0.5
    """Weight of the squared value error, above 0."""
    reduction: str = "mean"
    """"mean", "sum", which is the paper's accumulation, or "none"."""
    loss_critic_type: str = "l2"
    """"l2", "l1" or "smooth_l1"."""
    _component_: str = "torchrl_hmcts.objectives.A3CLoss"


@dataclass
class ExpertIterationLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.ExpertIterationLoss`.

    Example:
        >>> ExpertIterationLossConfig(reduction="sum").reduction
        'sum'
    """

    network: Any = MISSING
    """Reads its in_keys and writes logits [*B, A] and state_value [*B, 1], the prior and the value
    of a planner."""
    value_coeff: float = 1.0
    """Weight of the value loss."""
    value_loss: str = "l2"
    """"l2", "smooth_l1", "log" or "cross_entropy"."""
    reduction: str = "mean"
    """"mean" (default; over all examples, whatever their weights), "sum" or "none"."""
    _component_: str = "torchrl_hmcts.objectives.ExpertIterationLoss"


@dataclass
class OptionModelLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.OptionModelLoss`.

    Example:
        >>> OptionModelLossConfig(reduction="sum").reduction
        'sum'
    """

    model: Any = MISSING
    """What is trained; it stays a sub-module as it is."""
    delta_loss: str = "smooth_l1"
    """"l2", "l1" or "smooth_l1" (Huber)."""
    reward_loss: str = "l2"
    """"l2", "l1" or "smooth_l1" (Huber)."""
    duration_loss: str = "smooth_l1"
    """"l2", "l1" or "smooth_l1" (Huber)."""
    delta_coeff: float = 1.0
    """C_s, c_R, c_k, c_p, the weights of the parts."""
    reward_coeff: float = 1.0
    """C_s, c_R, c_k, c_p, the weights of the parts."""
    duration_coeff: float = 1.0
    """C_s, c_R, c_k, c_p, the weights of the parts."""
    terminated_coeff: float = 1.0
    """C_s, c_R, c_k, c_p, the weights of the parts."""
    reduction: str = "mean"
    """"mean", "sum" or "none" over the batch."""
    _component_: str = "torchrl_hmcts.objectives.OptionModelLoss"


@dataclass
class IntraOptionQLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.IntraOptionQLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import SkillCritic
        >>> critic = SkillCritic(2, 4, num_skills=3, in_keys=["velocity"])
        >>> instantiate(IntraOptionQLossConfig(_partial_=True))(qvalue_network=critic).out_keys
        ['loss_qvalue', 'td_error']
    """

    qvalue_network: Any = MISSING
    """Writes action_value [*B, A]."""
    termination_network: Any = None
    """Writes termination_logits."""
    gamma: float = 0.99
    """Discount per base step, in (0, 1]."""
    loss_function: str = "l2"
    """"l2", "l1" or "smooth_l1"."""
    delay_value: bool = True
    """Bootstrap from target parameters, to be moved by SoftUpdate."""
    reduction: str = "mean"
    """"mean", "sum" or "none"."""
    _component_: str = "torchrl_hmcts.objectives.IntraOptionQLoss"


@dataclass
class OptionTerminationLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.OptionTerminationLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import TerminationNetwork
        >>> instantiate(OptionTerminationLossConfig(_partial_=True))(
        ...     termination_network=TerminationNetwork(2, 3, in_keys=["velocity"])).out_keys
        ['loss_termination', 'termination_probability', 'option_advantage']
    """

    termination_network: Any = MISSING
    """Writes termination_logits [*B, 1] from entries of the next state and the option skill, e.g. a
    TerminationNetwork."""
    qvalue_network: Any = None
    """Writes action_value [*B, A] from entries of the next state."""
    deliberation_cost: float = 0.0
    """Cost of ending an option, at least 0, in units of return."""
    option_policy: Any = None
    """option_policy(td) -> probabilities [*B, A] in the next state, e.g. a ModulePrior."""
    reduction: str = "mean"
    """"mean", "sum" or "none"."""
    _component_: str = "torchrl_hmcts.objectives.OptionTerminationLoss"


@dataclass
class SkillPriorLossConfig(LossComponentConfig):
    """Keys of :class:`~torchrl_hmcts.objectives.SkillPriorLoss`.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_hmcts.modules import LearnedSkillPrior
        >>> instantiate(SkillPriorLossConfig(_partial_=True))(prior=LearnedSkillPrior(3)).out_keys
        ['loss_skill_prior', 'skill_prior_entropy', 'num_effective_skills']
    """

    prior: Any = MISSING
    """The prior to train, e.g. a LearnedSkillPrior."""
    entropy_coeff: float = 1.0
    """Weight of the prior's entropy, not negative, in units of reward."""
    prior_in_reward: bool = True
    """The reward that is read contains -log p(z), as DIAYN's and VIC's do; it is taken out, since
    the entropy stands for it."""
    decay: float = 0.9
    """Share of the old running mean that a batch keeps, in [0, 1)."""
    reduction: str = "sum"
    """Over skills: "sum" is L above; "none" gives its terms, [Z]; "mean" is L / Z."""
    _component_: str = "torchrl_hmcts.objectives.SkillPriorLoss"
