"""Dynamics-aware discovery of skills."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.skill_objective import SkillObjective, known_num_skills


class SkillDynamicsLoss(SkillObjective):
    r"""DADS: skills whose outcome can be predicted, and differs from that of the other skills.

    .. math::

        L(\phi) = -\log q_\phi(s' \mid s, z), \qquad
        r = \log q_\phi(s' \mid s, z) - \log \sum_i p(z_i)\, q_\phi(s' \mid s, z_i)

    with the skill dynamics :math:`q` a Gaussian of the change :math:`s' - s`. Where the paper draws
    skills from the prior for the second term, this sums over all of them, which for discrete skills
    is exact. The reward is at most :math:`-\log p(z)`, as DIAYN's.

    Args:
        dynamics (TensorDictModuleBase): reads its ``in_keys`` of a state and writes ``skill_loc``
            and ``skill_scale``, both ``[*B, Z, D]``: mean and standard deviation of the change of
            its attribute ``target_key`` under each skill; e.g. a
            :class:`~torchrl_hmcts.modules.SkillDynamics`.
        num_skills (int, optional): number of skills ``Z``. Default: that of the dynamics.
        prior (SkillPrior, sequence of float or Tensor, optional): p(z), ``[Z]``. Default ``None``:
            uniform. See :class:`SkillObjective`.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_dynamics`` (nats) and the detached ``dynamics_accuracy`` (fraction
        of transitions for which the skill is the most probable one given the change); with
        ``reduction="none"`` both ``[*B]``.

    Raises:
        ValueError: if the dynamics have no ``target_key``, or the number of skills is unknown or
            contradicts that of the dynamics or prior.

    Keys (``set_keys``): ``skill`` (int64 ``[*B]``, default ``"skill"``), ``skill_loc``,
    ``skill_scale`` (defaults ``"skill_loc"``, ``"skill_scale"``), ``priority_weight`` (default
    ``"priority_weight"``).

    Reference:
        Sharma et al., "Dynamics-Aware Unsupervised Discovery of Skills", 2019, arXiv 1907.01657,
        algorithm 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillDynamics
        >>> from torchrl_hmcts.objectives import SkillDynamicsLoss
        >>> objective = SkillDynamicsLoss(SkillDynamics(2, 2, num_skills=4))
        >>> td = TensorDict(position=torch.randn(5, 2), skill=torch.zeros(5, dtype=torch.int64),
        ...                 next=TensorDict(position=torch.randn(5, 2), batch_size=[5]),
        ...                 batch_size=[5])
        >>> list(objective(td).keys())
        ['loss_dynamics', 'dynamics_accuracy']
        >>> objective.reward(td).shape
        torch.Size([5, 1])
    """

    @dataclass
    class _AcceptedKeys(SkillObjective._AcceptedKeys):
        skill_loc: NestedKey = "skill_loc"
        skill_scale: NestedKey = "skill_scale"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_dynamics", "dynamics_accuracy"]

    dynamics: TensorDictModuleBase
    dynamics_params: TensorDictParams
    target_dynamics_params: TensorDictParams

    def __init__(
        self,
        dynamics: TensorDictModuleBase,
        *,
        num_skills: int | None = None,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        reduction: str = "mean",
    ) -> None:
        num_skills = known_num_skills(type(self).__name__, dynamics, num_skills)
        super().__init__(num_skills, prior=prior, reduction=reduction)
        if not hasattr(dynamics, "target_key"):
            raise ValueError(
                f"SkillDynamicsLoss compares a change with a prediction, but "
                f"{type(dynamics).__name__} does not say of which entry: it has no attribute "
                "target_key. Use SkillDynamics, or set dynamics.target_key='position'."
            )
        self.convert_to_functional(dynamics, "dynamics", create_target_params=False)

    @property
    def root_features(self) -> list[NestedKey]:  # type: ignore[override]
        """Entries read of the state before a transition."""
        return list(dict.fromkeys([*self.dynamics.in_keys, self.dynamics.target_key]))

    @property
    def next_features(self) -> list[NestedKey]:  # type: ignore[override]
        """Entry read of the state after a transition."""
        return [self.dynamics.target_key]

    def log_densities(self, tensordict: TensorDictBase) -> Tensor:
        """Returns log q(s' | s, z) for every skill z, ``[*B, Z]``, for transitions ``[*B]``."""
        root = tensordict.select(*self.dynamics.in_keys)
        with self.dynamics_params.to_module(self.dynamics, preserve_module_state=False):
            root = self.dynamics(root)
        loc = root.get(self.tensor_keys.skill_loc)
        scale = root.get(self.tensor_keys.skill_scale)
        key = self.dynamics.target_key
        change = tensordict.get("next").get(key) - tensordict.get(key)
        error = (change.unsqueeze(-2) - loc) / scale
        constant = 0.5 * math.log(2.0 * math.pi)
        return -(0.5 * error.square() + scale.log() + constant).sum(-1)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        density = self.log_densities(tensordict)
        skill = self.skill(tensordict)
        loss = -density.gather(-1, skill.unsqueeze(-1)).squeeze(-1)
        off = self.inactive()
        if off is not None:
            loss = loss.masked_fill(off[skill], 0.0)
        guess = (density.detach() + self.log_prior(density)).argmax(-1)
        return {
            "loss_dynamics": self._reduce(loss, tensordict),
            "dynamics_accuracy": self._average((guess == skill).to(density.dtype)),
        }

    @torch.no_grad()
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        density = self.log_densities(tensordict)
        skill = self.skill(tensordict).unsqueeze(-1)
        evidence = (density + self.log_prior(density)).logsumexp(-1, keepdim=True)
        reward = density.gather(-1, skill) - evidence
        off = self.inactive()
        return reward if off is None else reward.masked_fill(off[skill], 0.0)
