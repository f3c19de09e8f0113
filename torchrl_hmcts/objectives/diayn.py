"""Diversity is all you need: skills that can be told apart, on discrete soft actor-critic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.discovery import SkillDiscriminatorLoss
from torchrl_hmcts.objectives.skill_sac import DiscreteSkillSACLoss


class DIAYNLoss(DiscreteSkillSACLoss):
    r"""Discrete soft actor-critic with twin critics, conditioned on skills, plus a discriminator.

    .. math:: L = L_Q(\theta) + L_\pi + L_\phi, \qquad L_\phi = -\log q_\phi(z \mid s')

    It is a :class:`DiscreteSkillSACLoss` with a :class:`SkillDiscriminatorLoss`: for continuous
    actions give that to a :class:`SkillSACLoss`.

    Args:
        actor_network, qvalue_network: as in :class:`DiscreteSkillSACLoss`.
        discriminator (TensorDictModuleBase): writes ``skill_logits`` ``[*B, Z]`` from its
            ``in_keys`` in the ``"next"`` part of a transition.
        num_skills, prior, reduction: as in :class:`SkillObjective`.
        **sac: other arguments of :class:`DiscreteSkillSACLoss`, of which ``action_space`` is
            needed.

    Returns:
        TensorDict with the entries of :class:`DiscreteSkillSACLoss`, among them
        ``loss_discriminator`` and the detached ``discriminator_accuracy``.

    Raises:
        ValueError, TypeError: as :class:`DiscreteSkillSACLoss`.

    Keys (``set_keys``): those of ``DiscreteSACLoss`` and of :class:`SkillDiscriminatorLoss`
    (``skill``, ``skill_logits``).

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070; Bartley 2023, ch. 4.

    Examples:
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.modules import SkillActor, SkillCritic, SkillDiscriminator
        >>> from torchrl_hmcts.objectives import DIAYNLoss
        >>> loss = DIAYNLoss(
        ...     SkillActor(2, Categorical(4), num_skills=3, in_keys=["velocity"]),
        ...     SkillCritic(2, 4, num_skills=3, in_keys=["velocity"]),
        ...     SkillDiscriminator(2, num_skills=3), action_space="categorical")
        >>> [key for key in loss.out_keys if key.startswith("loss")]
        ['loss_actor', 'loss_qvalue', 'loss_alpha', 'loss_discriminator']
    """

    @dataclass
    class _AcceptedKeys(DiscreteSkillSACLoss._AcceptedKeys):
        skill_logits: NestedKey = "skill_logits"

    objective: SkillDiscriminatorLoss

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase,
        discriminator: TensorDictModuleBase,
        *,
        num_skills: int | None = None,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        reduction: str = "mean",
        **sac: Any,
    ) -> None:
        objective = SkillDiscriminatorLoss(
            discriminator, num_skills=num_skills, prior=prior, reduction=reduction
        )
        super().__init__(actor_network, qvalue_network, objective, **sac)
        self.register_load_state_dict_pre_hook(_rename_discriminator_objective)

    @property
    def discriminator(self) -> TensorDictModuleBase:
        """The discriminator module; its live parameters are those this loss trains."""
        return self.objective.discriminator


def _rename_discriminator_objective(
    module: DIAYNLoss, state_dict: dict[str, Any], prefix: str, *_: Any
) -> None:
    """Reads state dicts of the time when the objective was called discriminator_objective."""
    old = prefix + "discriminator_objective."
    for key in [key for key in state_dict if key.startswith(old)]:
        state_dict[prefix + "objective." + key[len(old) :]] = state_dict.pop(key)
