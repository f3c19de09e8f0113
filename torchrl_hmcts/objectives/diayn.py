"""Skill discovery by discriminability, on TorchRL's discrete soft actor-critic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictParams,
    dispatch,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.objectives import DiscreteSACLoss
from torchrl.objectives.utils import ValueEstimators, distance_loss

from torchrl_hmcts.objectives.discriminator import SkillDiscriminatorLoss, check_reduction


class DIAYNLoss(DiscreteSACLoss):
    r"""Discrete soft actor-critic with twin critics, conditioned on skills, plus a discriminator.

    .. math::

        L_Q(\theta_i) &= \ell\bigl(Q_{\theta_i}(s, z, a),\; r + \gamma (1 - d) V(s', z)\bigr), \quad
        V(s', z) = \sum_a \pi(a \mid s', z) \bigl[\min_i \bar Q_i(s', z, a)
        - \alpha \log \pi(a \mid s', z)\bigr] \\
        L_\pi &= \sum_a \pi(a \mid s, z) \bigl[\alpha \log \pi(a \mid s, z)
        - \min_i Q_i(s, z, a)\bigr] \\
        L_\phi &= -\log q_\phi(z \mid s')

    The reward :math:`r` is the entry ``("next", "reward")``: for DIAYN put a
    :class:`~torchrl_hmcts.transforms.DIAYNReward` on the replay buffer, for another skill objective
    another transform. Being a :class:`torchrl.objectives.DiscreteSACLoss`, it runs with
    ``SoftUpdate``, ``Trainer`` and ``SACTrainer`` unchanged. No loss sends gradients into the
    parameters of another.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy pi(a | s, z), e.g. a
            :class:`~torchrl_hmcts.modules.SkillActor`.
        qvalue_network (TensorDictModuleBase): writes ``action_value`` ``[*B, A]``, e.g. a
            :class:`~torchrl_hmcts.modules.SkillCritic`; copied ``num_qvalue_nets`` times.
        discriminator (TensorDictModuleBase): writes ``skill_logits`` ``[*B, Z]`` from its
            ``in_keys`` in the ``"next"`` part of a transition.
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
        num_qvalue_nets (int): number of critics. Default ``2``, the twins.
        loss_function (str): ``"l2"`` (default), ``"l1"`` or ``"smooth_l1"`` for the critics.
        delay_qvalue (bool): bootstrap from target critics, to be moved by ``SoftUpdate``. Default
            ``True``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.
        skip_done_states (bool): see ``DiscreteSACLoss``. Default ``False``.
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
    class _AcceptedKeys(DiscreteSACLoss._AcceptedKeys):
        skill: NestedKey = "skill"
        skill_logits: NestedKey = "skill_logits"

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
        discriminator: TensorDictModuleBase,
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
        num_qvalue_nets: int = 2,
        loss_function: str = "l2",
        delay_qvalue: bool = True,
        reduction: str = "mean",
        skip_done_states: bool = False,
        deactivate_vmap: bool = False,
    ) -> None:
        check_reduction(type(self).__name__, reduction)
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"DIAYNLoss needs a discount gamma between 0 and 1; got {gamma}.")
        if alpha_init <= 0.0:
            raise ValueError(
                "DIAYNLoss keeps the logarithm of alpha, so alpha_init must be positive; got "
                f"{alpha_init}. Pass e.g. alpha_init=1e-3 for next to no entropy bonus."
            )
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
        self.discriminator_objective = SkillDiscriminatorLoss(discriminator, reduction=reduction)
        # Eagerly: a value estimator built at the first call would add entries to the state dict.
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        diagnostics = [f"qvalue_loss_{i}" for i in range(num_qvalue_nets)]
        diagnostics += ["discriminator_accuracy"]
        if reduction != "none":
            diagnostics += ["alpha", "entropy"]
        losses = ["loss_actor", "loss_qvalue", "loss_alpha", "loss_discriminator"]
        self.out_keys = [*losses, *diagnostics]

    @property
    def discriminator(self) -> TensorDictModuleBase:
        """The discriminator module; its live parameters are those this loss trains."""
        return self.discriminator_objective.discriminator

    @property
    def discriminator_params(self) -> TensorDictParams:
        """The discriminator's parameters."""
        return self.discriminator_objective.discriminator_params

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        keys = SkillDiscriminatorLoss._AcceptedKeys.__dataclass_fields__
        self.discriminator_objective.set_keys(**{k: getattr(self.tensor_keys, k) for k in keys})
        super()._forward_value_estimator_keys(**kwargs)

    _in_keys: Any  # list of keys, or None until it is known

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        # The parent forgets what the critics read of the next state, and nests tuples in tuples.
        critic = [("next", key) for key in self.qvalue_network.in_keys]
        keys = [*self._in_keys, *critic, *self.discriminator_objective.in_keys]
        self._in_keys = sorted({unravel_key(key) for key in keys}, key=str)

    def _make_vmap(self) -> None:
        super()._make_vmap()
        network = getattr(self.qvalue_network, "network", None)
        if getattr(network, "stackable", False):
            # Such a critic runs on the stacked parameters of all copies at once: a vmap or a loop
            # over them takes twice as long.
            self._vmap_qnetworkN0 = self._stacked_qnetwork

    def _stacked_qnetwork(
        self, tensordict: TensorDictBase, params: TensorDictParams
    ) -> TensorDictBase:
        """Returns the action values ``[N, *B, A]`` of N critics."""
        critic = self.qvalue_network
        with params.to_module(critic, preserve_module_state=False):
            value = critic.network(*[tensordict.get(key) for key in critic.in_keys])
        return TensorDict({critic.out_key: value}, batch_size=value.shape[:-1])

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the critics' summed loss, ``td_error`` and each critic's own loss."""
        weights = self._maybe_get_priority_weight(tensordict)
        target = self._compute_target(tensordict)  # [*B]
        action_value = self._vmap_qnetworkN0(
            tensordict.select(*self.qvalue_network.in_keys, strict=False),
            self.qvalue_network_params,
        ).get(self.tensor_keys.action_value)  # [N, *B, A] with N critics
        action = tensordict.get(self.tensor_keys.action)
        if self.action_space == "categorical":
            index = action if action.ndim == action_value.ndim - 1 else action.unsqueeze(-1)
            index = index.expand(*action_value.shape[:-1], 1)
            chosen = action_value.gather(-1, index).squeeze(-1)  # [N, *B]
        else:
            chosen = (action_value * action.to(action_value.dtype)).sum(-1)
        losses = distance_loss(chosen, target.expand_as(chosen), self.loss_function)
        reduced = [
            self._reduce_loss(loss, tensordict=tensordict, weights=weights)
            for loss in losses.unbind(0)
        ]
        metadata = {f"qvalue_loss_{i}": loss.detach() for i, loss in enumerate(reduced)}
        metadata["td_error"] = (chosen.detach() - target).abs().amax(0)
        return torch.stack(reduced).sum(0), metadata

    def discriminator_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the discriminator's cross-entropy and its accuracy."""
        return self.discriminator_objective.discriminator_loss(tensordict)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        loss_qvalue, critics = self.qvalue_loss(tensordict)
        loss_actor, policy = self.actor_loss(tensordict)
        loss_discriminator, skills = self.discriminator_loss(tensordict)
        weights = self._maybe_get_priority_weight(tensordict)
        log_prob = policy["log_prob"]
        loss_alpha = self._reduce_loss(
            self._alpha_loss(log_prob), tensordict=tensordict, weights=weights
        )
        tensordict.set(self.tensor_keys.priority, critics.pop("td_error"))
        out = {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            "loss_alpha": loss_alpha,
            "loss_discriminator": loss_discriminator,
            **critics,
            **skills,
        }
        if self.reduction == "none":
            result = TensorDict(out, batch_size=tensordict.batch_size)
        else:
            out["alpha"] = self._alpha
            out["entropy"] = -log_prob.mean()
            result = TensorDict(out, batch_size=[])
        self._clear_weakrefs(
            tensordict,
            result,
            "actor_network_params",
            "qvalue_network_params",
            "target_actor_network_params",
            "target_qvalue_network_params",
            "discriminator_params",
        )
        return result
