"""Diversity as discriminability: the objective of DIAYN."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F

from torchrl_hmcts.objectives.loss import output_of
from torchrl_hmcts.objectives.skill_objective import SkillObjective


class SkillDiscriminatorLoss(SkillObjective):
    r"""Skills that can be told apart: a discriminator guesses the skill from the state it led to.

    .. math::

        L(\phi) = -\log q_\phi(z \mid s'), \qquad r = \log q_\phi(z \mid s') - \log p(z)

    ``s'`` stands for the entries ``("next", key)`` with ``key`` in ``discriminator.in_keys``.
    Skills that the prior switches off are never guessed: their logits count as ``-inf``.

    Args:
        discriminator (TensorDictModuleBase): reads its ``in_keys`` and writes ``skill_logits``
            ``[*B, Z]``, e.g. a :class:`~torchrl_hmcts.modules.SkillDiscriminator`.
        num_skills, prior, reduction: as in :class:`SkillObjective`.

    Returns:
        TensorDict with ``loss_discriminator`` and the detached ``discriminator_accuracy`` (fraction
        of transitions whose skill has the highest logit); with ``reduction="none"`` both ``[*B]``.

    Keys (``set_keys``): those of :class:`SkillObjective` and ``skill_logits`` (default
    ``"skill_logits"``).

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070, algorithm 1.

    Examples:
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss
        >>> SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=4)).in_keys
        ['skill', ('next', 'displacement')]
    """

    @dataclass
    class _AcceptedKeys(SkillObjective._AcceptedKeys):
        skill_logits: NestedKey = "skill_logits"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_discriminator", "discriminator_accuracy"]
    root_features = ()

    discriminator: TensorDictModuleBase
    discriminator_params: TensorDictParams
    target_discriminator_params: TensorDictParams

    def __init__(self, discriminator: TensorDictModuleBase, **settings: Any) -> None:
        super().__init__(discriminator=discriminator, **settings)
        self.next_features = discriminator.in_keys

    def skill_logits(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the logits ``[*B, Z]`` of q(z | s') for transitions ``[*B]``."""
        module, params = self.discriminator, self.discriminator_params
        logits = output_of(module, params, tensordict.get("next"), self.tensor_keys.skill_logits)
        off = self.inactive()
        return logits if off is None else logits.masked_fill(off, -torch.inf)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        logits, skill = self.skill_logits(tensordict), self.skill(tensordict)
        loss = F.cross_entropy(logits.flatten(0, -2), skill.flatten(), reduction="none")
        loss = self._of_active(loss.view(skill.shape), skill)
        hit = (logits.detach().argmax(-1) == skill).to(logits.dtype)
        return {
            "loss_discriminator": self._reduce(loss, tensordict),
            "discriminator_accuracy": self._average(hit),
        }

    @torch.no_grad()
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        log_q = self.skill_logits(tensordict).log_softmax(-1)
        skill = self.skill(tensordict).unsqueeze(-1)
        return self._of_active(log_q.gather(-1, skill) - self.log_prior(log_q)[skill], skill)
