"""The objective of asynchronous actor-learners: n-step returns bootstrapped at a segment's end.

Letters: *B batch of environments, T steps of a segment, F features of a reward (1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import A2CLoss
from torchrl.objectives.utils import ValueEstimators
from torchrl.objectives.value import TD1Estimator

from torchrl_hmcts.checks import one_of, real_number
from torchrl_hmcts.objectives.loss import DISTANCES, REDUCTIONS


def n_step_returns(
    reward: Tensor, discount: Tensor, next_value: Tensor, done: Tensor, terminated: Tensor
) -> Tensor:
    """Returns the targets of :class:`NStepReturn`; all tensors are ``[*B, T, F]``."""
    ends = done.clone()
    ends[..., -1, :] = True
    own = torch.addcmul(reward, discount * (ends & ~terminated), next_value.nan_to_num())
    carry = discount * ~(ends | terminated)
    following = torch.zeros_like(own[..., 0, :])
    returns = []
    for own_t, carry_t in zip(reversed(own.unbind(-2)), reversed(carry.unbind(-2)), strict=True):
        following = torch.addcmul(own_t, carry_t, following)
        returns.append(following)
    returns.reverse()
    return torch.stack(returns, -2)


class NStepReturn(TD1Estimator):
    r"""TorchRL's TD(1), with the critic called only where its value is used.

    .. math::

        G_t = r_t + \gamma^{k_t} \begin{cases}
            0 & \text{after step } t \text{ the episode is terminated} \\
            V(s'_t) & \text{it is truncated, or the segment ends} \\
            G_{t+1} & \text{otherwise}
        \end{cases}

    for steps that take :math:`k_t` base steps, and the advantage :math:`G_t - V(s_t)`, both without
    gradients. TorchRL's ``TD1Estimator`` computes the same from the values of all next states; what
    else that can do (critics with a memory, ``differentiable`` ...) is left to it. In an
    ``OnPolicyTrainer`` it goes where GAE goes: ``A2CTrainer(..., gae=NStepReturn(...))``.

    Args:
        gamma (float): discount per base step.
        value_network (TensorDictModule): the critic; writes ``state_value`` ``[*B, T, 1]``.
        **kwargs: of ``torchrl.objectives.value.TD1Estimator``.

    Keys (``set_keys``): those of ``TD1Estimator``; ``steps_to_next_obs`` is
    ``("next", "duration")`` by default. Without that entry a step takes one base step.

    Reference:
        Mnih et al., "Asynchronous methods for deep reinforcement learning", 2016, arXiv 1602.01783,
        algorithm S3.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> ones = TensorDictModule(lambda x: torch.ones_like(x), ["x"], ["state_value"])
        >>> x, no = torch.rand(3, 1), torch.zeros(3, 1, dtype=torch.bool)
        >>> after = TensorDict(x=x, done=no, terminated=no, reward=torch.tensor([[0.], [0.], [3.]]),
        ...                    duration=torch.tensor([[2], [1], [1]]))
        >>> segment = TensorDict(x=x, next=after, batch_size=[3])
        >>> out = NStepReturn(gamma=0.5, value_network=ones)(segment)
        >>> out["value_target"].flatten().tolist()
        [0.4375, 1.75, 3.5]
    """

    # The accepted keys stay TorchRL's own class: it looks names up in that class alone.
    # A partial in a class will become a method: staticmethod keeps it a plain function.
    default_keys = staticmethod(
        partial(TD1Estimator._AcceptedKeys, steps_to_next_obs=("next", "duration"))
    )

    @torch.no_grad()
    @dispatch
    def forward(
        self,
        tensordict: TensorDictBase,
        *,
        params: TensorDictBase | None = None,
        target_params: TensorDictBase | None = None,
    ) -> TensorDictBase:
        network, keys = self.value_network, self.tensor_keys
        if not self._usual:
            return super().forward(tensordict, params=params, target_params=target_params)
        if not tensordict.ndim:
            raise ValueError(
                "NStepReturn needs a segment, a tensordict whose last dimension is time; this one "
                "has no dimension at all. Stack the steps: torch.stack(steps, -1)."
            )
        names = tensordict.names
        time = names.index("time") if "time" in names else tensordict.ndim - 1
        after = tensordict.get("next")
        reward, done = after.get(keys.reward), after.get(keys.done)
        terminated = after.get(keys.terminated, done)
        ends = done.clone()
        ends.select(time, -1).fill_(True)
        # One value per step, with any further dimensions of the reward.
        used = (ends & ~terminated).reshape(*tensordict.shape, -1).any(-1)
        value = self._values(tensordict, params)
        following = after.select(*network.in_keys, strict=False)
        missing = [key for key in network.in_keys if following.get(key, None) is None]
        following.update(tensordict.select(*missing))
        if target_params is None:
            target_params = params
        if torch.compiler.is_compiling():  # shapes must not depend on the data
            next_value = self._values(following, target_params)
        else:
            next_value = torch.zeros_like(value)
            if used.any():
                next_value[used] = self._values(following[used], target_params)
        discount = torch.as_tensor(self.gamma, device=reward.device).expand_as(reward)
        duration = tensordict.get(keys.steps_to_next_obs, None)
        if duration is not None:
            discount = discount ** duration.view_as(reward)
        inputs = (reward, discount, next_value, done, terminated)
        moved = [entry.movedim(time, -2) for entry in inputs]
        target = n_step_returns(*moved).movedim(-2, time)
        tensordict.set(keys.value, value)
        tensordict.set(keys.advantage, target - value)
        return tensordict.set(keys.value_target, target)

    @property
    def _usual(self) -> bool:
        """Whether nothing is asked for that only TorchRL's own estimator does."""
        asked = self.shifted, self.differentiable, self.average_rewards, self.skip_existing
        read = getattr(self.value_network, "in_keys", ["is_init"])
        memory = any(key == "is_init" or "is_init" in tuple(key) for key in read)
        return not (any(asked) or memory)

    def _values(self, tensordict: TensorDictBase, params: TensorDictBase | None) -> Tensor:
        network = self.value_network
        read = tensordict.select(*network.in_keys)
        if params is None:
            return network(read).get(self.tensor_keys.value)
        with params.to_module(network, preserve_module_state=False):
            return network(read).get(self.tensor_keys.value)


class A3CLoss(A2CLoss):
    r"""Policy gradient with n-step returns, the critic's squared error and an entropy bonus.

    .. math::

        L = -\log \pi(a_t \mid s_t)\,\bigl(G_t - V(s_t)\bigr) + c_v \bigl(G_t - V(s_t)\bigr)^2
            - c_H\, \mathcal{H}\bigl(\pi(\cdot \mid s_t)\bigr)

    with :math:`G_t` of :class:`NStepReturn`, and :math:`G_t - V(s_t)` constant in the first term.
    It is TorchRL's ``A2CLoss`` with :class:`NStepReturn` as its value estimator, built with it. It
    takes segments ``[*B, T]``, within which episodes may end; an ``advantage`` that is already
    there is used as it is.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy.
        critic_network (TensorDictModule): writes ``state_value`` ``[*B, T, 1]``, or the value as
            its first entry of another name.
        gamma (float): discount per base step, in ``(0, 1]``.
        entropy_coeff (float): :math:`c_H \ge 0`, nats to return. Default 0.01, the paper's.
        critic_coeff (float): :math:`c_v > 0`. Default 0.5: half the squared error.
        reduction (str): ``"mean"`` (default), ``"sum"``, which is the paper's accumulation, or
            ``"none"``.
        loss_critic_type (str): ``"l2"`` (default), ``"l1"`` or ``"smooth_l1"``.
        **kwargs: of ``torchrl.objectives.A2CLoss``, e.g. ``separate_losses`` or ``functional``.

    Returns:
        TensorDict with ``loss_objective``, ``loss_critic`` and ``loss_entropy``, and the detached
        ``entropy``, nats. With ``reduction="none"`` the losses are ``[*B, T]``.

    Raises:
        ValueError: if gamma, a coefficient or the reduction is out of range.

    Keys (``set_keys``): those of ``A2CLoss``, and ``duration`` (int64 ``[*B, T, 1]``, base steps,
    default ``("next", "duration")``; 1 if absent).

    Reference:
        Mnih et al., "Asynchronous methods for deep reinforcement learning", 2016, arXiv 1602.01783;
        Bartley, dissertation, 2023, Algorithm 2.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from torchrl_hmcts.objectives import A3CLoss
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(torch.nn.Linear(3, 2), ["observation"], ["logits"]),
        ...     in_keys=["logits"], distribution_class=torch.distributions.Categorical)
        >>> A3CLoss(actor, ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])).in_keys
        ['action', 'observation', ('next', 'reward'), ('next', 'done'), ('next', 'terminated'),
         ('next', 'observation'), ('next', 'duration')]
    """

    @dataclass
    class _AcceptedKeys(A2CLoss._AcceptedKeys):
        duration: NestedKey = ("next", "duration")

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = NStepReturn

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        *,
        gamma: float = 0.99,
        entropy_coeff: float = 0.01,
        critic_coeff: float = 0.5,
        reduction: str = "mean",
        loss_critic_type: str = "l2",
        **kwargs: Any,
    ) -> None:
        gamma = real_number("A3CLoss", "gamma", gamma, above=0.0, most=1.0)
        real_number("A3CLoss", "entropy_coeff", entropy_coeff, least=0.0)
        real_number("A3CLoss", "critic_coeff", critic_coeff, above=0.0)  # the returns rest on it
        one_of("A3CLoss", "reduction", reduction, REDUCTIONS)
        one_of("A3CLoss", "loss_critic_type", loss_critic_type, DISTANCES)
        super().__init__(
            actor_network,
            critic_network,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            reduction=reduction,
            loss_critic_type=loss_critic_type,
            **kwargs,
        )
        self._discount = gamma
        written = [unravel_key(key) for key in critic_network.out_keys]
        if self.tensor_keys.value not in written:
            self.tensor_keys.value = written[0]
        # Built at once: built lazily it would add entries to the state dict of a run under way.
        self.make_value_estimator()

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that ``forward`` reads."""
        keys = self.tensor_keys
        actions = keys.action if isinstance(keys.action, list) else [keys.action]
        read = [*self.actor_network.in_keys, *self.critic_network.in_keys]
        after = [keys.reward, keys.done, keys.terminated, *self.critic_network.in_keys]
        after = [unravel_key(("next", key)) for key in after]
        return list(dict.fromkeys([*actions, *read, *after, unravel_key(keys.duration)]))

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Any:
        """Builds a value estimator, by default :class:`NStepReturn`, with the loss's own gamma."""
        value_type = self.default_value_estimator if value_type is None else value_type
        hyperparams.setdefault("gamma", self._discount)
        if isinstance(value_type, type) and not isinstance(value_type, ValueEstimators):
            hyperparams.setdefault("value_network", self.critic_network)
        out = super().make_value_estimator(value_type, **hyperparams)
        self.value_estimator.set_keys(steps_to_next_obs=self.tensor_keys.duration)
        return out

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        super()._forward_value_estimator_keys(**kwargs)
        if hasattr(self, "_discount"):  # TorchRL's constructor is over
            self.value_estimator.set_keys(steps_to_next_obs=self.tensor_keys.duration)
