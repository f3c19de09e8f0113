"""Learning from searches: a policy and a value that imitate what a tree search found."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F

from torchrl_hmcts.checks import one_of, real_number
from torchrl_hmcts.modules.skill_mlp import entries
from torchrl_hmcts.objectives.loss import Loss, run_module

_VALUE_LOSSES = ("l2", "smooth_l1", "log", "cross_entropy")
_SMALLEST = 1e-30  # whose logarithm is still a number in float32


class ExpertIterationLoss(Loss):
    r"""Cross-entropy to the options a search preferred, and the error of the values it found.

    .. math::

        L_\pi = -w_\pi \sum_a \pi(a)\, \ln p_\theta(a \mid s), \qquad
        L_v = c_v\, w_v\, \ell\bigl(v_\theta(s),\, G\bigr)

    with the policy target :math:`\pi`, the value target :math:`G` and the weights of an example as
    :func:`~torchrl_hmcts.planners.search_examples` writes them. Options that the mask does not
    allow have no share of the softmax. The errors :math:`\ell`:

    - ``"l2"``: :math:`(v - G)^2`;
    - ``"smooth_l1"``: Huber's, with its corner at 1;
    - ``"log"``: Huber's of :math:`\ln v - \ln G`, for positive values. With one reward at the end
      it counts base steps, however far the reward is;
    - ``"cross_entropy"``: :math:`-G \ln v - (1 - G) \ln(1 - v)`, for values that are probabilities.

    Args:
        network (TensorDictModuleBase): reads its ``in_keys`` and writes ``logits`` ``[*B, A]`` and
            ``state_value`` ``[*B, 1]``, the prior and the value of a planner.
        value_coeff (float): :math:`c_v`.
        value_loss (str): ``"l2"`` (default), ``"smooth_l1"``, ``"log"`` or ``"cross_entropy"``.
        reduction (str): ``"mean"`` (default; over all examples, not over their weights), ``"sum"``
            or ``"none"``.

    Returns:
        TensorDict with ``loss_policy`` and ``loss_value``, and detached diagnostics over examples
        that have a weight: ``policy_accuracy`` (fraction whose target's best option has the highest
        logit), ``policy_divergence`` (nats above the target's entropy) and ``value_error`` (mean
        absolute). With ``reduction="none"`` all are ``[*B]``.

    Raises:
        ValueError: if ``value_coeff`` is negative, or a name is none of those above.
        KeyError: at the call, if the examples have no targets.

    Keys (``set_keys``): ``logits``, ``state_value``, ``policy_target`` (float ``[*B, A]``),
    ``policy_weight`` (float ``[*B]``, 1 if absent), ``value_target`` (float ``[*B, 1]``),
    ``value_weight`` (float ``[*B]``, 1 if absent), ``action_mask`` (bool ``[*B, A]``, all True if
    absent), ``priority_weight``; each by its own name by default.

    Reference:
        Anthony, Tian and Barber, "Thinking fast and slow with deep learning and tree search", 2017,
        arXiv 1705.08439; Silver et al., "Mastering the game of Go without human knowledge", 2017.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.objectives import ExpertIterationLoss
        >>> copies = TensorDictModule(lambda x, v: (x, v), ["x", "v"], ["logits", "state_value"])
        >>> td = TensorDict(x=torch.zeros(1, 2), v=torch.zeros(1, 1), batch_size=[1],
        ...                 policy_target=torch.tensor([[1.0, 0.0]]), value_target=torch.ones(1, 1))
        >>> out = ExpertIterationLoss(copies)(td)  # ln 2, and 1 squared
        >>> round(out["loss_policy"].item(), 4), out["loss_value"].item()
        (0.6931, 1.0)
    """

    @dataclass
    class _AcceptedKeys(Loss._AcceptedKeys):
        logits: NestedKey = "logits"
        state_value: NestedKey = "state_value"
        policy_target: NestedKey = "policy_target"
        policy_weight: NestedKey = "policy_weight"
        value_target: NestedKey = "value_target"
        value_weight: NestedKey = "value_weight"
        action_mask: NestedKey = "action_mask"

    out_keys = [
        *("loss_policy", "loss_value"),
        *("policy_accuracy", "policy_divergence", "value_error"),
    ]

    network: TensorDictModuleBase
    network_params: TensorDictParams
    target_network_params: TensorDictParams
    value_coeff: Tensor

    def __init__(
        self,
        network: TensorDictModuleBase,
        *,
        value_coeff: float = 1.0,
        value_loss: Literal["l2", "smooth_l1", "log", "cross_entropy"] = "l2",
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction)
        owner = type(self).__name__
        self.value_loss_name = one_of(owner, "value_loss", value_loss, _VALUE_LOSSES)
        value_coeff = real_number(owner, "value_coeff", value_coeff, least=0.0)
        self.convert_to_functional(network, "network", create_target_params=False)
        self.register_coeff_buffer("value_coeff", value_coeff)

    def _reads(self) -> Iterable[NestedKey]:
        keys = self.tensor_keys
        return [*self.network.in_keys, keys.policy_target, keys.value_target]

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        keys = self.tensor_keys
        read = run_module(self.network, self.network_params, tensordict)
        logits, value = read.get(keys.logits), read.get(keys.state_value)
        mask = tensordict.get(keys.action_mask, None)
        if mask is not None:
            logits = logits.masked_fill(~mask, torch.finfo(logits.dtype).min)
        target, goal = entries(self, tensordict, [keys.policy_target, keys.value_target])
        goal = goal.reshape(value.shape)
        # 0 for what may not be taken, whose log-probability is a very large number.
        cross_entropy = -torch.where(target > 0, target * logits.log_softmax(-1), 0.0).sum(-1)
        entropy = -torch.special.xlogy(target, target).sum(-1)
        error = self._error(value, goal).reshape(cross_entropy.shape)
        policy_weight = self._weight(tensordict, keys.policy_weight, cross_entropy)
        value_weight = self._weight(tensordict, keys.value_weight, cross_entropy)
        hit = (logits.argmax(-1) == target.argmax(-1)).to(logits.dtype)
        off = (value - goal).abs().reshape(cross_entropy.shape)
        return {
            "loss_policy": self._reduce(policy_weight * cross_entropy, tensordict),
            "loss_value": self._reduce(self.value_coeff * value_weight * error, tensordict),
            "policy_accuracy": self._mean(hit, policy_weight),
            "policy_divergence": self._mean(cross_entropy - entropy, policy_weight),
            "value_error": self._mean(off, value_weight),
        }

    def _error(self, value: Tensor, goal: Tensor) -> Tensor:
        if self.value_loss_name == "l2":
            return (value - goal) ** 2
        if self.value_loss_name == "cross_entropy":
            return F.binary_cross_entropy(value, goal, reduction="none")
        if self.value_loss_name == "log":
            value, goal = value.clamp_min(_SMALLEST).log(), goal.clamp_min(_SMALLEST).log()
        return F.smooth_l1_loss(value, goal, reduction="none")

    def _weight(self, tensordict: TensorDictBase, key: NestedKey, like: Tensor) -> Tensor:
        weight = tensordict.get(key, None)
        return torch.ones_like(like) if weight is None else weight.reshape(like.shape)

    def _mean(self, figure: Tensor, weight: Tensor) -> Tensor:
        """Returns the mean over examples that have a weight, detached."""
        figure = figure.detach()
        if self.reduction == "none":
            return figure
        has = (weight > 0).to(figure.dtype)
        return (has * figure).sum() / has.sum().clamp_min(1.0)
