"""The discriminator that tells skills apart by where they lead."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict.utils import NestedKey
from torch import nn

from torchrl_hmcts.modules.skill_mlp import FeatureMLP, SkillNetwork, check_positive, key_list


class SkillDiscriminator(SkillNetwork):
    r"""Logits of q(z | features of s'), the guess which skill led to a state.

    .. math:: q(z \mid s') = \mathrm{softmax}_z(\mathrm{MLP}(\phi(s')))

    What the features :math:`\phi` are decides what "different skills" means: with the displacement
    since the skill began they are directions, with the position they are places. Losses and reward
    transforms call it on the ``"next"`` part of a transition, so ``in_keys`` are written without
    ``"next"``.

    Args:
        in_features (int): summed sizes of the entries ``in_keys``.
        num_skills (int): number of skills ``Z``.
        in_keys (sequence of NestedKey): entries ``[*B, f_i]``, concatenated in order. Default
            ``["displacement"]``.
        skill_logits_key (NestedKey): entry written, ``[*B, Z]``. Default ``"skill_logits"``.
        hidden (sequence of int): widths of the hidden layers. Default ``()``, a linear classifier:
            it extrapolates to places no skill has reached yet, so two skills that go the same way
            are pushed apart, where a deep one leaves them together.
        activation (callable): builds the activations. Default ``torch.nn.ReLU``.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> discriminator = SkillDiscriminator(2, num_skills=4)
        >>> td = TensorDict(displacement=torch.randn(5, 2), batch_size=[5])
        >>> discriminator(td)["skill_logits"].shape
        torch.Size([5, 4])
    """

    def __init__(
        self,
        in_features: int,
        num_skills: int,
        *,
        in_keys: Sequence[NestedKey] = ("displacement",),
        skill_logits_key: NestedKey = "skill_logits",
        hidden: Sequence[int] = (),
        activation: Callable[[], nn.Module] = nn.ReLU,
    ) -> None:
        check_positive("SkillDiscriminator", in_features=in_features, num_skills=num_skills)
        sizes = [in_features, *hidden, num_skills]
        network = FeatureMLP("SkillDiscriminator", sizes, activation)
        super().__init__(network, key_list("SkillDiscriminator", in_keys), skill_logits_key)
        self.num_skills = num_skills
