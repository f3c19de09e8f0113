"""Learning from searches: a policy and a value that imitate what a tree search found."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.nn import functional as F
from torchrl.objectives import LossModule

from torchrl_hmcts.objectives.priority import PriorityWeights
from torchrl_hmcts.objectives.skill_objective import check_reduction

_SMALLEST = 1e-30  # whose logarithm is still a number in float32


class ExpertIterationLoss(PriorityWeights, LossModule):
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
      :math:`\ln G = n \ln \gamma`: the error counts base steps, however far the reward is;
    - ``"cross_entropy"``: :math:`-G \ln v - (1 - G) \ln(1 - v)`, for values that are probabilities.

    Args:
        network (TensorDictModuleBase): reads its ``in_keys`` and writes ``logits`` ``[*B, A]`` and
            ``state_value`` ``[*B, 1]``, the prior and the value of a planner.
        value_coeff (float): :math:`c_v`. Default ``1.0``.
        value_loss (str): ``"l2"`` (default), ``"smooth_l1"``, ``"log"`` or ``"cross_entropy"``.
        reduction (str): ``"mean"`` (default; over all examples, whatever their weights), ``"sum"``
            or ``"none"``.

    Returns:
        TensorDict with ``loss_policy`` and ``loss_value``, and the detached diagnostics
        ``policy_accuracy`` (fraction of examples whose target's best option has the highest logit),
        ``policy_divergence`` (nats above the target's entropy) and ``value_error`` (mean absolute),
        the last three over examples that have a weight. With ``reduction="none"`` all are ``[*B]``.

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
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.objectives import ExpertIterationLoss
        >>> class TwoHeads(torch.nn.Linear):
        ...     def forward(self, x):
        ...         out = super().forward(x)
        ...         return out[..., :3], out[..., 3:]
        >>> net = TensorDictModule(
        ...     TwoHeads(2, 4), in_keys=["observation"], out_keys=["logits", "state_value"])
        >>> loss = ExpertIterationLoss(net)
        >>> td = TensorDict(observation=torch.randn(5, 2), policy_target=torch.full((5, 3), 1 / 3),
        ...                 value_target=torch.rand(5, 1), batch_size=[5])
        >>> [key for key in loss(td).keys() if key.startswith("loss")]
        ['loss_policy', 'loss_value']
    """

    @dataclass
    class _AcceptedKeys:
        logits: NestedKey = "logits"
        state_value: NestedKey = "state_value"
        policy_target: NestedKey = "policy_target"
        policy_weight: NestedKey = "policy_weight"
        value_target: NestedKey = "value_target"
        value_weight: NestedKey = "value_weight"
        action_mask: NestedKey = "action_mask"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = [
        "loss_policy",
        "loss_value",
        "policy_accuracy",
        "policy_divergence",
        "value_error",
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
        self._in_keys: list[NestedKey] | None = None
        super().__init__()
        check_reduction(type(self).__name__, reduction)
        if value_loss not in ("l2", "smooth_l1", "log", "cross_entropy"):
            raise ValueError(
                f"ExpertIterationLoss: value_loss is 'l2', 'smooth_l1', 'log' or 'cross_entropy'; "
                f"got {value_loss!r}."
            )
        if not (math.isfinite(value_coeff) and value_coeff >= 0.0):
            raise ValueError(
                f"ExpertIterationLoss needs value_coeff >= 0 that is finite; got {value_coeff}."
            )
        self.convert_to_functional(network, "network", create_target_params=False)
        self.register_coeff_buffer("value_coeff", value_coeff)
        self.value_loss_name = value_loss
        self.reduction = reduction

    _in_keys: Any  # list of keys, or None until it is known

    def _set_in_keys(self) -> None:
        keys = [unravel_key(key) for key in self.network.in_keys]
        self._in_keys = [*keys, self.tensor_keys.policy_target, self.tensor_keys.value_target]

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that ``forward`` reads."""
        if self._in_keys is None:
            self._set_in_keys()
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        self._in_keys = None

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return both losses and the diagnostics of examples ``[*B]``."""
        keys = self.tensor_keys
        read = tensordict.select(*self.network.in_keys)
        with self.network_params.to_module(self.network, preserve_module_state=False):
            read = self.network(read)
        logits, value = read.get(keys.logits), read.get(keys.state_value)
        mask = tensordict.get(keys.action_mask, None)
        if mask is not None:
            logits = logits.masked_fill(~mask, torch.finfo(logits.dtype).min)
        target = self._required(tensordict, keys.policy_target)
        goal = self._required(tensordict, keys.value_target).reshape(value.shape)
        # 0 for what may not be taken, whose log-probability is a very large number.
        cross_entropy = -torch.where(target > 0, target * logits.log_softmax(-1), 0.0).sum(-1)
        entropy = -torch.special.xlogy(target, target).sum(-1)
        error = self._error(value, goal).reshape(cross_entropy.shape)
        policy_weight = self._weight(tensordict, keys.policy_weight, cross_entropy)
        value_weight = self._weight(tensordict, keys.value_weight, cross_entropy)
        priority = self._maybe_get_priority_weight(tensordict)

        def reduce(loss: Tensor) -> Tensor:
            return self._reduce_loss(loss, tensordict=tensordict, weights=priority)

        hit = (logits.argmax(-1) == target.argmax(-1)).to(logits.dtype)
        off = (value - goal).abs().reshape(cross_entropy.shape)
        diagnostics = {
            "policy_accuracy": self._mean(hit, policy_weight),
            "policy_divergence": self._mean(cross_entropy - entropy, policy_weight),
            "value_error": self._mean(off, value_weight),
        }
        out = TensorDict(
            {
                "loss_policy": reduce(policy_weight * cross_entropy),
                "loss_value": reduce(self.value_coeff * value_weight * error),
                **{key: value.detach() for key, value in diagnostics.items()},
            },
            batch_size=tensordict.batch_size if self.reduction == "none" else [],
        )
        self._clear_weakrefs(tensordict, out, "network_params")
        return out

    def _error(self, value: Tensor, goal: Tensor) -> Tensor:
        name = self.value_loss_name
        if name == "l2":
            return (value - goal) ** 2
        if name == "smooth_l1":
            return F.smooth_l1_loss(value, goal, reduction="none")
        if name == "cross_entropy":
            return F.binary_cross_entropy(value, goal, reduction="none")
        smallest = _SMALLEST
        return F.smooth_l1_loss(
            value.clamp_min(smallest).log(), goal.clamp_min(smallest).log(), reduction="none"
        )

    def _required(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        entry = tensordict.get(key, None)
        if entry is None:
            raise KeyError(
                f"ExpertIterationLoss reads {key!r}, which the examples do not have; they have "
                f"{sorted(map(str, tensordict.keys(True, True)))}. Name their entries with "
                f"set_keys(policy_target=..., value_target=...)."
            )
        return entry

    def _weight(self, tensordict: TensorDictBase, key: NestedKey, like: Tensor) -> Tensor:
        weight = tensordict.get(key, None)
        return torch.ones_like(like) if weight is None else weight.reshape(like.shape)

    def _mean(self, figure: Tensor, weight: Tensor) -> Tensor:
        if self.reduction == "none":
            return figure
        has = (weight > 0).to(figure.dtype)
        return (has * figure).sum() / has.sum().clamp_min(1.0)
