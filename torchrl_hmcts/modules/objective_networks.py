"""Networks of the skill objectives: what tells skills apart, embeds states, predicts changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_hmcts.checks import real_number
from torchrl_hmcts.modules.skill_mlp import (
    FeatureMLP,
    SkillMLP,
    SkillNetwork,
    check_sizes,
    entries,
    key_list,
    skill_network,
)
from torchrl_hmcts.modules.skill_spec import Skills, as_skill_spec, needs_number, number_of


class SkillDiscriminator(SkillNetwork):
    r"""Logits of q(z | features of s'), the guess which skill led to a state.

    .. math:: q(z \mid s') = \mathrm{softmax}_z(\mathrm{MLP}(\phi(s')))

    The features :math:`\phi` decide what "different skills" means: with the displacement since the
    skill began they are directions, with the position places. Losses and rewards call it on the
    ``"next"`` part of a transition, so ``in_keys`` are written without ``"next"``.

    Args:
        in_features (int): summed sizes of the entries ``in_keys``.
        num_skills (int or TensorSpec): number of skills ``Z``.
        in_keys (sequence of NestedKey): entries ``[*B, f_i]``, concatenated in order.
        skill_logits_key (NestedKey): entry written, ``[*B, Z]``. Default ``"skill_logits"``.
        hidden (sequence of int): widths of the hidden layers. Default ``()``, a linear classifier:
            it extrapolates to places no skill has reached yet, so two skills that go the same way
            are pushed apart, where a deep one leaves them together.
        activation (callable): builds the activations. Default ``torch.nn.ReLU``.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070.

    Examples:
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
        num_skills: Skills,
        *,
        in_keys: Sequence[NestedKey] = ("displacement",),
        skill_logits_key: NestedKey = "skill_logits",
        hidden: Sequence[int] = (),
        activation: Callable[[], nn.Module] = nn.ReLU,
    ) -> None:
        check_sizes("SkillDiscriminator", in_features=in_features)
        num_skills = needs_number("SkillDiscriminator", num_skills)
        sizes = [in_features, *hidden, num_skills]
        network = FeatureMLP("SkillDiscriminator", sizes, activation)
        super().__init__(network, in_keys, skill_logits_key)
        self.num_skills = num_skills


class SkillEncoder(SkillNetwork):
    r"""Maps entries of a state to a representation with one dimension per skill.

    .. math:: \phi(s) = \mathrm{MLP}(s) \in \mathbb{R}^Z

    or, where skills are vectors, with their dimensions. Its entries decide what "far apart" means:
    with the position, skills travel through the maze. ``in_keys`` are written without ``"next"``.

    Args:
        in_features (int): as :class:`SkillDiscriminator`'s.
        num_skills (int or TensorSpec): number of skills ``Z``, or the spec of one that is a vector.
        in_keys (sequence of NestedKey): entries ``[*B, f_i]``, concatenated in order.
        representation_key (NestedKey): entry written, ``[*B, Z]``. Default ``"representation"``.
        hidden (sequence of int): widths of the hidden layers. Default ``(64, 64)``.
        activation (callable): builds the activations. Default ``torch.nn.ReLU``, of slope at most
            1, as a Lipschitz bound needs.
        linear (callable): builds the linear layers from their two sizes. Default
            ``torch.nn.Linear``; with :class:`SpectralLinear` the encoder is 1-Lipschitz, as LSD
            needs.

    Reference:
        Park et al., "METRA: Scalable Unsupervised RL with Metric-Aware Abstraction", 2023, arXiv
        2310.08887.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillEncoder
        >>> encoder = SkillEncoder(2, num_skills=4)
        >>> encoder(TensorDict(position=torch.randn(5, 2), batch_size=[5]))["representation"].shape
        torch.Size([5, 4])
    """

    def __init__(
        self,
        in_features: int,
        num_skills: Skills,
        *,
        in_keys: Sequence[NestedKey] = ("position",),
        representation_key: NestedKey = "representation",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        linear: Callable[[int, int], nn.Module] = nn.Linear,
    ) -> None:
        check_sizes("SkillEncoder", in_features=in_features)
        spec = as_skill_spec("SkillEncoder", num_skills)
        sizes = [in_features, *hidden, number_of(spec) or spec.shape[-1]]
        network = FeatureMLP("SkillEncoder", sizes, activation, linear)
        super().__init__(network, in_keys, representation_key)
        self.num_skills, self.skill_spec = number_of(spec), spec


