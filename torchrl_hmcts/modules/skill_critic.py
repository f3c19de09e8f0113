"""The skill-conditioned critics, of states and of states with an action."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict.utils import NestedKey
from torch import nn

from torchrl_hmcts.modules.skill_mlp import (
    SkillMLP,
    SkillNetwork,
    check_sizes,
    key_list,
    skill_network,
)
from torchrl_hmcts.modules.skill_spec import Skills, as_skill_spec, number_of


class SkillCritic(SkillNetwork):
    r"""Values Q(s, z, .) of discrete actions with shared layers and one head per skill.

    .. math:: Q(s, z, \cdot) = \mathrm{SkillMLP}(s, z) \in \mathbb{R}^A

    Pass one to a loss; TorchRL makes the twin (and the targets) from it.

    Args:
        num_actions (int): number of actions ``A``.
        in_features, num_skills, in_keys, skill_key: as :class:`SkillActor`'s.
        hidden, activation, network: so are these.
        action_value_key (NestedKey): entry written, ``[*B, A]``. Default ``"action_value"``.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070; heads: Bartley, 2023,
        chapter 4.

    Examples:
        >>> from torchrl_hmcts.modules import SkillCritic
        >>> SkillCritic(2, num_actions=4, num_skills=3, in_keys=["velocity"]).in_keys
        ['velocity', 'skill']
    """

    def __init__(
        self,
        in_features: int,
        num_actions: int,
        num_skills: Skills,
        *,
        in_keys: Sequence[NestedKey],
        skill_key: NestedKey = "skill",
        action_value_key: NestedKey = "action_value",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        network: Callable[..., nn.Module] = SkillMLP,
    ) -> None:
        check_sizes("SkillCritic", in_features=in_features, num_actions=num_actions)
        net = skill_network(network, in_features, num_actions, num_skills, hidden, activation)
        keys = [*key_list("SkillCritic", in_keys), skill_key]
        super().__init__(net, keys, action_value_key)
        self.num_actions = num_actions
        self.skill_spec = as_skill_spec("SkillCritic", num_skills)
        self.num_skills = number_of(self.skill_spec)


class SkillActionCritic(SkillNetwork):
    r"""The value Q(s, z, a) of a continuous action with shared layers and one head per skill.

    .. math:: Q(s, z, a) = \mathrm{SkillMLP}([s; a], z) \in \mathbb{R}

    Args:
        in_features (int): summed sizes of the entries ``in_keys``, without the action.
        action_features (int): size of the action, ``D``.
        num_skills, in_keys, skill_key, hidden, activation, network: as :class:`SkillActor`'s.
        action_key (NestedKey): entry of the action, ``[*B, D]``. Default ``"action"``.
        state_action_value_key (NestedKey): entry written, ``[*B, 1]``.

    Reference:
        As :class:`SkillCritic`.

    Examples:
        >>> from torchrl_hmcts.modules import SkillActionCritic
        >>> SkillActionCritic(3, action_features=2, num_skills=4, in_keys=["velocity"]).in_keys
        ['velocity', 'action', 'skill']
    """

    def __init__(
        self,
        in_features: int,
        action_features: int,
        num_skills: Skills,
        *,
        in_keys: Sequence[NestedKey],
        skill_key: NestedKey = "skill",
        action_key: NestedKey = "action",
        state_action_value_key: NestedKey = "state_action_value",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        network: Callable[..., nn.Module] = SkillMLP,
    ) -> None:
        check_sizes("SkillActionCritic", in_features=in_features, action_features=action_features)
        width = in_features + action_features
        net = skill_network(network, width, 1, num_skills, hidden, activation)
        keys = [*key_list("SkillActionCritic", in_keys), action_key, skill_key]
        super().__init__(net, keys, state_action_value_key)
        self.skill_spec = as_skill_spec("SkillActionCritic", num_skills)
        self.num_skills = number_of(self.skill_spec)
