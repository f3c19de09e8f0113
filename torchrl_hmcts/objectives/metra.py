"""Metric-aware abstraction."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.encoder import EncoderObjective


class METRAEncoderLoss(EncoderObjective):
    r"""METRA: skills that travel far, in a latent space where one step has at most length 1.

    .. math::

        L(\phi) &= -\bigl[(\phi(s') - \phi(s))^\top \bar e_z + \lambda \,
        \min(\epsilon, 1 - \|\phi(s') - \phi(s)\|^2)\bigr] \\
        L(\lambda) &= \log \lambda \cdot \min(\epsilon, 1 - \|\phi(s') - \phi(s)\|^2), \qquad
        r = (\phi(s') - \phi(s))^\top \bar e_z

    with :math:`\bar e_z` the zero-centred one-hot vector of the skill (:meth:`skill_vectors`). The
    distance in latent space is thus the number of steps between two states, and skills are the
    directions in which one can get furthest from elsewhere. :math:`\lambda` is held fixed in the
    first loss and the encoder in the second; :math:`\log \lambda` is the parameter, so that
    :math:`\lambda` stays positive, and its gradient does not depend on :math:`\lambda`.

    Args:
        encoder (TensorDictModuleBase): reads its ``in_keys`` and writes ``representation``
            ``[*B, Z]``, e.g. a :class:`~torchrl_hmcts.modules.SkillEncoder`.
        num_skills (int, optional): number of skills ``Z``. Default: that of the encoder.
        prior (SkillPrior, sequence of float or Tensor, optional): p(z), ``[Z]``. Default ``None``:
            uniform. See :class:`SkillObjective`.
        dual_init (float): :math:`\lambda` at the start. Default ``30.0``, as the authors'.
        slack (float): :math:`\epsilon`, by how much the constraint may be over-fulfilled before it
            stops to count. Default ``1e-3``, as the authors'.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_encoder``, ``loss_dual`` and the detached ``latent_distance`` (the
        mean of :math:`\|\phi(s') - \phi(s)\|`) and ``dual`` (:math:`\lambda`); with
        ``reduction="none"`` all are ``[*B]``.

    Raises:
        ValueError: if ``dual_init`` is not positive or ``slack`` is negative, or the number of
            skills is unknown or contradicts that of the encoder or prior.

    Keys (``set_keys``): ``skill`` (int64 ``[*B]``, default ``"skill"``), ``representation``
    (default ``"representation"``), ``priority_weight`` (default ``"priority_weight"``).

    Reference:
        Park, Rybkin, Levine, "METRA: Scalable Unsupervised RL with Metric-Aware Abstraction", 2023,
        arXiv 2310.08887, algorithm 1. The authors' code takes the mean of the squares over
        dimensions where the paper, and this loss, take the sum.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillEncoder
        >>> from torchrl_hmcts.objectives import METRAEncoderLoss
        >>> objective = METRAEncoderLoss(SkillEncoder(2, num_skills=4))
        >>> td = TensorDict(position=torch.randn(5, 2), skill=torch.zeros(5, dtype=torch.int64),
        ...                 next=TensorDict(position=torch.randn(5, 2), batch_size=[5]),
        ...                 batch_size=[5])
        >>> list(objective(td).keys())
        ['loss_encoder', 'loss_dual', 'latent_distance', 'dual']
        >>> objective.reward(td).shape
        torch.Size([5, 1])
    """

    out_keys = ["loss_encoder", "loss_dual", "latent_distance", "dual"]

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        *,
        num_skills: int | None = None,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        dual_init: float = 30.0,
        slack: float = 1e-3,
        reduction: str = "mean",
    ) -> None:
        super().__init__(encoder, num_skills=num_skills, prior=prior, reduction=reduction)
        if not 0.0 < dual_init < math.inf:
            raise ValueError(
                "METRAEncoderLoss keeps the logarithm of its dual variable, so dual_init must be "
                f"positive; got {dual_init}."
            )
        if slack < 0.0:
            raise ValueError(f"METRAEncoderLoss needs a slack of at least 0; got {slack}.")
        self.log_dual = torch.nn.Parameter(torch.tensor(math.log(dual_init)))
        self.slack = float(slack)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        step = self._step(tensordict)
        square = step.square().sum(-1)  # [*B]
        room = (1.0 - square).clamp_max(self.slack)
        dual = self.log_dual.detach().exp()
        loss = -self._travel(step, tensordict) - dual * room
        return {
            "loss_encoder": self._reduce(loss, tensordict),
            "loss_dual": self._reduce(self.log_dual * room.detach(), tensordict),
            "latent_distance": self._average(square.detach().sqrt()),
            "dual": self._average(dual.expand(square.shape)),
        }
