"""The loss of a skill discriminator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.nn import functional as F
from torchrl.objectives import LossModule


class SkillDiscriminatorLoss(LossModule):
    r"""Cross-entropy of a discriminator that guesses the skill from the state it led to.

    .. math:: L(\phi) = -\log q_\phi(z \mid s')

    ``s'`` stands for the entries ``("next", key)`` with ``key`` in ``discriminator.in_keys``.

    Args:
        discriminator (TensorDictModuleBase): reads its ``in_keys`` and writes ``skill_logits``
            ``[*B, Z]``, e.g. a :class:`~torchrl_hmcts.modules.SkillDiscriminator`.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_discriminator`` and the detached ``discriminator_accuracy`` (fraction
        of transitions whose skill has the highest logit); with ``reduction="none"`` both ``[*B]``.

    Keys (``set_keys``): ``skill`` (int64 ``[*B]``, default ``"skill"``), ``skill_logits``
    (default ``"skill_logits"``), ``priority_weight`` (default ``"priority_weight"``).

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070, algorithm 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss
        >>> loss = SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=4))
        >>> td = TensorDict(skill=torch.zeros(5, dtype=torch.int64),
        ...                 next=TensorDict(displacement=torch.randn(5, 2), batch_size=[5]),
        ...                 batch_size=[5])
        >>> sorted(loss(td).keys())
        ['discriminator_accuracy', 'loss_discriminator']
    """

    @dataclass
    class _AcceptedKeys:
        skill: NestedKey = "skill"
        skill_logits: NestedKey = "skill_logits"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_discriminator", "discriminator_accuracy"]

    discriminator: TensorDictModuleBase
    discriminator_params: TensorDictParams
    target_discriminator_params: TensorDictParams

    def __init__(self, discriminator: TensorDictModuleBase, *, reduction: str = "mean") -> None:
        self._in_keys: list[NestedKey] | None = None
        super().__init__()
        check_reduction(type(self).__name__, reduction)
        self.convert_to_functional(discriminator, "discriminator", create_target_params=False)
        self.reduction = reduction

    _in_keys: Any  # list of keys, or None until it is known

    def _set_in_keys(self) -> None:
        features = [unravel_key(("next", key)) for key in self.discriminator.in_keys]
        self._in_keys = [self.tensor_keys.skill, *features]

    @property
    def in_keys(self) -> list[NestedKey]:
        if self._in_keys is None:
            self._set_in_keys()
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def skill_logits(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the logits ``[*B, Z]`` of q(z | s') for transitions ``[*B]``."""
        next_td = tensordict.get("next").select(*self.discriminator.in_keys)
        with self.discriminator_params.to_module(self.discriminator, preserve_module_state=False):
            return self.discriminator(next_td).get(self.tensor_keys.skill_logits)

    def discriminator_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the reduced cross-entropy and ``{"discriminator_accuracy": ...}``."""
        logits = self.skill_logits(tensordict)
        skill = tensordict.get(self.tensor_keys.skill)
        loss = F.nll_loss(logits.flatten(0, -2).log_softmax(-1), skill.flatten(), reduction="none")
        hit = (logits.detach().argmax(-1) == skill).to(logits.dtype)
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(loss.view(skill.shape), tensordict=tensordict, weights=weights)
        accuracy = hit if self.reduction == "none" else hit.mean()
        return loss, {"discriminator_accuracy": accuracy}

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        loss, metadata = self.discriminator_loss(tensordict)
        batch_size = tensordict.batch_size if self.reduction == "none" else torch.Size([])
        out = TensorDict({"loss_discriminator": loss, **metadata}, batch_size=batch_size)
        self._clear_weakrefs(tensordict, out, "discriminator_params")
        return out


def check_reduction(owner: str, reduction: str) -> None:
    """Raises ValueError unless the reduction is one TorchRL knows."""
    if reduction not in ("none", "mean", "sum"):
        raise ValueError(
            f"{owner} reduces its losses over the batch by 'mean', 'sum' or 'none'; got "
            f"reduction={reduction!r}."
        )
