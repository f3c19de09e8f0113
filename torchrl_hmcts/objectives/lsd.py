"""Lipschitz-constrained skill discovery."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.utils.parametrize import is_parametrized

from torchrl_hmcts.modules.skill_encoder import SpectralLinear
from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.encoder import EncoderObjective


class LSDEncoderLoss(EncoderObjective):
    r"""LSD: skills that travel far, measured by an encoder that may not stretch distances.

    .. math::

        L(\phi) = -r, \qquad r = (\phi(s') - \phi(s))^\top \bar e_z, \qquad
        \|\phi(x) - \phi(y)\| \le \|x - y\|

    with :math:`\bar e_z` the zero-centred one-hot vector of the skill
    (:meth:`skill_vectors`). Summed over an episode the reward is
    :math:`(\phi(s_T) - \phi(s_0))^\top \bar e_z`. Spectral normalisation keeps the encoder
    1-Lipschitz, so only moving far in the units of what it reads gives a large reward; scale it by
    the ``intrinsic_coeff`` of :class:`~torchrl_hmcts.transforms.SkillReward`.

    Args:
        encoder (TensorDictModuleBase): reads its ``in_keys`` and writes ``representation``
            ``[*B, Z]``; 1-Lipschitz, e.g. ``SkillEncoder(..., linear=SpectralLinear)``.
        num_skills (int, optional): number of skills ``Z``. Default: that of the encoder.
        prior (SkillPrior, sequence of float or Tensor, optional): p(z), ``[Z]``. Default ``None``:
            uniform. See :class:`SkillObjective`.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_encoder`` and the detached ``latent_distance``, the mean of
        :math:`\|\phi(s') - \phi(s)\|`; with ``reduction="none"`` both ``[*B]``.

    Raises:
        ValueError: if a linear layer of the encoder is not normalised, or the number of skills is
            unknown or contradicts that of the encoder or prior.

    Keys (``set_keys``): ``skill`` (int64 ``[*B]``, default ``"skill"``), ``representation``
    (default ``"representation"``), ``priority_weight`` (default ``"priority_weight"``).

    Reference:
        Park et al., "Lipschitz-constrained Unsupervised Skill Discovery", 2022, arXiv 2202.00914.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillEncoder, SpectralLinear
        >>> from torchrl_hmcts.objectives import LSDEncoderLoss
        >>> objective = LSDEncoderLoss(SkillEncoder(2, num_skills=4, linear=SpectralLinear))
        >>> td = TensorDict(position=torch.randn(5, 2), skill=torch.zeros(5, dtype=torch.int64),
        ...                 next=TensorDict(position=torch.randn(5, 2), batch_size=[5]),
        ...                 batch_size=[5])
        >>> list(objective(td).keys())
        ['loss_encoder', 'latent_distance']
        >>> objective.reward(td).shape
        torch.Size([5, 1])
    """

    out_keys = ["loss_encoder", "latent_distance"]

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        *,
        num_skills: int | None = None,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        reduction: str = "mean",
    ) -> None:
        for name, layer in encoder.named_modules():
            plain = isinstance(layer, torch.nn.Linear) and not isinstance(layer, SpectralLinear)
            if plain and not is_parametrized(layer, "weight"):
                raise ValueError(
                    "LSDEncoderLoss needs an encoder that cannot stretch distances, but its layer "
                    f"{name!r} is a plain Linear, whose weights would grow for ever. Pass "
                    "SkillEncoder(..., linear=SpectralLinear)."
                )
        super().__init__(encoder, num_skills=num_skills, prior=prior, reduction=reduction)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        step = self._step(tensordict)
        return {
            "loss_encoder": self._reduce(-self._travel(step, tensordict), tensordict),
            "latent_distance": self._average(step.norm(dim=-1)),
        }