class SpectralLinear(nn.Linear):
    r"""A linear layer whose matrix is divided by its largest singular value.

    .. math:: y = \frac{W}{\sigma(W)} x + b, \qquad \sigma(W) \approx u^\top W v

    so that it is 1-Lipschitz. :math:`u` and :math:`v` come from one step of power iteration per
    call in training mode with gradients; other calls leave :math:`u` as it is.

    Args:
        in_features, out_features (int): sizes of input and output.
        bias (bool): whether there is a bias. Default ``True``.

    Returns:
        From ``forward(x)``: ``[*B, out_features]`` for x ``[*B, in_features]``.

    Reference:
        Miyato et al., "Spectral Normalization for Generative Adversarial Networks", 2018, arXiv
        1802.05957.

    Examples:
        >>> from torchrl_hmcts.modules import SpectralLinear
        >>> layer = SpectralLinear(3, 5)
        >>> bool(torch.linalg.matrix_norm(layer.normalized_weight(), 2) < 1.01)
        True
    """

    u: Tensor  # [out_features], unit length

    def __init__(self, in_features: int, out_features: int, bias: bool = True) -> None:
        check_sizes("SpectralLinear", in_features=in_features, out_features=out_features)
        super().__init__(in_features, out_features, bias)
        with torch.no_grad():
            u = torch.linalg.svd(self.weight).U[:, 0].contiguous()
        self.register_buffer("u", u)

    def normalized_weight(self) -> Tensor:
        """Returns W / sigma(W), ``[out_features, in_features]``."""
        weight, u = self.weight, self.u
        learning = self.training and torch.is_grad_enabled()
        with torch.no_grad():
            v = F.normalize(weight.t() @ u, dim=0)
            u = F.normalize(weight @ v, dim=0)
            if learning:
                self.u.copy_(u)
        return weight / torch.dot(u, weight @ v)

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x, self.normalized_weight(), self.bias)


class SkillDynamics(TensorDictModuleBase):
    r"""Predicts the change of a state under every skill, as a Gaussian.

    .. math::

        q(s' \mid s, z) = \mathcal{N}\bigl(s' - s;\; \mu_z(s),\, \mathrm{diag}(\sigma^2)\bigr),
        \qquad \mu_z(s) = \mathrm{SkillMLP}(s, z)

    It writes mean and standard deviation for all skills at once, since the reward compares them; of
    skills that are vectors for the one that it reads.

    Args:
        in_features (int): as :class:`SkillDiscriminator`'s.
        num_skills (int or TensorSpec): number of skills ``Z``, or the spec of one that is a vector.
        target_features (int): size ``D`` of the entry whose change is predicted.
        in_keys (sequence of NestedKey): entries ``[*B, f_i]`` the prediction depends on.
        target_key (NestedKey): entry ``[*B, D]`` whose change is predicted. Default ``"position"``.
        std (float): standard deviation :math:`\sigma` of each dimension, in units of the target; at
            the start, if it is learned. Default ``0.1``: about what a body moves in a base step.
        learned_std (bool): learn one :math:`\sigma` per dimension instead of keeping ``std``.
        min_std (float): lower bound of a learned one. Default ``1e-3``: a target that never
            changes must not get an infinite density.
        loc_key, scale_key (NestedKey): entries written, both ``[*B, Z, D]``, or ``[*B, D]``.
            Defaults ``"skill_loc"`` and ``"skill_scale"``.
        skill_key (NestedKey): entry of a skill that is a vector. Default ``"skill"``.
        hidden, activation, network: as :class:`SkillActor`'s; the network needs ``all_skills``.

    Raises:
        ValueError: if a size is not positive, or not ``0 < min_std < std``.

    Reference:
        Sharma et al., "Dynamics-Aware Unsupervised Discovery of Skills", 2019, arXiv 1907.01657
        (with a mixture of experts of fixed variance on normalised changes).

    Examples:
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
        num_skills: Skills,
        *,
        in_keys: Sequence[NestedKey] = ("position",),
        target_key: NestedKey = "position",
        std: float = 0.1,
        learned_std: bool = True,
        min_std: float = 1e-3,
        loc_key: NestedKey = "skill_loc",
        scale_key: NestedKey = "skill_scale",
        skill_key: NestedKey = "skill",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        network: Callable[..., nn.Module] = SkillMLP,
    ) -> None:
        super().__init__()
        check_sizes("SkillDynamics", in_features=in_features, target_features=target_features)
        self.min_std = real_number("SkillDynamics", "min_std", min_std, above=0.0)
        above_min = real_number("SkillDynamics", "std", std, above=self.min_std) - self.min_std
        net = skill_network(network, in_features, target_features, num_skills, hidden, activation)
        self.network: Any = net
        self.skill_spec = as_skill_spec("SkillDynamics", num_skills)
        self.num_skills = number_of(self.skill_spec)
        self.target_key = unravel_key(target_key)
        self.in_keys = key_list("SkillDynamics", in_keys)
        if self.num_skills is None:
            self.in_keys.append(unravel_key(skill_key))
        self.out_keys = [unravel_key(loc_key), unravel_key(scale_key)]
        log_std = torch.full((target_features,), math.log(above_min))
        if learned_std:
            self.log_std = nn.Parameter(log_std)
        else:
            self.register_buffer("log_std", log_std)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes mean and standard deviation of the change; see the class."""
        run = self.network if self.num_skills is None else self.network.all_skills
        loc = run(*entries(self, tensordict, self.in_keys))
        scale = (self.min_std + self.log_std.exp()).expand_as(loc)
        tensordict.set(self.out_keys[0], loc)
        return tensordict.set(self.out_keys[1], scale)
