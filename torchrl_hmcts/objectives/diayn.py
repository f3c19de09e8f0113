"""Diversity is all you need: skills that can be told apart, on soft actor-critic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictParams,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec

from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.discrete_skill_sac import DiscreteSkillSACLoss
from torchrl_hmcts.objectives.discriminator import SkillDiscriminatorLoss
from torchrl_hmcts.objectives.skill_sac import SkillSACLoss

_Base: Any = DiscreteSkillSACLoss if TYPE_CHECKING else object


class _WithDiscriminator(_Base):
    """What both kinds of DIAYN share: names for the parts of their objective."""

    objective: SkillDiscriminatorLoss

    @property
    def discriminator(self) -> TensorDictModuleBase:
        """The discriminator module; its live parameters are those this loss trains."""
        return self.objective.discriminator

    @property
    def discriminator_params(self) -> TensorDictParams:
        """The discriminator's parameters."""
        return self.objective.discriminator_params

    def discriminator_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the discriminator's cross-entropy and its accuracy."""
        return self.objective.discriminator_loss(tensordict)


class DIAYNLoss(_WithDiscriminator, DiscreteSkillSACLoss):
    r"""Discrete soft actor-critic with twin critics, conditioned on skills, plus a discriminator.

    .. math::

        L_Q(\theta_i) &= \ell\bigl(Q_{\theta_i}(s, z, a),\; r + \gamma (1 - d) V(s', z)\bigr), \quad
        V(s', z) = \sum_a \pi(a \mid s', z) \bigl[\min_i \bar Q_i(s', z, a)
        - \alpha \log \pi(a \mid s', z)\bigr] \\
        L_\pi &= \sum_a \pi(a \mid s, z) \bigl[\alpha \log \pi(a \mid s, z)
        - \min_i Q_i(s, z, a)\bigr] \\
        L_\phi &= -\log q_\phi(z \mid s')

    It is a :class:`DiscreteSkillSACLoss` with a :class:`SkillDiscriminatorLoss`. The reward
    :math:`r` is the entry ``("next", "reward")``: put a
    :class:`~torchrl_hmcts.transforms.SkillReward` with ``loss.objective`` on the replay buffer. It
    runs with ``SoftUpdate``, ``Trainer`` and ``SACTrainer`` unchanged. No loss sends gradients into
    the parameters of another.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy pi(a | s, z), e.g. a
            :class:`~torchrl_hmcts.modules.SkillActor`.
        qvalue_network (TensorDictModuleBase): writes ``action_value`` ``[*B, A]``, e.g. a
            :class:`~torchrl_hmcts.modules.SkillCritic`; copied ``num_qvalue_nets`` times.
        discriminator (TensorDictModuleBase): writes ``skill_logits`` ``[*B, Z]`` from its
            ``in_keys`` in the ``"next"`` part of a transition.
        action_space (str or TensorSpec): ``"categorical"``, ``"one-hot"`` or the action spec.
        num_skills (int, optional): number of skills. Default: that of the discriminator.
        prior (SkillPrior, sequence of float or Tensor, optional): p(z). Default ``None``: uniform.
            See :class:`SkillDiscriminatorLoss`.
        num_actions (int, optional): number of actions ``A``. Default: that of the actor; needed
            only for ``target_entropy="auto"``.
        gamma (float): discount per base step. Default ``0.95``: a horizon of twenty steps, about
            what it takes a body with momentum to turn round.
        alpha_init (float): entropy coefficient at the start, in units of reward. Default ``0.3``:
            with less, skills settle before they have spread out, and two of them stay together.
        fixed_alpha (bool): keep alpha instead of tuning it to a target entropy. Default ``True``:
            in a run of a few hundred updates a tuned alpha is still far from settling.
        min_alpha, max_alpha (float, optional): bounds of a tuned alpha. Default ``None``.
        target_entropy_weight (float): target entropy as a fraction of ``log A``. Default ``0.5``.
        target_entropy (float or "auto"): target entropy in nats. Default ``"auto"``.
        num_qvalue_nets (int): number of critics. Default ``2``, the twins.
        loss_function (str): ``"l2"`` (default), ``"l1"`` or ``"smooth_l1"`` for the critics.
        delay_qvalue (bool): bootstrap from target critics, to be moved by ``SoftUpdate``. Default
            ``True``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.
        skip_done_states (bool): ``DiscreteSACLoss`` has it; without effect here: what follows
            a transition is never read where it terminates, and always where it is truncated.
            Default ``False``.
        deactivate_vmap (bool): run the critics one after the other. Default ``False``.

    Returns:
        TensorDict with ``loss_actor``, ``loss_qvalue`` (summed over the critics), ``loss_alpha``,
        ``loss_discriminator`` and the detached diagnostics ``qvalue_loss_0``, ``qvalue_loss_1``
        and so on (each critic's own), ``discriminator_accuracy``, ``alpha``, ``entropy`` (nats).
        With ``reduction="none"`` all entries are ``[*B]``; ``alpha`` and ``entropy`` are left
        out.

    Raises:
        ValueError: if ``gamma`` is outside [0, 1] or the reduction is unknown.

    Keys (``set_keys``): those of ``DiscreteSACLoss`` and of :class:`SkillDiscriminatorLoss`
    (``skill``, ``skill_logits``).

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070; Christodoulou, "Soft
        Actor-Critic for Discrete Action Settings", 2019, arXiv 1910.07207; Bartley 2023, ch. 4.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_hmcts.modules import SkillActor, SkillCritic, SkillDiscriminator
        >>> from torchrl_hmcts.objectives import DIAYNLoss
        >>> spec = Categorical(4)
        >>> loss = DIAYNLoss(
        ...     SkillActor(2, spec, num_skills=3, in_keys=["velocity"]),
        ...     SkillCritic(2, 4, num_skills=3, in_keys=["velocity"]),
        ...     SkillDiscriminator(2, num_skills=3),
        ...     action_space=spec,
        ... )
        >>> updater = SoftUpdate(loss, tau=0.01)
        >>> td = TensorDict(
        ...     velocity=torch.randn(8, 2), skill=torch.randint(3, (8,)), action=spec.rand([8]),
        ...     next=TensorDict(
        ...         velocity=torch.randn(8, 2), skill=torch.zeros(8, dtype=torch.int64),
        ...         displacement=torch.randn(8, 2), reward=torch.randn(8, 1),
        ...         done=torch.zeros(8, 1, dtype=torch.bool),
        ...         terminated=torch.zeros(8, 1, dtype=torch.bool), batch_size=[8]),
        ...     batch_size=[8])
        >>> [key for key in loss(td).keys() if key.startswith("loss")]
        ['loss_actor', 'loss_qvalue', 'loss_alpha', 'loss_discriminator']
    """

    @dataclass
    class _AcceptedKeys(DiscreteSkillSACLoss._AcceptedKeys):
        skill_logits: NestedKey = "skill_logits"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase,
        discriminator: TensorDictModuleBase,
        *,
        action_space: str | TensorSpec,
        num_skills: int | None = None,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        num_actions: int | None = None,
        gamma: float = 0.95,
        alpha_init: float = 0.3,
        fixed_alpha: bool = True,
        min_alpha: float | None = None,
        max_alpha: float | None = None,
        target_entropy_weight: float = 0.5,
        target_entropy: float | str = "auto",
        num_qvalue_nets: int = 2,
        loss_function: str = "l2",
        delay_qvalue: bool = True,
        reduction: str = "mean",
        skip_done_states: bool = False,
        deactivate_vmap: bool = False,
    ) -> None:
        super().__init__(
            actor_network,
            qvalue_network,
            SkillDiscriminatorLoss(
                discriminator, num_skills=num_skills, prior=prior, reduction=reduction
            ),
            action_space=action_space,
            num_actions=num_actions,
            gamma=gamma,
            alpha_init=alpha_init,
            fixed_alpha=fixed_alpha,
            min_alpha=min_alpha,
            max_alpha=max_alpha,
            target_entropy_weight=target_entropy_weight,
            target_entropy=target_entropy,
            num_qvalue_nets=num_qvalue_nets,
            loss_function=loss_function,
            delay_qvalue=delay_qvalue,
            skip_done_states=skip_done_states,
            deactivate_vmap=deactivate_vmap,
        )
        self.register_load_state_dict_pre_hook(_rename_discriminator_objective)


