"""The loss that trains a model of options from recorded macro transitions.

Letters: *B batch of the tensordict, K members of the ensemble, D predicted state numbers in all.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F
from torchrl.objectives import distance_loss

from torchrl_hmcts.checks import instance, real_number
from torchrl_hmcts.modules.option_model import OptionModel
from torchrl_hmcts.objectives.loss import Loss


class OptionModelLoss(Loss):
    r"""Regression of an option's outcome on recorded macro transitions, for every member.

    With normalised targets :math:`y` (see :meth:`OptionModel.targets`), predictions
    :math:`f^j` of member j, and the member's share :math:`m_j` of the transition,

    .. math:: L = \frac 1 K \sum_j m_j \big[ \tfrac{c_s}{D} \sum_{d \le D} \ell_s(f^j_d, y_d)
        + c_R\, \ell_R(f^j_R, y_R) + c_k\, \ell_k(f^j_k, y_k)
        + c_p\, \mathrm{BCE}(f^j_p, y_p) \big]

    with :math:`\ell_s` and :math:`\ell_k` Huber's, which favours the likelier of two outcomes at a
    corner, and the square as :math:`\ell_R`: a sparse reward is to be met in the mean.

    Members differ by their first weights and, if the data hold ``bootstrap_mask``, by which
    transitions each of them learns from; store such a mask with the data. An option that the time
    limit cut short has no true outcome: leave such transitions out.

    Args:
        model (OptionModel): what is trained; it stays a sub-module as it is.
        delta_coeff, reward_coeff, duration_coeff, terminated_coeff (float): :math:`c_s, c_R, c_k,
            c_p`, the weights of the parts. Default 1 each.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` over the batch.

    Returns:
        TensorDict with ``loss_delta``, ``loss_reward``, ``loss_duration``, ``loss_terminated``,
        and detached ``delta_error`` (mean absolute error of the normalised changes, over members)
        and ``terminated_accuracy``; with ``reduction="none"`` all ``[*B]``.

    Raises:
        ValueError: if the reduction or a weight is not usable.

    Keys (``set_keys``): ``reward``, ``duration``, ``terminated`` (under ``"next"``; defaults: the
    model's), ``bootstrap_mask`` (``[*B, K]``, any number >= 0, if it is there),
    ``priority_weight``.

    Reference:
        Bootstrapped ensembles: Chua et al. 2018, arXiv 1805.12114; masks: Osband et al., "Deep
        Exploration via Bootstrapped DQN", 2016, arXiv 1602.04621.

    Examples:
        >>> from torchrl_hmcts.modules import OptionModel, SkillMLP
        >>> from torchrl_hmcts.objectives import OptionModelLoss
        >>> model = OptionModel(lambda n: SkillMLP(2, n, num_skills=4), ["position", "option"],
        ...                     {"position": 2}, max_duration=25, num_models=3)
        >>> OptionModelLoss(model).in_keys[2:]
        [('next', 'position'), ('next', 'reward'), ('next', 'duration'), ('next', 'terminated')]
    """

    @dataclass
    class _AcceptedKeys(Loss._AcceptedKeys):
        reward: NestedKey = "reward"
        duration: NestedKey = "duration"
        terminated: NestedKey = "terminated"
        bootstrap_mask: NestedKey = "bootstrap_mask"

    out_keys = [
        *("loss_delta", "loss_reward", "loss_duration", "loss_terminated"),
        *("delta_error", "terminated_accuracy"),
    ]

    model: OptionModel
    delta_coeff: Tensor
    reward_coeff: Tensor
    duration_coeff: Tensor
    terminated_coeff: Tensor

    def __init__(
        self,
        model: OptionModel,
        *,
        delta_coeff: float = 1.0,
        reward_coeff: float = 1.0,
        duration_coeff: float = 1.0,
        terminated_coeff: float = 1.0,
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction)
        owner = type(self).__name__
        instance(owner, "model", model, OptionModel)
        self.model = model
        names = ("delta_coeff", "reward_coeff", "duration_coeff", "terminated_coeff")
        given = (delta_coeff, reward_coeff, duration_coeff, terminated_coeff)
        for name, coeff in zip(names, given, strict=True):
            self.register_coeff_buffer(name, real_number(owner, name, coeff, least=0.0))
        self.set_keys(
            reward=model.reward_key, duration=model.duration_key, terminated=model.terminated_key
        )

    def _reads(self) -> Iterable[NestedKey]:
        keys = self.tensor_keys
        outcome = [*self.model.delta_keys, keys.reward, keys.duration, keys.terminated]
        return [*self.model.in_keys, *(("next", key) for key in outcome)]

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        keys, size = self.tensor_keys, self.model.num_deltas
        outputs = self.model.outputs(tensordict)  # [K, *B, D + 3]
        target = self.model.targets(
            tensordict,
            reward_key=keys.reward,
            duration_key=keys.duration,
            terminated_key=keys.terminated,
        ).expand_as(outputs)
        # Nothing is asked of a terminal state, so it may hold anything: nothing is learned of it.
        # The reward and the duration of the step into it count like all others.
        empty = (target[..., -1:] > 0.5) & ~target.isfinite()
        empty[..., size:] = False
        target = torch.where(empty, outputs.detach(), target)
        mask = tensordict.get(keys.bootstrap_mask, None)
        share = None if mask is None else mask.movedim(-1, 0).to(outputs.dtype)  # [K, *B]

        def distance(part: slice | int, kind: str) -> Tensor:
            return distance_loss(outputs[..., part], target[..., part], kind)

        end, ends = outputs[..., -1], target[..., -1]
        cross_entropy = F.binary_cross_entropy_with_logits(end, ends, reduction="none")
        parts = {
            "loss_delta": distance(slice(size), "smooth_l1").mean(-1) * self.delta_coeff,
            "loss_reward": distance(size, "l2") * self.reward_coeff,
            "loss_duration": distance(size + 1, "smooth_l1") * self.duration_coeff,
            "loss_terminated": self.terminated_coeff * cross_entropy,
        }
        out = {}
        for name, part in parts.items():
            shared = (part if share is None else part * share).mean(0)
            out[name] = self._reduce(shared, tensordict)
        error = (outputs - target).detach()[..., :size].abs().mean(-1).mean(0)
        hit = ((end > 0) == (ends > 0.5)).to(outputs.dtype).mean(0)
        return {
            **out,
            "delta_error": self._average(error),
            "terminated_accuracy": self._average(hit),
        }
