"""The loss of a learned distribution over skills."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.checks import instance, real_number
from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.loss import Loss


class SkillPriorLoss(Loss):
    r"""Moves p(z) to the skills whose intrinsic reward is high, held apart by an entropy bonus.

    .. math::

        L(\psi) = -\sum_z p_\psi(z)\, \bar r(z) - \beta\, H(p_\psi), \qquad
        \bar r(z) = \mathbb{E}\bigl[\log q(z \mid s') \,\big|\, z\bigr]

    With :math:`\beta = 1` that is minus the mutual information of skill and state, the objective of
    variational intrinsic control. :math:`\bar r(z)` is a running mean over the transitions of each
    skill; the minimum is :math:`p(z) \propto \exp(\bar r(z) / \beta)`. A skill that is drawn more
    often becomes easier to tell, until one or a few are left: so the authors of DIAYN fix p(z),
    which is :math:`\beta \to \infty`.

    Args:
        prior (SkillPrior): the prior to train, e.g. a
            :class:`~torchrl_hmcts.modules.LearnedSkillPrior`. Its parameters are this loss's. Give
            the same object to the :class:`~torchrl_hmcts.transforms.SkillTransform` and to the
            skill objective.
        entropy_coeff (float): :math:`\beta`, not negative, in units of reward.
        prior_in_reward (bool): the reward that is read contains ``-log p(z)``, as DIAYN's and VIC's
            do; it is taken out, since the entropy stands for it. Pass ``False`` e.g. for METRA's.
        decay (float): share of the old running mean that a batch keeps, in ``[0, 1]``. In eval mode
            the mean stays.
        reduction (str): over skills: ``"sum"`` (default) is L above; ``"none"`` gives its terms,
            ``[Z]``; ``"mean"`` is L / Z.

    Returns:
        TensorDict with ``loss_skill_prior`` and the detached ``skill_prior_entropy`` (nats) and
        ``num_effective_skills`` (its exponential, between 1 and ``Z``).

    Raises:
        ValueError: if the prior has nothing to train.

    Keys (``set_keys``): ``skill`` (int64 ``[*B]``) and ``reward`` (float ``[*B, 1]``, read from
    ``"next"``), each by its own name by default.

    Reference:
        Gregor, Rezende and Wierstra, "Variational Intrinsic Control", 2016, arXiv 1611.07507,
        algorithm 1. Why p(z) is fixed: Eysenbach et al., "Diversity is All You Need", 2018.

    Examples:
        >>> from torchrl_hmcts.modules import LearnedSkillPrior
        >>> from torchrl_hmcts.objectives import SkillPriorLoss
        >>> loss = SkillPriorLoss(LearnedSkillPrior(2), prior_in_reward=False)
        >>> after = TensorDict(reward=torch.tensor([[0.0], [-1.0]]), batch_size=[2])
        >>> out = loss(TensorDict(skill=torch.tensor([0, 1]), next=after, batch_size=[2]))
        >>> round(out["loss_skill_prior"].item(), 4)  # (0 + 1) / 2 - ln 2
        -0.1931
    """

    @dataclass
    class _AcceptedKeys:
        skill: NestedKey = "skill"
        reward: NestedKey = "reward"

    out_keys = ["loss_skill_prior", "skill_prior_entropy", "num_effective_skills"]

    mean_reward: Tensor  # [Z] running mean of the reward, without -log p(z)
    seen: Tensor  # bool [Z]

    def __init__(
        self,
        prior: SkillPrior,
        *,
        entropy_coeff: float = 1.0,
        prior_in_reward: bool = True,
        decay: float = 0.9,
        reduction: str = "sum",
    ) -> None:
        super().__init__(reduction)
        instance("SkillPriorLoss", "prior", prior, SkillPrior)
        if not any(p.requires_grad for p in prior.parameters()):
            raise ValueError(
                f"SkillPriorLoss trains the parameters of a prior; {type(prior).__name__} has none "
                "to train. Pass a LearnedSkillPrior."
            )
        self.prior = prior
        self.num_skills = prior.num_skills
        owner = "SkillPriorLoss"
        self.entropy_coeff = real_number(owner, "entropy_coeff", entropy_coeff, least=0.0)
        self.prior_in_reward = bool(prior_in_reward)
        self.decay = real_number(owner, "decay", decay, least=0.0, most=1.0)
        self.register_buffer("mean_reward", torch.zeros(self.num_skills))
        self.register_buffer("seen", torch.zeros(self.num_skills, dtype=torch.bool))

    def _reads(self) -> Iterable[NestedKey]:
        return [self.tensor_keys.skill, ("next", self.tensor_keys.reward)]

    @torch.no_grad()
    def _remember(self, tensordict: TensorDictBase) -> None:
        """Moves the running means of the skills that occur in a batch."""
        skill = tensordict.get(self.tensor_keys.skill).flatten()
        reward = tensordict.get(("next", self.tensor_keys.reward)).flatten()
        on = self.prior.active()[skill]  # a skill that is switched off has log p(z) = -inf
        reward = reward.to(self.mean_reward)
        if self.prior_in_reward:
            reward = reward + self.prior.log_probs().to(reward)[skill]
        # Masked, not selected: torch.compile wants shapes that do not depend on the data.
        count = torch.zeros_like(self.mean_reward).index_add_(0, skill, on.to(reward))
        total = torch.zeros_like(count).index_add_(0, skill, reward.masked_fill(~on, 0.0))
        batch_mean = total / count.clamp_min(1.0)
        moved = self.mean_reward.lerp(batch_mean, 1.0 - self.decay)
        moved = torch.where(self.seen, moved, batch_mean)
        present = count > 0
        self.mean_reward.copy_(torch.where(present, moved, self.mean_reward))
        self.seen.logical_or_(present)

    def skill_rewards(self) -> Tensor:
        """Returns the running mean reward of each skill, ``[Z]``; unseen ones count as average."""
        known = self.mean_reward.masked_fill(~self.seen, 0.0)
        average = known.sum() / self.seen.sum().clamp_min(1)
        return torch.where(self.seen, self.mean_reward, average)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.training:
            self._remember(tensordict)
        probs = self.prior.probs()  # [Z]
        entropy = torch.special.entr(probs)  # [Z], summands
        terms = -probs * self.skill_rewards().to(probs) - self.entropy_coeff * entropy
        nats = entropy.detach().sum()
        return TensorDict(
            {
                "loss_skill_prior": self._reduce_loss(terms),
                "skill_prior_entropy": nats,
                "num_effective_skills": nats.exp(),
            },
            batch_size=[],
        )
