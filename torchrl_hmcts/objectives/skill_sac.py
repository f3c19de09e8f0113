"""Continuous soft actor-critic with twin critics, conditioned on skills, and a skill objective."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictParams,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.objectives import SACLoss

from torchrl_hmcts.objectives.skill_objective import SkillObjective
from torchrl_hmcts.objectives.trains_objective import TrainsObjective


class SkillSACLoss(TrainsObjective, SACLoss):
    r"""Soft actor-critic for continuous actions, conditioned on skills, and a skill objective.

    .. math::

        L_Q(\theta_i) &= \ell\bigl(Q_{\theta_i}(s, z, a),\; r + \gamma (1 - d) V(s', z)\bigr), \quad
        V(s', z) = \min_i \bar Q_i(s', z, a') - \alpha \log \pi(a' \mid s', z) \\
        L_\pi &= \alpha \log \pi(\tilde a \mid s, z) - \min_i Q_i(s, z, \tilde a)

    with :math:`a'` and the reparametrised :math:`\tilde a` drawn from the policy, plus the losses
    of the objective. The reward :math:`r` is the entry ``("next", "reward")``: put a
    :class:`~torchrl_hmcts.transforms.SkillReward` with the same objective on the replay buffer.
    Being a :class:`torchrl.objectives.SACLoss`, it runs with ``SoftUpdate``, ``Trainer`` and
    ``SACTrainer`` unchanged. No loss sends gradients into the parameters of another.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy pi(a | s, z), e.g. a
            :class:`~torchrl_hmcts.modules.GaussianSkillActor`.
        qvalue_network (TensorDictModuleBase): reads the action too and writes
            ``state_action_value`` ``[*B, 1]``, e.g. a
            :class:`~torchrl_hmcts.modules.SkillActionCritic`; copied ``num_qvalue_nets`` times.
        objective (SkillObjective): what makes skills different, e.g. a
            :class:`SkillDiscriminatorLoss` or :class:`METRAEncoderLoss`.
        action_spec (TensorSpec, optional): of the action ``[D]``. Default: that of the actor;
            needed only for ``target_entropy="auto"``.
        gamma (float): discount per base step. Default ``0.95``, as for discrete actions.
        alpha_init (float): entropy coefficient at the start, in units of reward. Default ``0.3``.
        fixed_alpha (bool): keep alpha instead of tuning it to a target entropy. Default ``True``.
        min_alpha, max_alpha (float, optional): bounds of a tuned alpha. Default ``None``.
        target_entropy (float or "auto"): target entropy in nats. Default ``"auto"``: ``-D``.
        num_qvalue_nets (int): number of critics. Default ``2``, the twins.
        loss_function (str): ``"l2"`` (default), ``"l1"`` or ``"smooth_l1"`` for the critics.
        delay_qvalue (bool): bootstrap from target critics, to be moved by ``SoftUpdate``. Default
            ``True``.
        reduction (str, optional): ``"mean"``, ``"sum"`` or ``"none"``. Default: that of the
            objective, which must be the same.
        skip_done_states (bool): an argument of ``SACLoss`` without effect here: what follows
            a transition is never read where it terminates, and always where it is truncated.
            Default ``False``.
        deactivate_vmap (bool): run critics that cannot be stacked one after the other. Default
            ``False``.

    Returns:
        TensorDict with the entries of :class:`DiscreteSkillSACLoss`; ``entropy`` is that of the
        drawn actions.

    Raises:
        TypeError: if the objective is no :class:`SkillObjective`.
        ValueError: as :class:`DiscreteSkillSACLoss`.

    Keys (``set_keys``): those of ``SACLoss``, and ``skill``, which is handed on to the objective.
    Other keys of the objective are set on ``loss.objective``.

    Reference:
        Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", 2018, arXiv 1812.05905.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_hmcts.modules import (
        ...     GaussianSkillActor, SkillActionCritic, SkillDiscriminator)
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss, SkillSACLoss
        >>> spec = Bounded(-1.0, 1.0, shape=(2,))
        >>> loss = SkillSACLoss(
        ...     GaussianSkillActor(2, spec, num_skills=3, in_keys=["velocity"]),
        ...     SkillActionCritic(2, 2, num_skills=3, in_keys=["velocity"]),
        ...     SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=3)),
        ... )
        >>> [key for key in loss.out_keys if key.startswith("loss")]
        ['loss_actor', 'loss_qvalue', 'loss_alpha', 'loss_discriminator']
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        skill: NestedKey = "skill"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    qvalue_network: TensorDictModuleBase
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase,
        objective: SkillObjective,
        *,
        action_spec: TensorSpec | None = None,
        gamma: float = 0.95,
        alpha_init: float = 0.3,
        fixed_alpha: bool = True,
        min_alpha: float | None = None,
        max_alpha: float | None = None,
        target_entropy: float | str = "auto",
        num_qvalue_nets: int = 2,
        loss_function: str = "l2",
        delay_qvalue: bool = True,
        reduction: str | None = None,
        skip_done_states: bool = False,
        deactivate_vmap: bool = False,
    ) -> None:
        owner = type(self).__name__
        reduction = self._check(owner, objective, reduction, gamma, alpha_init)
        super().__init__(
            actor_network,
            qvalue_network,
            action_spec=action_spec,
            num_qvalue_nets=num_qvalue_nets,
            loss_function=loss_function,
            alpha_init=alpha_init,
            min_alpha=min_alpha,
            max_alpha=max_alpha,
            fixed_alpha=fixed_alpha,
            target_entropy=target_entropy,
            delay_qvalue=delay_qvalue,
            reduction=reduction,
            # Not TorchRL's own, which takes a time limit for the end and still meets the NaN.
            skip_done_states=False,
            deactivate_vmap=deactivate_vmap,
            scalar_output_mode="exclude" if reduction == "none" else None,
        )
        self._attach(objective, gamma)
        _ = self.target_entropy  # TorchRL makes this buffer at the first use

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the critics' summed loss, ``td_error`` and each critic's own loss."""
        following = tensordict.copy().set("next", self._what_follows(tensordict))
        target = self._compute_target_v2(following)  # [*B]
        value = self._vmap_qnetworkN0(
            tensordict.select(*self.qvalue_network.in_keys, strict=False),
            self.qvalue_network_params,
        ).get(self.tensor_keys.state_action_value)  # [N, *B, 1] with N critics
        return self._critic_losses(value.squeeze(-1), target, tensordict)
