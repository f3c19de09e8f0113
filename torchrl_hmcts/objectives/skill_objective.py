"""Objectives that make skills different: a representation, its loss, and the reward it gives."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec

from torchrl_hmcts.modules.skill_mlp import entries
from torchrl_hmcts.modules.skill_prior import SkillPrior, as_skill_prior
from torchrl_hmcts.modules.skill_spec import (
    Skills,
    as_skill_spec,
    described,
    no_prior,
    number_of,
    same_skills,
)
from torchrl_hmcts.objectives.loss import Loss

_EMPTY = "_empty_state"  # bool [*B]


class SkillObjective(Loss):
    r"""Base class of skill objectives: the loss of a representation and the reward it gives.

    .. math:: L(\phi; s, z, s'), \qquad r_\phi(s, z, s')

    A :class:`DiscreteSkillSACLoss` or :class:`SkillSACLoss` trains it beside actor and critics, a
    :class:`~torchrl_hmcts.transforms.SkillReward` writes its reward; both take any objective.
    Sub-classes define :meth:`losses`, :meth:`reward` and three attributes: ``root_features`` and
    ``next_features``, the entries they read of the state before and after a transition, and
    ``out_keys``. A terminal state may hold anything: where what is read of one is not finite, its
    transition teaches nothing and is worth 0, as that of a skill that the prior switches off.

    Args:
        num_skills (int or TensorSpec, optional): number of skills ``Z``, or the spec of one skill
            that is a vector ``[D]``. Default: what the network says.
        prior (SkillPrior, sequence of float or Tensor, optional): p(z), ``[Z]``, normalised; 0
            switches a skill off. Default: uniform, or that of the vectors' spec. A
            :class:`~torchrl_hmcts.modules.SkillPrior` is read at every use and stays its owner's.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.
        **network (TensorDictModuleBase): what is trained, under the name of its attribute.

    Returns:
        TensorDict with the entries ``loss_*`` of the objective and detached diagnostics; with
        ``reduction="none"`` all are ``[*B]``.

    Raises:
        ValueError: if the number of skills is unknown or contradicts that of the network or prior.

    Keys (``set_keys``): ``skill`` (int64 ``[*B]``, or float ``[*B, D]``), ``terminated`` (read
    under ``"next"`` if it is there) and ``priority_weight``, each by its own name by default.

    Reference:
        This project's: the common form of DIAYN, DADS, METRA and LSD.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.objectives import SkillObjective
        >>> class GoWhereTheSkillSays(SkillObjective):
        ...     root_features = next_features = ["x"]
        ...     out_keys = []
        ...     def losses(self, tensordict):
        ...         return {}
        ...     def reward(self, tensordict):
        ...         sign = 2 * tensordict["skill"].unsqueeze(-1) - 1
        ...         return sign * (tensordict["next", "x"] - tensordict["x"])
        >>> td = TensorDict(x=torch.zeros(2, 1), skill=torch.tensor([0, 1]),
        ...                 next=TensorDict(x=torch.ones(2, 1), batch_size=[2]), batch_size=[2])
        >>> GoWhereTheSkillSays(2).reward(td).flatten().tolist()
        [-1.0, 1.0]
    """

    @dataclass
    class _AcceptedKeys(Loss._AcceptedKeys):
        skill: NestedKey = "skill"
        terminated: NestedKey = "terminated"

    #: Names of the entries that :meth:`losses` returns, in order.
    out_keys: list[str]
    #: Entries that are read of the state before a transition.
    root_features: Sequence[NestedKey]
    #: Entries that are read of the state after a transition, without ``"next"``.
    next_features: Sequence[NestedKey]

    prior: SkillPrior  # of a number of skills

    def __init__(
        self,
        num_skills: Skills | None = None,
        *,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        reduction: str = "mean",
        **network: TensorDictModuleBase,
    ) -> None:
        super().__init__(reduction)
        owner = type(self).__name__
        self.skill_spec = _known_skills(owner, num_skills, *network.values())
        self.num_skills = number_of(self.skill_spec)
        self._always_all_active = True
        if self.num_skills is not None:
            # Past nn.Module.__setattr__: a prior is saved and trained by its owner.
            self.__dict__["prior"] = as_skill_prior(owner, prior, self.num_skills)
            # A fixed prior that switches nothing off costs nothing below.
            fixed = not isinstance(prior, SkillPrior)
            self._always_all_active = fixed and bool(self.prior.active().all())
        elif prior is not None:
            raise ValueError(no_prior(owner, self.skill_spec))
        for name, module in network.items():
            self.convert_to_functional(module, name, create_target_params=False)

    def log_prior(self, like: Tensor) -> Tensor:
        """Returns log p(z) as it is now, ``[Z]``, detached, of the type and device of ``like``."""
        return self.prior.log_probs().detach().to(like)

    def inactive(self, device: torch.device | None = None) -> Tensor | None:
        """Returns which skills are switched off, bool ``[Z]``; None if all are on for good."""
        return None if self._always_all_active else ~self.prior.active().to(device)

    @abstractmethod
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the intrinsic reward ``[*B, 1]`` of transitions ``[*B]``, detached."""
        raise NotImplementedError

    def skill(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the skill of each transition, int64 ``[*B]``, or float ``[*B, D]``."""
        return entries(self, tensordict, [self.tensor_keys.skill])[0]

    def without_empty_states(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns transitions in which terminal states that are not finite are zeros, and marked.

        :meth:`losses` and :meth:`reward` are asked about these.
        """
        terminated = tensordict.get(unravel_key(("next", self.tensor_keys.terminated)), None)
        if terminated is None:
            return tensordict
        after = tensordict.get("next").copy()
        read = dict(zip(self.next_features, entries(self, after, self.next_features), strict=True))
        empty = torch.zeros(tensordict.batch_size, dtype=torch.bool, device=terminated.device)
        for entry in read.values():
            finite = entry.isfinite().reshape(*empty.shape, -1).all(-1)
            empty = empty | (terminated.reshape(empty.shape) & ~finite)
        for key, entry in read.items():
            after.set(key, entry.masked_fill(expand_as_right(empty, entry), 0))
        return tensordict.copy().set("next", after).set(_EMPTY, empty)

    def finite_reward(self, tensordict: TensorDictBase) -> Tensor:
        """Returns what :meth:`reward` does, and 0 for a terminal state that is not finite."""
        tensordict = self.without_empty_states(tensordict)
        reward = self.reward(tensordict)
        empty = tensordict.get(_EMPTY, None)
        return reward if empty is None else reward.masked_fill(empty.unsqueeze(-1), 0.0)

    def _of_active(self, value: Tensor, skill: Tensor) -> Tensor:
        """Returns values, and 0 where the skill, of the same shape, is switched off."""
        off = self.inactive(skill.device)
        return value if off is None else value.masked_fill(off[skill], 0.0)

    def _reduce(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        empty = tensordict.get(_EMPTY, None)
        return super()._reduce(loss if empty is None else loss.masked_fill(empty, 0.0), tensordict)

    def _reads(self) -> Iterable[NestedKey]:
        after = [("next", key) for key in self.next_features]
        return [self.tensor_keys.skill, *self.root_features, *after]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.num_skills is None:  # called with tensors, all may be of one shape
            batch_size = self.skill(tensordict).shape[:-1]
            if tensordict.batch_size != batch_size:
                tensordict = tensordict.copy()
                tensordict.batch_size = batch_size
        losses = self.losses(self.without_empty_states(tensordict))
        return self._output(tensordict, losses)


def _known_skills(
    owner: str, skills: Skills | None, network: TensorDictModuleBase | None = None
) -> TensorSpec:
    """Returns the spec of the skills that a network distinguishes, or that of the given ones."""
    known: Any = getattr(network, "skill_spec", getattr(network, "num_skills", None))
    if known is None and skills is None:
        raise ValueError(
            f"{owner} cannot tell how many skills {type(network).__name__} distinguishes, since it "
            "has no attribute num_skills. Pass num_skills=."
        )
    spec = as_skill_spec(owner, known if skills is None else skills)
    if None not in (known, skills) and not same_skills(as_skill_spec(owner, known), spec):
        raise ValueError(
            f"{owner} was made for {described(spec)}, but its {type(network).__name__} "
            f"distinguishes {described(as_skill_spec(owner, known))}. Give both the same."
        )
    return spec
