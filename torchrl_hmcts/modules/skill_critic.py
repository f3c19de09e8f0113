"""The skill-conditioned critic."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict.utils import NestedKey
from torch import nn

from torchrl_hmcts.modules.skill_mlp import SkillMLP, SkillNetwork, key_list


class SkillCritic(SkillNetwork):
    r"""Action values Q(s, z, .) with shared layers and one head per skill.

    .. math:: Q(s, z, \cdot) = \mathrm{SkillMLP}(s, z) \in \mathbb{R}^A

    Pass one to a loss; TorchRL makes the twin (and the targets) from it.

    Args:
        in_features (int): summed sizes of the entries ``in_keys``.
        num_actions (int): number of actions ``A``.
        num_skills (int): number of skills.
        in_keys (sequence of NestedKey): observation entries ``[*B, f_i]``, concatenated in order.
        skill_key (NestedKey): entry of the skill, int64 ``[*B]``. Default ``"skill"``.
        action_value_key (NestedKey): entry written, ``[*B, A]``. Default ``"action_value"``.
        hidden (sequence of int): widths of the shared layers. Default ``(64, 64)``.
        activation (callable): builds the activations. Default ``torch.nn.ReLU``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillCritic
        >>> critic = SkillCritic(2, num_actions=4, num_skills=3, in_keys=["velocity"])
        >>> td = TensorDict(velocity=torch.randn(5, 2), skill=torch.zeros(5, dtype=torch.int64),
        ...                 batch_size=[5])
        >>> critic(td)["action_value"].shape
        torch.Size([5, 4])
    """

    def __init__(
        self,
        in_features: int,
        num_actions: int,
        num_skills: int,
        *,
        in_keys: Sequence[NestedKey],
        skill_key: NestedKey = "skill",
        action_value_key: NestedKey = "action_value",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
    ) -> None:
        network = SkillMLP(in_features, num_actions, num_skills, hidden, activation)
        keys = [*key_list("SkillCritic", in_keys), skill_key]
        super().__init__(network, keys, action_value_key)
        self.num_actions = num_actions
        self.num_skills = num_skills
