"""A model of where each skill leads in one step."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from torchrl_hmcts.modules.skill_mlp import SkillMLP, check_positive, entries, key_list


class SkillDynamics(TensorDictModuleBase):
    r"""Predicts the change of a state under every skill, as a Gaussian.

    .. math::

        q(s' \mid s, z) = \mathcal{N}\bigl(s' - s;\; \mu_z(s),\, \mathrm{diag}(\sigma^2)\bigr),
        \qquad \mu_z(s) = \mathrm{SkillMLP}(s, z)

    It writes mean and standard deviation for all skills at once, since the reward compares them.

    Args:
        in_features (int): summed sizes of the entries ``in_keys``.
        target_features (int): size ``D`` of the entry whose change is predicted.
        num_skills (int): number of skills ``Z``.
        in_keys (sequence of NestedKey): entries ``[*B, f_i]`` the prediction depends on. Default
            ``["position"]``.
        target_key (NestedKey): entry ``[*B, D]`` whose change is predicted. Default ``"position"``.
        std (float): standard deviation :math:`\sigma` of each dimension, in units of the target; at
            the start, if it is learned. Default ``0.1``: about what a body moves in a base step.
        learned_std (bool): learn one :math:`\sigma` per dimension instead of keeping ``std``.
            Default ``True``.
        min_std (float): lower bound of a learned one. Default ``1e-3``: a target that never
            changes must not get an infinite density.
        loc_key, scale_key (NestedKey): entries written, both ``[*B, Z, D]``. Defaults
            ``"skill_loc"`` and ``"skill_scale"``.
        hidden (sequence of int): widths of the shared layers. Default ``(64, 64)``.
        activation (callable): builds the activations. Default ``torch.nn.ReLU``.
        network (callable): builds the network, with the signature and the method ``all_skills`` of
            :class:`SkillMLP`. Default :class:`SkillMLP`.

    Raises:
        ValueError: if a size or standard deviation is not positive.

    Reference:
        Sharma et al., "Dynamics-Aware Unsupervised Discovery of Skills", 2019, arXiv 1907.01657
        (with a mixture of experts of fixed variance on normalised changes).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillDynamics
        >>> dynamics = SkillDynamics(2, 2, num_skills=4)
        >>> td = dynamics(TensorDict(position=torch.randn(5, 2), batch_size=[5]))
        >>> td["skill_loc"].shape, td["skill_scale"].shape
        (torch.Size([5, 4, 2]), torch.Size([5, 4, 2]))
    """

    log_std: Tensor  # [D], logarithm of what the standard deviation is above min_std

    def __init__(
        self,
        in_features: int,
        target_features: int,
        num_skills: int,
        *,
        in_keys: Sequence[NestedKey] = ("position",),
        target_key: NestedKey = "position",
        std: float = 0.1,
        learned_std: bool = True,
        min_std: float = 1e-3,
        loc_key: NestedKey = "skill_loc",
        scale_key: NestedKey = "skill_scale",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        network: Callable[..., nn.Module] = SkillMLP,
    ) -> None:
        super().__init__()
        check_positive("SkillDynamics", in_features=in_features, target_features=target_features)
        if not 0.0 < min_std < std < math.inf:
            raise ValueError(
                "SkillDynamics needs 0 < min_std < std, standard deviations in units of the "
                f"target; got min_std={min_std} and std={std}."
            )
        self.network: Any = network(in_features, target_features, num_skills, hidden, activation)
        self.num_skills = num_skills
        self.target_key = unravel_key(target_key)
        self.in_keys = key_list("SkillDynamics", in_keys)
        self.out_keys = [unravel_key(loc_key), unravel_key(scale_key)]
        log_std = torch.full((target_features,), math.log(std - min_std))
        if learned_std:
            self.log_std = nn.Parameter(log_std)
        else:
            self.register_buffer("log_std", log_std)
        self.min_std = float(min_std)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes mean and standard deviation of the change under every skill, ``[*B, Z, D]``."""
        loc = self.network.all_skills(*entries(self, tensordict, self.in_keys))
        scale = (self.min_std + self.log_std.exp()).expand_as(loc)
        tensordict.set(self.out_keys[0], loc)
        return tensordict.set(self.out_keys[1], scale)
