"""Discrete soft actor-critic with twin critics, conditioned on skills, and a skill objective."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictParams,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.objectives import DiscreteSACLoss

from torchrl_hmcts.modules.skill_actor import SkillActor
from torchrl_hmcts.objectives.functional import run_network, takes_weights
from torchrl_hmcts.objectives.skill_objective import SkillObjective
from torchrl_hmcts.objectives.trains_objective import TrainsObjective

_LEAST_LOG_PROB = -10.0  # of a policy prior: no action is out of reach for ever


class DiscreteSkillSACLoss(TrainsObjective, DiscreteSACLoss):
    r"""Discrete soft actor-critic with twin critics, conditioned on skills, and a skill objective.

    .. math::

        L_Q(\theta_i) &= \ell\bigl(Q_{\theta_i}(s, z, a),\; r + \gamma (1 - d) V(s', z)\bigr), \quad
        V(s', z) = \sum_a \pi(a \mid s', z) \bigl[\min_i \bar Q_i(s', z, a)
        - \alpha \log \pi(a \mid s', z)\bigr] \\
        L_\pi &= \sum_a \pi(a \mid s, z) \bigl[\alpha \log \pi(a \mid s, z)
        - \min_i Q_i(s, z, a)\bigr]

    plus the losses of the objective. The reward :math:`r` is the entry ``("next", "reward")``: put
    a :class:`~torchrl_hmcts.transforms.SkillReward` with the same objective on the replay buffer.
    Being a :class:`torchrl.objectives.DiscreteSACLoss`, it runs with ``SoftUpdate``, ``Trainer``
    and ``SACTrainer`` unchanged. No loss sends gradients into the parameters of another.

    With a ``policy_prior`` :math:`\pi_0`, :math:`\log \pi` gives way to :math:`\log \pi - \log
    \pi_0`: the policy is kept near another one instead of near the uniform one, and the best it can
    do is :math:`\pi \propto \pi_0 \exp(Q / \alpha)`.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy pi(a | s, z), e.g. a
            :class:`~torchrl_hmcts.modules.SkillActor`.
        qvalue_network (TensorDictModuleBase): writes ``action_value`` ``[*B, A]``, e.g. a
            :class:`~torchrl_hmcts.modules.SkillCritic`; copied ``num_qvalue_nets`` times.
        objective (SkillObjective): what makes skills different, e.g. a
            :class:`SkillDiscriminatorLoss` or :class:`METRAEncoderLoss`.
        action_space (str or TensorSpec): ``"categorical"``, ``"one-hot"`` or the action spec.
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
        policy_prior (TensorDictModuleBase, optional): :math:`\pi_0`; writes ``logits`` ``[*B, A]``
            from entries that actor or critics read too. It is read as it is, and neither trained
            nor saved here. Use a fixed alpha with it. Default ``None``: the uniform policy.
        num_qvalue_nets (int): number of critics. Default ``2``, the twins.
        loss_function (str): ``"l2"`` (default), ``"l1"`` or ``"smooth_l1"`` for the critics.
        delay_qvalue (bool): bootstrap from target critics, to be moved by ``SoftUpdate``. Default
            ``True``.
        reduction (str, optional): ``"mean"``, ``"sum"`` or ``"none"``. Default: that of the
            objective, which must be the same.
        skip_done_states (bool): ``DiscreteSACLoss`` has it; without effect here: what follows
            a transition is never read where it terminates, and always where it is truncated.
            Default ``False``.
        deactivate_vmap (bool): run critics that cannot be stacked one after the other. Default
            ``False``.

    Returns:
        TensorDict with ``loss_actor``, ``loss_qvalue`` (summed over the critics), ``loss_alpha``,
        the losses of the objective and the detached diagnostics ``qvalue_loss_0``,
        ``qvalue_loss_1`` and so on (each critic's own), those of the objective, ``alpha``,
        ``entropy`` (nats). With ``reduction="none"`` all entries are ``[*B]``; ``alpha`` and
        ``entropy`` are left out.

    Raises:
        TypeError: if the objective is no :class:`SkillObjective`, or the prior writes no logits.
        ValueError: if ``gamma`` is outside [0, 1], ``alpha_init`` is not positive, or the reduction
            is unknown or not that of the objective.

    Keys (``set_keys``): those of ``DiscreteSACLoss``, and ``skill``, which is handed on to the
    objective. Other keys of the objective are set on ``loss.objective``.

    Reference:
        Christodoulou, "Soft Actor-Critic for Discrete Action Settings", 2019, arXiv 1910.07207.
        Policy prior: Teh et al., "Distral: Robust Multitask Reinforcement Learning", 2017, arXiv
        1707.04175.

    Examples:
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import SkillActor, SkillCritic, SkillEncoder
        >>> from torchrl_hmcts.objectives import DiscreteSkillSACLoss, METRAEncoderLoss
        >>> spec = Categorical(4)
        >>> loss = DiscreteSkillSACLoss(
        ...     SkillActor(2, spec, num_skills=3, in_keys=["velocity"]),
        ...     SkillCritic(2, 4, num_skills=3, in_keys=["velocity"]),
        ...     METRAEncoderLoss(SkillEncoder(2, num_skills=3)),
        ...     action_space=spec,
        ... )
        >>> [key for key in loss.out_keys if key.startswith("loss")]
        ['loss_actor', 'loss_qvalue', 'loss_alpha', 'loss_encoder', 'loss_dual']
    """

    @dataclass
    class _AcceptedKeys(DiscreteSACLoss._AcceptedKeys):
        skill: NestedKey = "skill"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    # The parent has a list, with which select_out_keys fails in every class derived from it.
    out_keys = TensorDictModuleBase.out_keys

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
        action_space: str | TensorSpec,
        num_actions: int | None = None,
        gamma: float = 0.95,
        alpha_init: float = 0.3,
        fixed_alpha: bool = True,
        min_alpha: float | None = None,
        max_alpha: float | None = None,
        target_entropy_weight: float = 0.5,
        target_entropy: float | str = "auto",
        policy_prior: TensorDictModuleBase | None = None,
        num_qvalue_nets: int = 2,
        loss_function: str = "l2",
        delay_qvalue: bool = True,
        reduction: str | None = None,
        skip_done_states: bool = False,
        deactivate_vmap: bool = False,
    ) -> None:
        owner = type(self).__name__
        reduction = self._check(owner, objective, reduction, gamma, alpha_init)
        if num_actions is None:
            num_actions = getattr(actor_network, "num_actions", None)
        super().__init__(
            actor_network,
            qvalue_network,
            action_space=action_space,
            num_actions=num_actions,
            num_qvalue_nets=num_qvalue_nets,
            loss_function=loss_function,
            alpha_init=alpha_init,
            min_alpha=min_alpha,
            max_alpha=max_alpha,
            fixed_alpha=fixed_alpha,
            target_entropy_weight=target_entropy_weight,
            target_entropy=target_entropy,
            delay_qvalue=delay_qvalue,
            reduction=reduction,
            skip_done_states=skip_done_states,
            deactivate_vmap=deactivate_vmap,
            # With "none" TorchRL would warn that the scalars alpha and entropy are left out.
            scalar_output_mode="exclude" if reduction == "none" else None,
        )
        self._attach(objective, gamma)
        if policy_prior is not None and "logits" not in getattr(policy_prior, "out_keys", ()):
            raise TypeError(
                f"{owner} reads the entry 'logits' of its policy_prior, which "
                f"{type(policy_prior).__name__} does not write. Use e.g. TensorDictModule(network, "
                f"['observation', 'skill'], ['logits'])."
            )
        self.__dict__["policy_prior"] = policy_prior  # no sub-module: it stays its owner's
        self._set_fast_paths()

    policy_prior: TensorDictModuleBase | None

    def _set_fast_paths(self) -> None:
        # A SkillActor's logits are all that is needed of it; its distribution would cost more than
        # its network.
        actor = self.actor_network
        self._only_logits = isinstance(actor, SkillActor) and takes_weights(actor.module[0])

    def _log_probs(self, tensordict: TensorDictBase) -> Tensor:
        """Returns log pi(. | s, z), ``[*B, A]``, with the gradients of the actor."""
        actor, params = self.actor_network, self.actor_network_params
        if self._only_logits:
            return run_network(actor.module[0], params, tensordict).log_softmax(-1)
        with params.to_module(actor, preserve_module_state=False):
            return actor.get_dist(tensordict.copy()).logits

    def _relative(self, log_prob: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Returns log pi - log pi_0, ``[*B, A]``; log pi without a prior."""
        if self.policy_prior is None:
            return log_prob
        with torch.no_grad():
            logits = self.policy_prior(tensordict.copy()).get("logits")
        return log_prob - logits.log_softmax(-1).clamp_min(_LEAST_LOG_PROB)

    def _action_values(self, tensordict: TensorDictBase, params: TensorDictBase) -> Tensor:
        """Returns Q(s, z, .) of all critics, ``[N, *B, A]``."""
        inputs = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        return self._vmap_qnetworkN0(inputs, params).get(self.tensor_keys.action_value)

    def _compute_target(self, tensordict: TensorDictBase) -> Tensor:
        """Returns r + gamma (1 - d) V(s', z), ``[*B]``, without gradients."""
        with torch.no_grad():
            after = self._what_follows(tensordict)
            log_prob = self._log_probs(after)
            value = self._action_values(after, self.target_qvalue_network_params).amin(0)
            relative = self._relative(log_prob, after)
            value = (log_prob.exp() * (value - self._alpha * relative)).sum(-1, keepdim=True)
            after.set(self.value_estimator.tensor_keys.value, value)
            transitions = tensordict.copy().set("next", after)
            return self.value_estimator.value_estimate(transitions).squeeze(-1)

    def _qvalue_loss(
        self, action_value: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        target = self._compute_target(tensordict)  # [*B]
        action = tensordict.get(self.tensor_keys.action)
        if self.action_space == "categorical":
            index = action if action.ndim == action_value.ndim - 1 else action.unsqueeze(-1)
            index = index.expand(*action_value.shape[:-1], 1)
            chosen = action_value.gather(-1, index).squeeze(-1)  # [N, *B]
        else:
            chosen = (action_value * action.to(action_value.dtype)).sum(-1)
        return self._critic_losses(chosen, target, tensordict)

    def _actor_loss(
        self, min_value: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        log_prob = self._log_probs(tensordict)
        prob = log_prob.exp()
        relative = self._relative(log_prob, tensordict)
        loss = (prob * (self._alpha * relative - min_value)).sum(-1)
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(loss, tensordict=tensordict, weights=weights)
        return loss, {"log_prob": (prob * log_prob).sum(-1).detach()}

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the critics' summed loss, ``td_error`` and each critic's own loss."""
        action_value = self._action_values(tensordict, self.qvalue_network_params)
        return self._qvalue_loss(action_value, tensordict)

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the actor's loss and ``log_prob``, the negative entropy of the policy."""
        action_value = self._action_values(tensordict, self._cached_detached_qvalue_params)
        return self._actor_loss(action_value.amin(0), tensordict)

    def _sac_losses(
        self, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor], Tensor, dict[str, Tensor]]:
        # The critics are asked once for both losses: the actor's needs no gradient through them.
        action_value = self._action_values(tensordict, self.qvalue_network_params)
        critics = self._qvalue_loss(action_value, tensordict)
        return *critics, *self._actor_loss(action_value.detach().amin(0), tensordict)
