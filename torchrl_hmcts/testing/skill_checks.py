"""Checks of what makes skills: objectives of their discovery, distributions over them.

Letters: *B batch of the tensordict, Z skills.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.skill_objective import SkillObjective
from torchrl_hmcts.testing.contract import (
    during,
    leaves,
    require,
    require_alone,
    require_kind,
    seeded,
)
from torchrl_hmcts.testing.loss_checks import MakeLoss, check_loss


def check_skill_objective(
    make_objective: MakeLoss, tensordict: TensorDictBase, **kwargs: Any
) -> None:
    """Check that an objective of skill discovery can take the place of another.

    All of :func:`check_loss`, and of its reward: one finite number ``[*B, 1]`` per transition,
    without a gradient, which depends on that transition only, and which a reward transform can ask
    for without the tensordict being changed.

    Args:
        make_objective (callable): ``make_objective(name, **kwargs) -> SkillObjective``, as
            ``make_loss`` of :func:`check_loss`.
        tensordict (TensorDictBase): transitions ``[n]`` with the objective's ``in_keys``.
        **kwargs: of :func:`check_loss`.

    Raises:
        ContractError: if it cannot.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillEncoder
        >>> from torchrl_hmcts.objectives import METRAEncoderLoss
        >>> from torchrl_hmcts.testing import check_skill_objective
        >>> def make_objective(name, **kwargs):
        ...     encoder = SkillEncoder(2, num_skills=3, in_keys=[name("x")],
        ...                            representation_key=name("representation"))
        ...     return METRAEncoderLoss(encoder, **kwargs)
        >>> td = TensorDict(x=torch.randn(3, 2), skill=torch.arange(3),
        ...                 next=TensorDict(x=torch.randn(3, 2), batch_size=[3]), batch_size=[3])
        >>> check_skill_objective(make_objective, td, checks=["out_keys", "reduction"])
    """
    with seeded(0):
        objective = make_objective(lambda key: key)
    name = require_kind(objective, SkillObjective)

    def ask(transitions: TensorDictBase) -> Tensor:
        with during(name, "asked for the reward"), seeded(0):
            return objective.reward(transitions)

    given, shape = tensordict.clone(), [*tensordict.batch_size, 1]
    reward = ask(given)
    require(
        list(reward.shape) == shape,
        f"{name}.reward gives {list(reward.shape)} for transitions {shape[:-1]}; it must give "
        f"{shape}.",
    )
    require(
        not reward.requires_grad,
        f"{name}.reward has a gradient. Decorate it with torch.no_grad().",
    )
    require(
        torch.isfinite(reward).all(), f"{name}.reward gives {reward!s:.200}, which is not finite."
    )
    require(
        leaves(given) == leaves(tensordict),
        f"{name}.reward wrote {sorted(map(str, leaves(given) ^ leaves(tensordict)))} into the "
        "transitions. Select what it reads.",
    )
    require_alone(f"{name}.reward", lambda row: ask(row.clone()), tensordict, reward, "transition")
    check_loss(make_objective, tensordict, **kwargs)


def check_skill_prior(prior: SkillPrior) -> None:
    """Check that a skill prior is a distribution over skills.

    ``probs()`` is not negative and sums to 1; ``log_probs()`` and ``active()`` say the same;
    nothing of it is drawn at random; it survives its state dict.

    Args:
        prior (SkillPrior): the prior.

    Raises:
        ContractError: if it is not.

    Examples:
        >>> from torchrl_hmcts.modules import GrowingSkillPrior
        >>> from torchrl_hmcts.testing import check_skill_prior
        >>> check_skill_prior(GrowingSkillPrior(4, num_active=2))
    """
    name = require_kind(prior, SkillPrior)
    with during(name, "asked for its probabilities"), torch.no_grad():
        probs, log_probs, active = prior.probs(), prior.log_probs(), prior.active()
    require(
        probs.shape == torch.Size([prior.num_skills]),
        f"{name}: probs() gives {list(probs.shape)}; it must give [{prior.num_skills}], one per "
        "skill.",
    )
    require((probs >= 0).all(), f"{name}: probs() gives {probs.min().item():g}, below 0.")
    total = probs.sum().item()
    require(
        abs(total - 1.0) < 1e-5, f"{name}: probs() sums to {total:g}, not 1. Divide by the sum."
    )
    require(
        active.dtype == torch.bool and torch.equal(active, probs > 0),
        f"{name}: active() gives {active.tolist()} where probs() gives {probs.tolist()}. A skill "
        "is on where its probability is not 0.",
    )
    require(
        torch.allclose(log_probs.exp(), probs, atol=1e-6),
        f"{name}: log_probs() is not the logarithm of probs().",
    )
    with torch.no_grad():
        require(
            torch.equal(prior.probs(), probs),
            f"{name}: probs() gives another distribution at its second call. Change the "
            "distribution only in methods made for that.",
        )