class ContinuousDIAYNLoss(_WithDiscriminator, SkillSACLoss):
    r"""Soft actor-critic for continuous actions, conditioned on skills, plus a discriminator.

    .. math:: L = L_{\text{SAC}}(\theta, \pi) + L_\phi, \qquad L_\phi = -\log q_\phi(z \mid s')

    :class:`DIAYNLoss` for continuous actions: a :class:`SkillSACLoss` with a
    :class:`SkillDiscriminatorLoss`.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy pi(a | s, z), e.g. a
            :class:`~torchrl_hmcts.modules.GaussianSkillActor`.
        qvalue_network (TensorDictModuleBase): writes ``state_action_value`` ``[*B, 1]``, e.g. a
            :class:`~torchrl_hmcts.modules.SkillActionCritic`; copied for the twins.
        discriminator (TensorDictModuleBase): writes ``skill_logits`` ``[*B, Z]`` from its
            ``in_keys`` in the ``"next"`` part of a transition.
        num_skills (int, optional): number of skills. Default: that of the discriminator.
        prior (SkillPrior, sequence of float or Tensor, optional): p(z). Default ``None``: uniform.
            See :class:`SkillDiscriminatorLoss`.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.
        **sac_kwargs: passed to :class:`SkillSACLoss`.

    Returns:
        TensorDict with the entries of :class:`DIAYNLoss`.

    Raises:
        ValueError: as :class:`SkillSACLoss`.

    Keys (``set_keys``): those of ``SACLoss`` and of :class:`SkillDiscriminatorLoss` (``skill``,
    ``skill_logits``).

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_hmcts.modules import (
        ...     GaussianSkillActor, SkillActionCritic, SkillDiscriminator)
        >>> from torchrl_hmcts.objectives import ContinuousDIAYNLoss
        >>> spec = Bounded(-1.0, 1.0, shape=(2,))
        >>> loss = ContinuousDIAYNLoss(
        ...     GaussianSkillActor(2, spec, num_skills=3, in_keys=["velocity"]),
        ...     SkillActionCritic(2, 2, num_skills=3, in_keys=["velocity"]),
        ...     SkillDiscriminator(2, num_skills=3),
        ... )
        >>> loss.objective.num_skills
        3
    """

    @dataclass
    class _AcceptedKeys(SkillSACLoss._AcceptedKeys):
        skill_logits: NestedKey = "skill_logits"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase,
        discriminator: TensorDictModuleBase,
        *,
        num_skills: int | None = None,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        reduction: str = "mean",
        **sac_kwargs: Any,
    ) -> None:
        objective = SkillDiscriminatorLoss(
            discriminator, num_skills=num_skills, prior=prior, reduction=reduction
        )
        super().__init__(actor_network, qvalue_network, objective, **sac_kwargs)


def _rename_discriminator_objective(
    module: DIAYNLoss, state_dict: dict[str, Any], prefix: str, *_: Any
) -> None:
    """Reads state dicts of the time when the objective was called discriminator_objective."""
    old = prefix + "discriminator_objective."
    for key in [key for key in state_dict if key.startswith(old)]:
        state_dict[prefix + "objective." + key[len(old) :]] = state_dict.pop(key)
