"""Diversity as discriminability: the objective of DIAYN."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F

from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.functional import run_module
from torchrl_hmcts.objectives.skill_objective import SkillObjective, known_num_skills


class SkillDiscriminatorLoss(SkillObjective):
    r"""Skills that can be told apart: a discriminator guesses the skill from the state it led to.

    .. math::

        L(\phi) = -\log q_\phi(z \mid s'), \qquad r = \log q_\phi(z \mid s') - \log p(z)

    ``s'`` stands for the entries ``("next", key)`` with ``key`` in ``discriminator.in_keys``.
    Skills that the prior switches off are never guessed: their logits count as ``-inf``.
    Transitions of such skills (old data) have loss and reward 0.

    Args:
        discriminator (TensorDictModuleBase): reads its ``in_keys`` and writes ``skill_logits``
            ``[*B, Z]``, e.g. a :class:`~torchrl_hmcts.modules.SkillDiscriminator`.
        num_skills (int, optional): number of skills ``Z``. Default: that of the discriminator.
        prior (SkillPrior, sequence of float or Tensor, optional): p(z), ``[Z]``. Default ``None``:
            uniform. See :class:`SkillObjective`.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_discriminator`` and the detached ``discriminator_accuracy`` (fraction
        of transitions whose skill has the highest logit); with ``reduction="none"`` both ``[*B]``.

    Raises:
        ValueError: if the number of skills is unknown or contradicts that of the discriminator or
            prior, or the reduction is unknown.

    Keys (``set_keys``): ``skill`` (int64 ``[*B]``, default ``"skill"``), ``skill_logits``
    (default ``"skill_logits"``), ``priority_weight`` (default ``"priority_weight"``).

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070, algorithm 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss
        >>> objective = SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=4))
        >>> td = TensorDict(skill=torch.zeros(5, dtype=torch.int64),
        ...                 next=TensorDict(displacement=torch.randn(5, 2), batch_size=[5]),
        ...                 batch_size=[5])
        >>> sorted(objective(td).keys())
        ['discriminator_accuracy', 'loss_discriminator']
        >>> objective.reward(td).shape
        torch.Size([5, 1])
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

    def __init__(
        self,
        discriminator: TensorDictModuleBase,
        *,
        num_skills: int | None = None,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        reduction: str = "mean",
    ) -> None:
        num_skills = known_num_skills(type(self).__name__, discriminator, num_skills)
        super().__init__(num_skills, prior=prior, reduction=reduction)
        self.convert_to_functional(discriminator, "discriminator", create_target_params=False)

    @property
    def next_features(self) -> list[NestedKey]:  # type: ignore[override]
        """Entries the discriminator reads of the state after a transition."""
        return self.discriminator.in_keys

    def skill_logits(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the logits ``[*B, Z]`` of q(z | s') for transitions ``[*B]``."""
        logits = run_module(
            self.discriminator,
            self.discriminator_params,
            tensordict.get("next"),
            self.tensor_keys.skill_logits,
        )
        off = self.inactive()
        return logits if off is None else logits.masked_fill(off, -torch.inf)

    def discriminator_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the reduced cross-entropy and ``{"discriminator_accuracy": ...}``."""
        logits = self.skill_logits(tensordict)
        skill = self.skill(tensordict)
        loss = F.cross_entropy(logits.flatten(0, -2), skill.flatten(), reduction="none")
        loss = loss.view(skill.shape)
        off = self.inactive()
        if off is not None:
            loss = loss.masked_fill(off[skill], 0.0)
        hit = (logits.detach().argmax(-1) == skill).to(logits.dtype)
        accuracy = self._average(hit)
        return self._reduce(loss, tensordict), {"discriminator_accuracy": accuracy}

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        loss, diagnostics = self.discriminator_loss(tensordict)
        return {"loss_discriminator": loss, **diagnostics}

    @torch.no_grad()
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        log_q = self.skill_logits(tensordict).log_softmax(-1)
        skill = self.skill(tensordict).unsqueeze(-1)
        reward = log_q.gather(-1, skill) - self.log_prior(log_q)[skill]
        off = self.inactive()
        return reward if off is None else reward.masked_fill(off[skill], 0.0)
