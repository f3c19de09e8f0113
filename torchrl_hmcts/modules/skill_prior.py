"""Distributions over skills that change while others read them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_hmcts.checks import whole_number


class SkillPrior(nn.Module, ABC):
    r"""A distribution p(z) over skills, read by each part that samples, rewards or plans with them.

    .. math:: p(z) \ge 0, \qquad \sum_{z < Z} p(z) = 1

    A skill with ``p(z) = 0`` is switched off: it is not drawn and no discriminator guesses it.
    Sub-classes define :meth:`probs`. Readers hold a prior without registering it as a sub-module:
    whoever owns it moves, trains and saves it.

    Args:
        num_skills (int): number of skills ``Z``, those that are switched off included.

    Reference:
        Fixed: Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070, section 3.
        Learned: Gregor et al., "Variational Intrinsic Control", 2016, arXiv 1611.07507.

    Examples:
        >>> from torchrl_hmcts.modules import SkillPrior
        >>> class OnlyEvenSkills(SkillPrior):
        ...     def probs(self):
        ...         even = (torch.arange(self.num_skills) % 2 == 0).float()
        ...         return even / even.sum()
        >>> OnlyEvenSkills(4).probs()
        tensor([0.5000, 0.0000, 0.5000, 0.0000])
        >>> OnlyEvenSkills(4).active().tolist()
        [True, False, True, False]
    """

    def __init__(self, num_skills: int) -> None:
        super().__init__()
        self.num_skills = whole_number(type(self).__name__, "num_skills", num_skills, least=1)

    @abstractmethod
    def probs(self) -> Tensor:
        """Returns p(z), ``[Z]``: not negative, sums to 1, 0 for skills that are switched off."""

    def log_probs(self) -> Tensor:
        """Returns log p(z), ``[Z]``, ``-inf`` for skills that are switched off."""
        return self.probs().log()

    def active(self) -> Tensor:
        """Returns which skills are switched on, bool ``[Z]``."""
        return self.probs() > 0

    def extra_repr(self) -> str:
        """Returns the number of skills that ``print`` shows."""
        return f"num_skills={self.num_skills}"


class FixedSkillPrior(SkillPrior):
    """Given probabilities, uniform by default.

    Args:
        num_skills (int): number of skills ``Z``.
        weights (sequence of float or Tensor, optional): ``[Z]``, not negative, normalised here; 0
            switches a skill off. Default ``None``: uniform. Kept as the buffer ``p``.

    Raises:
        ValueError: if the weights are no distribution over the skills, at least one.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070, section 3.

    Examples:
        >>> from torchrl_hmcts.modules import FixedSkillPrior
        >>> FixedSkillPrior(4).probs()
        tensor([0.2500, 0.2500, 0.2500, 0.2500])
        >>> FixedSkillPrior(3, [2.0, 2.0, 0.0]).log_probs()
        tensor([-0.6931, -0.6931,    -inf])
    """

    p: Tensor

    def __init__(self, num_skills: int, weights: Sequence[float] | Tensor | None = None) -> None:
        super().__init__(num_skills)
        p = _per_skill("FixedSkillPrior", "weights", weights, num_skills, default=1.0)
        if not ((p >= 0).all() and (p > 0).any()):
            raise ValueError(
                "FixedSkillPrior needs weights >= 0, at least one of them above 0; got "
                f"weights={p.tolist()}."
            )
        self.register_buffer("p", p / p.sum())

    def probs(self) -> Tensor:
        return self.p


class GrowingSkillPrior(SkillPrior):
    r"""Uniform over the first skills of a fixed number, for skills that are added as needed.

    .. math:: p(z) \propto [z < n \text{ and } z \text{ is not dropped}], \qquad
        n = \text{num\_active}

    Networks are built for all ``Z`` skills at once; how many of them are in use is the buffer
    ``num_active``, and which of these were dropped again the buffer ``dropped``, so that both are
    saved and resumed with the rest.

    Args:
        num_skills (int): number of skills there is room for, ``Z``.
        num_active (int): number of skills switched on at first. Default ``2``, the fewest that can
            be told apart.

    Reference:
        This project's.

    Examples:
        >>> from torchrl_hmcts.modules import GrowingSkillPrior
        >>> prior = GrowingSkillPrior(4, num_active=2)
        >>> prior.probs()
        tensor([0.5000, 0.5000, 0.0000, 0.0000])
        >>> prior.set_num_active(4)
        >>> prior.probs()
        tensor([0.2500, 0.2500, 0.2500, 0.2500])
        >>> prior.drop(1)
        >>> prior.active().tolist()
        [True, False, True, True]
    """

    num_active: Tensor  # int64, a scalar
    dropped: Tensor  # bool [Z]

    def __init__(self, num_skills: int, num_active: int = 2) -> None:
        super().__init__(num_skills)
        self.register_buffer("num_active", torch.ones((), dtype=torch.int64))
        self.register_buffer("dropped", torch.zeros(num_skills, dtype=torch.bool))
        self.set_num_active(num_active)

    def set_num_active(self, num_active: int) -> None:
        """Switches on the first ``num_active`` skills, also dropped ones, and the others off."""
        if whole_number("GrowingSkillPrior", "num_active", num_active, least=1) > self.num_skills:
            raise ValueError(
                f"GrowingSkillPrior has room for {self.num_skills} skills; got "
                f"num_active={num_active}."
            )
        self.num_active.fill_(num_active)
        self.dropped.zero_()

    def drop(self, skill: int, dropped: bool = True) -> None:
        """Switches one of the active skills off, or with ``dropped=False`` on again."""
        others = self.active()
        others[skill] = not dropped
        if not others.any():
            raise ValueError(
                f"GrowingSkillPrior keeps at least one skill on; {skill} is the last one."
            )
        self.dropped[skill] = dropped

    def active(self) -> Tensor:
        index = torch.arange(self.num_skills, device=self.num_active.device)
        return (index < self.num_active) & ~self.dropped

    def probs(self) -> Tensor:
        active = self.active()
        return active.to(torch.get_default_dtype()) / active.sum()

    def extra_repr(self) -> str:
        """Returns the number of skills, and of those in use, that ``print`` shows."""
        return f"num_skills={self.num_skills}, num_active={int(self.num_active)}"


class LearnedSkillPrior(SkillPrior):
    r"""A softmax over one logit per skill, to be trained, e.g. by ``SkillPriorLoss``.

    .. math:: p(z) = \mathrm{softmax}_z(\ell)

    Args:
        num_skills (int): number of skills ``Z``.
        logits (sequence of float or Tensor, optional): :math:`\ell` at first, ``[Z]``. Default
            ``None``: zeros, a uniform prior.

    Reference:
        Gregor et al., "Variational Intrinsic Control", 2016, arXiv 1611.07507.

    Examples:
        >>> import math
        >>> from torchrl_hmcts.modules import LearnedSkillPrior
        >>> LearnedSkillPrior(2, [math.log(3.0), 0.0]).probs().detach()
        tensor([0.7500, 0.2500])
    """

    def __init__(self, num_skills: int, logits: Sequence[float] | Tensor | None = None) -> None:
        super().__init__(num_skills)
        start = _per_skill("LearnedSkillPrior", "logits", logits, num_skills, default=0.0)
        self.logits = nn.Parameter(start)

    def probs(self) -> Tensor:
        return self.logits.softmax(-1)

    def log_probs(self) -> Tensor:
        return self.logits.log_softmax(-1)


def _per_skill(
    owner: str,
    name: str,
    values: Sequence[float] | Tensor | None,
    num_skills: int,
    *,
    default: float,
) -> Tensor:
    """Returns one finite number for each skill, ``[Z]``."""
    if values is None:
        return torch.full((num_skills,), default)
    made = torch.as_tensor(values, dtype=torch.get_default_dtype()).detach().clone()
    if made.shape != (num_skills,) or not torch.isfinite(made).all():
        raise ValueError(
            f"{owner} needs one finite number per skill, shape ({num_skills},); got "
            f"{name}={values!r}."
        )
    return made


def as_skill_prior(
    owner: str, prior: SkillPrior | Sequence[float] | Tensor | None, num_skills: int
) -> SkillPrior:
    """Returns the prior that an argument ``prior=`` stands for: None is uniform."""
    if not isinstance(prior, SkillPrior):
        return FixedSkillPrior(num_skills, prior)
    if prior.num_skills != num_skills:
        raise ValueError(
            f"{owner} has {num_skills} skills, but its prior is over {prior.num_skills}. Give both "
            "the same num_skills."
        )
    return prior
