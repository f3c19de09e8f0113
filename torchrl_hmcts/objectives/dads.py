"""Dynamics-aware discovery of skills."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.objectives.loss import run_module
from torchrl_hmcts.objectives.skill_objective import SkillObjective


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
        num_skills, prior, reduction: as in :class:`SkillObjective`.

    Returns:
        TensorDict with ``loss_dynamics`` (nats) and the detached ``dynamics_accuracy`` (fraction
        of transitions for which the skill is the most probable one given the change); with
        ``reduction="none"`` both ``[*B]``.

    Raises:
        AttributeError: if the dynamics have no ``target_key``.

    Keys (``set_keys``): those of :class:`SkillObjective`, ``skill_loc`` and ``skill_scale``
    (defaults ``"skill_loc"``, ``"skill_scale"``).

    Reference:
        Sharma et al., "Dynamics-Aware Unsupervised Discovery of Skills", 2019, arXiv 1907.01657,
        algorithm 1.

    Examples:
        >>> from torchrl_hmcts.modules import SkillDynamics
        >>> from torchrl_hmcts.objectives import SkillDynamicsLoss
        >>> SkillDynamicsLoss(SkillDynamics(2, 2, num_skills=4)).in_keys
        ['skill', 'position', ('next', 'position')]
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

    def __init__(self, dynamics: TensorDictModuleBase, **settings: Any) -> None:
        super().__init__(dynamics=dynamics, **settings)
        self.next_features = [dynamics.target_key]
        self.root_features = list(dict.fromkeys([*dynamics.in_keys, dynamics.target_key]))

    def log_densities(self, tensordict: TensorDictBase) -> Tensor:
        """Returns log q(s' | s, z) for every skill z, ``[*B, Z]``, for transitions ``[*B]``."""
        root = run_module(self.dynamics, self.dynamics_params, tensordict)
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
        guess = (density.detach() + self.log_prior(density)).argmax(-1)
        return {
            "loss_dynamics": self._reduce(self._of_active(loss, skill), tensordict),
            "dynamics_accuracy": self._average((guess == skill).to(density.dtype)),
        }

    @torch.no_grad()
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        density = self.log_densities(tensordict)
        skill = self.skill(tensordict).unsqueeze(-1)
        evidence = (density + self.log_prior(density)).logsumexp(-1, keepdim=True)
        return self._of_active(density.gather(-1, skill) - evidence, skill)
