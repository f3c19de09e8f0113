"""Skills that travel far in a latent space, each in its own direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.functional import run_module
from torchrl_hmcts.objectives.skill_objective import SkillObjective, known_num_skills


class EncoderObjective(SkillObjective):
    r"""What LSD and METRA share: an encoder, a vector per skill, and travel along it as reward.

    .. math::

        r = (\phi(s') - \phi(s))^\top \bar e_z, \qquad
        \bar e_z = \frac{e_z - p}{1 - \sum_i p_i^2}

    with :math:`e_z` the one-hot skill and :math:`p` the prior. For a uniform prior over n skills
    :math:`\bar e_z` is 1 for the skill and -1 / (n - 1) for the others, the zero-centred vectors of
    the papers; under any prior their mean is zero.

    Args:
        encoder (TensorDictModuleBase): reads its ``in_keys`` and writes ``representation``
            ``[*B, Z]``, e.g. a :class:`~torchrl_hmcts.modules.SkillEncoder`.
        num_skills (int, optional): number of skills ``Z``. Default: that of the encoder.
        prior (SkillPrior, sequence of float or Tensor, optional): p(z), ``[Z]``. Default ``None``:
            uniform. See :class:`SkillObjective`.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Examples:
        >>> from torchrl_hmcts.modules import SkillEncoder
        >>> from torchrl_hmcts.objectives import METRAEncoderLoss
        >>> METRAEncoderLoss(SkillEncoder(2, num_skills=3)).skill_vectors()[0]
        tensor([ 1.0000, -0.5000, -0.5000])
    """

    @dataclass
    class _AcceptedKeys(SkillObjective._AcceptedKeys):
        representation: NestedKey = "representation"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        *,
        num_skills: int | None = None,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        reduction: str = "mean",
    ) -> None:
        num_skills = known_num_skills(type(self).__name__, encoder, num_skills)
        super().__init__(num_skills, prior=prior, reduction=reduction)
        self.convert_to_functional(encoder, "encoder", create_target_params=False)

    @property
    def root_features(self) -> list[NestedKey]:  # type: ignore[override]
        """Entries the encoder reads of the state before a transition."""
        return self.encoder.in_keys

    @property
    def next_features(self) -> list[NestedKey]:  # type: ignore[override]
        """Entries the encoder reads of the state after a transition."""
        return self.encoder.in_keys

    def skill_vectors(self) -> Tensor:
        """Returns the zero-centred vector of each skill under the prior of now, ``[Z, Z]``."""
        p = self.prior.probs().detach()
        spread = 1.0 - p.square().sum()
        # A single skill has nothing to differ from: its vector, and so its reward, is zero.
        return (torch.eye(self.num_skills).to(p) - p) / spread.clamp_min(1e-6)

    def _step(self, tensordict: TensorDictBase) -> Tensor:
        """Returns phi(s') - phi(s), ``[*B, Z]``, for transitions ``[*B]``."""
        after = tensordict.get("next")
        both = TensorDict(
            {
                key: torch.stack((tensordict.get(key), after.get(key)))
                for key in self.encoder.in_keys
            },
            batch_size=(2, *tensordict.batch_size),
        )
        key = self.tensor_keys.representation
        here, there = run_module(self.encoder, self.encoder_params, both, key).unbind(0)
        return there - here

    def _travel(self, step: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Returns the part of steps ``[*B, Z]`` that goes along the vector of the skill, ``[*B]``.

        It is 0 for skills that are switched off.
        """
        skill = self.skill(tensordict)
        travel = (step * self.skill_vectors().to(step)[skill]).sum(-1)
        off = self.inactive()
        return travel if off is None else travel.masked_fill(off[skill], 0.0)

    @torch.no_grad()
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        return self._travel(self._step(tensordict), tensordict).unsqueeze(-1)
