"""The encoder whose latent space skills spread out in."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_hmcts.modules.skill_mlp import FeatureMLP, SkillNetwork, check_positive, key_list


class SkillEncoder(SkillNetwork):
    r"""Maps what is read of a state to a representation with one dimension per skill.

    .. math:: \phi(s) = \mathrm{MLP}(s) \in \mathbb{R}^Z

    What it reads decides what "far apart" means: with the position, skills travel through the maze.
    Losses call it on both ends of a transition, so ``in_keys`` are written without ``"next"``.

    Args:
        in_features (int): summed sizes of the entries ``in_keys``.
        num_skills (int): number of skills ``Z``.
        in_keys (sequence of NestedKey): entries ``[*B, f_i]``, concatenated in order. Default
            ``["position"]``.
        representation_key (NestedKey): entry written, ``[*B, Z]``. Default ``"representation"``.
        hidden (sequence of int): widths of the hidden layers. Default ``(64, 64)``.
        activation (callable): builds the activations. Default ``torch.nn.ReLU``, of slope at most
            1, as a Lipschitz bound needs.
        linear (callable): builds the linear layers from their two sizes. Default
            ``torch.nn.Linear``; with :class:`SpectralLinear` the encoder is 1-Lipschitz, as LSD
            needs.

    Raises:
        ValueError: if a size is not positive.

    Reference:
        Park et al., "METRA: Scalable Unsupervised RL with Metric-Aware Abstraction", 2023, arXiv
        2310.08887.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillEncoder
        >>> encoder = SkillEncoder(2, num_skills=4)
        >>> encoder(TensorDict(position=torch.randn(5, 2), batch_size=[5]))["representation"].shape
        torch.Size([5, 4])
    """

    def __init__(
        self,
        in_features: int,
        num_skills: int,
        *,
        in_keys: Sequence[NestedKey] = ("position",),
        representation_key: NestedKey = "representation",
        hidden: Sequence[int] = (64, 64),
        activation: Callable[[], nn.Module] = nn.ReLU,
        linear: Callable[[int, int], nn.Module] = nn.Linear,
    ) -> None:
        check_positive("SkillEncoder", in_features=in_features, num_skills=num_skills)
        sizes = [in_features, *hidden, num_skills]
        network = FeatureMLP("SkillEncoder", sizes, activation, linear)
        super().__init__(network, key_list("SkillEncoder", in_keys), representation_key)
        self.num_skills = num_skills


class SpectralLinear(nn.Linear):
    r"""A linear layer whose matrix is divided by its largest singular value.

    .. math:: y = \frac{W}{\sigma(W)} x + b, \qquad \sigma(W) \approx u^\top W v

    so that it is 1-Lipschitz. :math:`u` and :math:`v` come from one step of power iteration per
    call in training mode with gradients; other calls leave :math:`u` as it is.

    Args:
        in_features (int): size of the input.
        out_features (int): size of the output.
        bias (bool): whether there is a bias. Default ``True``.

    Returns:
        From ``forward(x)``: ``[*B, out_features]`` for x ``[*B, in_features]``.

    Reference:
        Miyato et al., "Spectral Normalization for Generative Adversarial Networks", 2018, arXiv
        1802.05957.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.modules import SpectralLinear
        >>> layer = SpectralLinear(3, 5)
        >>> bool(torch.linalg.matrix_norm(layer.normalized_weight(), 2) < 1.01)
        True
    """

    u: Tensor  # [out_features], unit length

    def __init__(self, in_features: int, out_features: int, bias: bool = True) -> None:
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
