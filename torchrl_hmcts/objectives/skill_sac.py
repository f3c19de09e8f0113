"""Soft actor-critic with twin critics, conditioned on skills, beside any skill objective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    dispatch,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import DiscreteSACLoss, SACLoss
from torchrl.objectives.utils import ValueEstimators, distance_loss

from torchrl_hmcts.checks import instance, one_of, real_number, whole_number
from torchrl_hmcts.modules.skill_actor import SkillActor
from torchrl_hmcts.objectives.loss import (
    DISTANCES,
    Reduction,
    run_network,
    takes_weights,
    without_terminal_entries,
)
from torchrl_hmcts.objectives.skill_objective import SkillObjective

Figures = dict[str, Tensor]  # diagnostics by name

_LEAST_LOG_PROB = -10.0  # of a policy prior: no action is out of reach for ever


class _TrainsObjective(Reduction):
    """The common part of both losses: they train a SkillObjective beside actor and critics."""

    objective: SkillObjective
    _value_name: str  # of the key of the critics' output

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase,
        objective: SkillObjective,
        *,
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
        deactivate_vmap: bool = False,
        **spaces: Any,
    ) -> None:
        owner = type(self).__name__
        instance(owner, "objective", objective, SkillObjective)
        if reduction not in (None, objective.reduction):
            raise ValueError(
                f"{owner} was given reduction={reduction!r}, but its {type(objective).__name__} "
                f"has {objective.reduction!r}. Build both with the same."
            )
        real_number(owner, "gamma", gamma, least=0.0, most=1.0)
        real_number(owner, "alpha_init", alpha_init, above=0.0)  # its logarithm is kept
        whole_number(owner, "num_qvalue_nets", num_qvalue_nets, least=1)
        one_of(owner, "loss_function", loss_function, DISTANCES)
        bounds = {"min_alpha": min_alpha, "max_alpha": max_alpha, "target_entropy": target_entropy}
        for name, value in bounds.items():
            if value is not None and value != "auto":
                real_number(owner, name, value)
        super().__init__(
            actor_network,
            qvalue_network,
            alpha_init=alpha_init,
            fixed_alpha=fixed_alpha,
            min_alpha=min_alpha,
            max_alpha=max_alpha,
            target_entropy=target_entropy,
            num_qvalue_nets=num_qvalue_nets,
            loss_function=loss_function,
            delay_qvalue=delay_qvalue,
            reduction=objective.reduction,
            deactivate_vmap=deactivate_vmap,
            # With "none" TorchRL would warn that the scalars alpha and entropy are left out.
            scalar_output_mode="exclude" if objective.reduction == "none" else None,
            **spaces,
        )
        self.objective = objective
        for name in self._shared_keys():
            setattr(self.tensor_keys, name, getattr(objective.tensor_keys, name))
        # Eagerly: a value estimator built at the first call would add entries to the state dict.
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        losses = [key for key in objective.out_keys if key.startswith("loss")]
        diagnostics = [f"qvalue_loss_{i}" for i in range(num_qvalue_nets)]
        diagnostics += [key for key in objective.out_keys if key not in losses]
        if self.reduction != "none":
            diagnostics += ["alpha", "entropy"]
        self.out_keys = ["loss_actor", "loss_qvalue", "loss_alpha", *losses, *diagnostics]
        self._set_in_keys()

    def _shared_keys(self) -> set[str]:
        """Returns the names of keys that the objective reads under the same name."""
        if not hasattr(self, "objective"):  # TorchRL's constructor is at work
            return set()
        own, other = self._AcceptedKeys, self.objective._AcceptedKeys
        return set(own.__dataclass_fields__) & set(other.__dataclass_fields__)

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        shared = {k: getattr(self.tensor_keys, k) for k in self._shared_keys() & set(kwargs)}
        if shared:
            self.objective.set_keys(**shared)
        super()._forward_value_estimator_keys(**kwargs)

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        if not hasattr(self, "objective"):
            return
        # The parent forgets what the critics read of the next state, and nests tuples in tuples.
        action = unravel_key(self.tensor_keys.action)
        critic = [("next", k) for k in self.qvalue_network.in_keys if unravel_key(k) != action]
        keys = [*self.in_keys, *critic, *self.objective.in_keys]
        self._in_keys = sorted({unravel_key(key) for key in keys}, key=str)

    def _make_vmap(self) -> None:
        super()._make_vmap()
        if takes_weights(self.qvalue_network):
            # Such a critic runs on the stacked parameters of all copies at once: a vmap or a loop
            # over them takes twice as long.
            self._vmap_qnetworkN0 = self._stacked_qnetwork

    def _stacked_qnetwork(self, tensordict: TensorDictBase, params: TensorDictBase) -> TensorDict:
        """Returns what N critics write, with N as the first dimension."""
        value = run_network(self.qvalue_network, params, tensordict)
        return TensorDict({self.qvalue_network.out_key: value}, batch_size=value.shape[:-1])

    def _critics(self, tensordict: TensorDictBase, params: TensorDictBase) -> Tensor:
        """Returns what N critics write, ``[N, *B, A]`` or ``[N, *B, 1]``."""
        inputs = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        key = getattr(self.tensor_keys, self._value_name)
        return self._vmap_qnetworkN0(inputs, params).get(key)

    @property
    def alpha(self) -> Tensor:
        """The entropy coefficient, within its bounds, detached."""
        if self.min_log_alpha is not None or self.max_log_alpha is not None:
            self.log_alpha.data.clamp_(self.min_log_alpha, self.max_log_alpha)
        return self.log_alpha.detach().exp()

    def _next_value(self, after: TensorDictBase) -> Tensor:
        """Returns V of the states ``[*B]`` that follow, ``[*B, 1]``."""
        raise NotImplementedError

    @torch.no_grad()
    def _compute_target(self, tensordict: TensorDictBase) -> Tensor:
        """Returns r + gamma (1 - d) V(s', z), ``[*B]``."""
        after = tensordict.get("next")
        terminated = after.get(self.tensor_keys.terminated, None)
        if terminated is None:
            terminated = after.get(self.tensor_keys.done)
        keys = [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
        after = without_terminal_entries(after, terminated, keys)
        after.set(self.value_estimator.tensor_keys.value, self._next_value(after))
        transitions = tensordict.copy().set("next", after)
        return self.value_estimator.value_estimate(transitions).squeeze(-1)

    def _critic_losses(
        self, chosen: Tensor, target: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, Figures]:
        """Returns the summed loss of values ``[N, *B]``, ``td_error`` and each critic's loss."""
        losses = distance_loss(chosen, target.expand_as(chosen), self.loss_function)
        reduced = [self._reduce(loss, tensordict) for loss in losses.unbind(0)]
        metadata = {f"qvalue_loss_{i}": loss.detach() for i, loss in enumerate(reduced)}
        metadata["td_error"] = (chosen.detach() - target).abs().amax(0)
        return torch.stack(reduced).sum(0), metadata

    def _sac_losses(self, tensordict: TensorDictBase) -> tuple[Tensor, Figures, Tensor, Figures]:
        """Returns the critics' loss and diagnostics, and the actor's."""
        return *self.qvalue_loss(tensordict), *self.actor_loss(tensordict)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        loss_qvalue, critics, loss_actor, policy = self._sac_losses(tensordict)
        skills = self.objective.losses(self.objective.without_empty_states(tensordict))
        log_prob = policy["log_prob"]
        tensordict.set(self.tensor_keys.priority, critics.pop("td_error"))
        out = {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            "loss_alpha": self._reduce(self.alpha_loss(log_prob), tensordict),
            **critics,
            **skills,
            "alpha": self.alpha,
            "entropy": -log_prob.mean(),
        }
        return self._output(tensordict, {key: out[key] for key in self.out_keys})


class DiscreteSkillSACLoss(_TrainsObjective, DiscreteSACLoss):
    r"""Discrete soft actor-critic with twin critics, conditioned on skills, and a skill objective.

    .. math::

        L_Q(\theta_i) &= \ell\bigl(Q_{\theta_i}(s, z, a),\; r + \gamma (1 - d) V(s', z)\bigr), \quad
        V(s', z) = \sum_a \pi(a \mid s', z) \bigl[\min_i \bar Q_i(s', z, a)
        - \alpha \log \pi(a \mid s', z)\bigr] \\
        L_\pi &= \sum_a \pi(a \mid s, z) \bigl[\alpha \log \pi(a \mid s, z)
        - \min_i Q_i(s, z, a)\bigr]

    plus the losses of the objective. The reward :math:`r` is the entry ``("next", "reward")``: put
    a :class:`~torchrl_hmcts.transforms.SkillReward` with the same objective on the replay buffer.
    It is a :class:`torchrl.objectives.DiscreteSACLoss`. What follows a transition is never read
    where it terminates, and always where it is truncated.

    With a ``policy_prior`` :math:`\pi_0`, :math:`\log \pi` gives way to :math:`\log \pi - \log
    \pi_0`: the best policy is :math:`\pi \propto \pi_0 \exp(Q / \alpha)`.

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
        gamma (float): discount per base step. Default ``0.95``, a horizon of twenty steps.
        alpha_init (float): entropy coefficient at the start, in units of reward. Default ``0.3``:
            with less, skills settle before they have spread out.
        fixed_alpha (bool): keep alpha instead of tuning it to a target entropy. Default ``True``:
            a run of a few hundred updates is too short to tune it.
        min_alpha, max_alpha (float, optional): bounds of a tuned alpha. Default ``None``.
        target_entropy (float or "auto"): target entropy in nats. Default ``"auto"``.
        target_entropy_weight (float): target entropy as a fraction of ``log A``.
        policy_prior (TensorDictModuleBase, optional): :math:`\pi_0`; writes ``logits`` ``[*B, A]``
            from entries that actor or critics read too. It is its owner's. Use a fixed alpha with
            it. Default: the uniform policy.
        num_qvalue_nets (int): number of critics. Default ``2``, the twins.
        loss_function (str): ``"l2"`` (default), ``"l1"`` or ``"smooth_l1"`` for the critics.
        delay_qvalue (bool): bootstrap from target critics, to be moved by ``SoftUpdate``. Default
            ``True``.
        reduction (str, optional): that of the objective, which is the default.
        deactivate_vmap (bool): run critics that cannot be stacked one after the other.

    Returns:
        TensorDict with ``loss_actor``, ``loss_qvalue`` (summed over the critics), ``loss_alpha``,
        the losses of the objective and detached diagnostics: ``qvalue_loss_0`` and so on, those of
        the objective, ``alpha``, ``entropy`` (nats). With ``reduction="none"`` all are ``[*B]``,
        without the last two.

    Raises:
        TypeError: if the objective is no :class:`SkillObjective`.
        ValueError: if the reduction is not that of the objective, or the prior writes no logits.

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
        >>> loss = DiscreteSkillSACLoss(
        ...     SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"]),
        ...     SkillCritic(2, 4, num_skills=3, in_keys=["velocity"]),
        ...     METRAEncoderLoss(SkillEncoder(2, num_skills=3)), action_space="categorical")
        >>> [key for key in loss.out_keys if key.startswith("loss")]
        ['loss_actor', 'loss_qvalue', 'loss_alpha', 'loss_encoder', 'loss_dual']
    """

    @dataclass
    class _AcceptedKeys(DiscreteSACLoss._AcceptedKeys):
        skill: NestedKey = "skill"

    # The parent has a list, with which select_out_keys fails in every class derived from it.
    out_keys = TensorDictModuleBase.out_keys

    _value_name = "action_value"
    policy_prior: TensorDictModuleBase | None

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase,
        objective: SkillObjective,
        *,
        action_space: str | TensorSpec,
        num_actions: int | None = None,
        target_entropy_weight: float = 0.5,
        policy_prior: TensorDictModuleBase | None = None,
        **sac: Any,
    ) -> None:
        owner = type(self).__name__
        real_number(owner, "target_entropy_weight", target_entropy_weight, least=0.0)
        if num_actions is None:
            num_actions = getattr(actor_network, "num_actions", None)
        else:
            whole_number(owner, "num_actions", num_actions, least=1)
        super().__init__(
            actor_network,
            qvalue_network,
            objective,
            action_space=action_space,
            num_actions=num_actions,
            target_entropy_weight=target_entropy_weight,
            **sac,
        )
        if policy_prior is not None and "logits" not in policy_prior.out_keys:
            raise ValueError(
                f"{owner} reads the entry 'logits' of its policy_prior, which "
                f"{type(policy_prior).__name__} does not write. Use e.g. TensorDictModule(network, "
                f"['observation', 'skill'], ['logits'])."
            )
        self.__dict__["policy_prior"] = policy_prior  # no sub-module: it stays its owner's
        # A SkillActor's logits are all that is needed of it; its distribution would cost more than
        # its network.
        short = isinstance(actor_network, SkillActor) and takes_weights(actor_network.module[0])
        self._only_logits = short

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

    def _next_value(self, after: TensorDictBase) -> Tensor:
        log_prob = self._log_probs(after)
        value = self._critics(after, self.target_qvalue_network_params).amin(0)
        relative = self._relative(log_prob, after)
        return (log_prob.exp() * (value - self.alpha * relative)).sum(-1, keepdim=True)

    def _qvalue_loss(
        self, action_value: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, Figures]:
        target = self._compute_target(tensordict)  # [*B]
        action = tensordict.get(self.tensor_keys.action)
        if self.action_space == "categorical":
            index = action if action.ndim == action_value.ndim - 1 else action.unsqueeze(-1)
            index = index.expand(*action_value.shape[:-1], 1)
            chosen = action_value.gather(-1, index).squeeze(-1)  # [N, *B]
        else:
            chosen = (action_value * action.to(action_value.dtype)).sum(-1)
        return self._critic_losses(chosen, target, tensordict)

    def _actor_loss(self, min_value: Tensor, tensordict: TensorDictBase) -> tuple[Tensor, Figures]:
        log_prob = self._log_probs(tensordict)
        prob = log_prob.exp()
        relative = self._relative(log_prob, tensordict)
        loss = (prob * (self.alpha * relative - min_value)).sum(-1)
        return self._reduce(loss, tensordict), {"log_prob": (prob * log_prob).sum(-1).detach()}

    def _sac_losses(self, tensordict: TensorDictBase) -> tuple[Tensor, Figures, Tensor, Figures]:
        # The critics are asked once for both losses: the actor's needs no gradient through them.
        action_value = self._critics(tensordict, self.qvalue_network_params)
        critics = self._qvalue_loss(action_value, tensordict)
        return *critics, *self._actor_loss(action_value.detach().amin(0), tensordict)


class SkillSACLoss(_TrainsObjective, SACLoss):
    r"""Soft actor-critic for continuous actions, conditioned on skills, and a skill objective.

    .. math::

        L_Q(\theta_i) &= \ell\bigl(Q_{\theta_i}(s, z, a),\; r + \gamma (1 - d) V(s', z)\bigr), \quad
        V(s', z) = \min_i \bar Q_i(s', z, a') - \alpha \log \pi(a' \mid s', z) \\
        L_\pi &= \alpha \log \pi(\tilde a \mid s, z) - \min_i Q_i(s, z, \tilde a)

    with :math:`a'` and the reparametrised :math:`\tilde a` drawn from the policy, plus the losses
    of the objective; for all else see :class:`DiscreteSkillSACLoss`.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy pi(a | s, z), e.g. a
            :class:`~torchrl_hmcts.modules.SkillActor` of a bounded action.
        qvalue_network (TensorDictModuleBase): reads the action too and writes
            ``state_action_value`` ``[*B, 1]``, e.g. a
            :class:`~torchrl_hmcts.modules.SkillActionCritic`; copied ``num_qvalue_nets`` times.
        objective (SkillObjective): what makes skills different.
        action_spec (TensorSpec, optional): of the action ``[D]``. Default: that of the actor.
        **sac: as in :class:`DiscreteSkillSACLoss`; the default ``target_entropy`` is ``-D``.

    Returns:
        TensorDict with the entries of :class:`DiscreteSkillSACLoss`; ``entropy`` is that of the
        drawn actions.

    Keys (``set_keys``): those of ``SACLoss``, and ``skill``, which is handed on to the objective.

    Reference:
        Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", 2018, arXiv 1812.05905.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_hmcts.modules import SkillActionCritic, SkillActor, SkillDiscriminator
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss, SkillSACLoss
        >>> loss = SkillSACLoss(
        ...     SkillActor(2, Bounded(-1.0, 1.0, shape=(2,)), num_skills=3, in_keys=["velocity"]),
        ...     SkillActionCritic(2, 2, num_skills=3, in_keys=["velocity"]),
        ...     SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=3)))
        >>> [key for key in loss.out_keys if key.startswith("loss")]
        ['loss_actor', 'loss_qvalue', 'loss_alpha', 'loss_discriminator']
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        skill: NestedKey = "skill"

    _value_name = "state_action_value"

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase,
        objective: SkillObjective,
        *,
        action_spec: TensorSpec | None = None,
        **sac: Any,
    ) -> None:
        instance("SkillSACLoss", "action_spec", action_spec, TensorSpec, type(None))
        super().__init__(actor_network, qvalue_network, objective, action_spec=action_spec, **sac)
        _ = self.target_entropy  # TorchRL makes this buffer at the first use

    def _next_value(self, after: TensorDictBase) -> Tensor:
        actor, params = self.actor_network, self.actor_network_params
        with params.to_module(actor, preserve_module_state=False):
            action, log_prob = rsample_and_log_prob(actor.get_dist(after.copy()))
        after = after.copy().set(self.tensor_keys.action, action)
        value = self._critics(after, self.target_qvalue_network_params)  # [N, *B, 1]
        return (value - self.alpha * log_prob.unsqueeze(-1)).amin(0)

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, Figures]:
        """Returns the critics' summed loss, ``td_error`` and each critic's own loss."""
        target = self._compute_target(tensordict)  # [*B]
        value = self._critics(tensordict, self.qvalue_network_params)  # [N, *B, 1]
        return self._critic_losses(value.squeeze(-1), target, tensordict)
