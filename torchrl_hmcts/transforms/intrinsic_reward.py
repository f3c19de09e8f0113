"""The intrinsic reward of skill discovery."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Transform

from torchrl_hmcts.modules.skill_mlp import entries
from torchrl_hmcts.modules.skill_prior import SkillPrior, as_skill_prior
from torchrl_hmcts.objectives.skill_objective import SkillObjective


class SkillReward(Transform):
    r"""Rewards transitions with what a skill objective makes of them.

    .. math:: r = c_i\, r_\phi(s, z, s') + c_e\, r_{\text{env}}

    On a replay buffer it scores the sampled transitions with the objective as it is now, so old
    data never carry stale rewards; that is the usual place. On an env it scores each step as it is
    taken. Use it in one of the two places, or the second counts the first as the env's reward
    (harmless while ``extrinsic_coeff`` is 0).

    Args:
        objective (SkillObjective): gives the reward :math:`r_\phi`, e.g. ``loss.objective`` of a
            :class:`~torchrl_hmcts.objectives.DiscreteSkillSACLoss`. It stays the property of
            whoever trains it: its parameters are not listed among the transform's.
        intrinsic_coeff (float): :math:`c_i`. Default ``1.0``.
        extrinsic_coeff (float): :math:`c_e`. Default ``0.0``: the env's reward is replaced.
        reward_key (NestedKey): reward to write, ``[*B, 1]``, under ``"next"``. Default
            ``"reward"``.

    Returns:
        The transitions with ``("next", reward_key)`` set to ``r`` ``[*B, 1]``, detached.

    Raises:
        TypeError: if the objective is no :class:`SkillObjective`.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070, for replacing the
        reward; the reward itself is its objective's.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss
        >>> from torchrl_hmcts.transforms import SkillReward
        >>> objective = SkillDiscriminatorLoss(SkillDiscriminator(2, num_skills=4))
        >>> buffer = ReplayBuffer(
        ...     storage=LazyTensorStorage(10), transform=SkillReward(objective), batch_size=5)
        >>> data = TensorDict(skill=torch.zeros(10, dtype=torch.int64),
        ...                   next=TensorDict(displacement=torch.randn(10, 2), batch_size=[10]),
        ...                   batch_size=[10])
        >>> _ = buffer.extend(data)
        >>> buffer.sample()["next", "reward"].shape
        torch.Size([5, 1])
    """

    objective: SkillObjective

    def __init__(
        self,
        objective: SkillObjective,
        *,
        intrinsic_coeff: float = 1.0,
        extrinsic_coeff: float = 0.0,
        reward_key: NestedKey = "reward",
    ) -> None:
        if not isinstance(objective, SkillObjective):
            raise TypeError(
                "SkillReward asks a SkillObjective for the reward; got "
                f"{type(objective).__name__}. Pass e.g. loss.objective."
            )
        skill_key = objective.tensor_keys.skill
        self._configure([skill_key], intrinsic_coeff, extrinsic_coeff, reward_key)
        # Past nn.Module.__setattr__: registered here, the parameters would be in two modules.
        self.__dict__["objective"] = objective

    def _configure(
        self,
        in_keys: Sequence[NestedKey],
        intrinsic_coeff: float,
        extrinsic_coeff: float,
        reward_key: NestedKey,
    ) -> None:
        self.reward_key = unravel_key(reward_key)
        Transform.__init__(self, in_keys=list(in_keys), out_keys=[self.reward_key])
        self.intrinsic_coeff = float(intrinsic_coeff)
        self.extrinsic_coeff = float(extrinsic_coeff)

    def _intrinsic(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
        if tensordict.get("next", None) is not next_tensordict:
            tensordict = tensordict.copy().set("next", next_tensordict)
        return self.objective.finite_reward(tensordict)

    def _score(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        reward = self._intrinsic(tensordict, next_tensordict)
        if self.intrinsic_coeff != 1.0:
            reward = self.intrinsic_coeff * reward
        if self.extrinsic_coeff != 0.0:
            extrinsic = next_tensordict.get(self.reward_key, None)
            if extrinsic is None:
                raise KeyError(
                    f"{type(self).__name__} mixes in the env's reward (extrinsic_coeff="
                    f"{self.extrinsic_coeff}), but ('next', {self.reward_key!r}) is missing. Store "
                    "it, or pass extrinsic_coeff=0."
                )
            reward = reward + self.extrinsic_coeff * extrinsic
        return next_tensordict.set(self.reward_key, reward)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = tensordict.copy()  # a storage may have handed out what it holds
        self._score(tensordict, tensordict.get("next"))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._score(tensordict, next_tensordict)

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        old = reward_spec[self.reward_key]
        reward_spec[self.reward_key] = Unbounded(old.shape, dtype=old.dtype, device=old.device)
        return reward_spec


class DIAYNReward(SkillReward):
    r"""Rewards a transition for showing which skill it belongs to.

    .. math:: r = c_i \bigl(\log q(z \mid s') - \log p(z)\bigr) + c_e\, r_{\text{env}}

    The same as a :class:`SkillReward` with a
    :class:`~torchrl_hmcts.objectives.SkillDiscriminatorLoss`, for those who have a discriminator
    and no objective.

    Args:
        discriminator (TensorDictModuleBase): writes the logits ``[*B, Z]`` of q(z | s') from its
            ``in_keys``, which are read from the ``"next"`` part of a transition. It stays the
            property of whoever trains it: its parameters are not listed among the transform's.
        num_skills (int): number of skills ``Z``.
        prior (SkillPrior, sequence of float or Tensor, optional): p(z), ``[Z]``, normalised; skills
            of probability 0 are not guessed. Default ``None``: uniform.
        intrinsic_coeff (float): :math:`c_i`. Default ``1.0``.
        extrinsic_coeff (float): :math:`c_e`. Default ``0.0``: the env's reward is replaced.
        skill_key (NestedKey): entry of the skill, int64 ``[*B]``. Default ``"skill"``.
        skill_logits_key (NestedKey): entry the discriminator writes. Default ``"skill_logits"``.
        reward_key (NestedKey): reward to write, ``[*B, 1]``, under ``"next"``. Default
            ``"reward"``.

    Returns:
        The transitions with ``("next", reward_key)`` set to ``r`` ``[*B, 1]``, detached.

    Raises:
        ValueError: if the discriminator tells another number of skills apart.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070, equation 3.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> from torchrl_hmcts.transforms import DIAYNReward
        >>> reward = DIAYNReward(SkillDiscriminator(2, num_skills=4), num_skills=4)
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(10), transform=reward, batch_size=5)
        >>> data = TensorDict(skill=torch.zeros(10, dtype=torch.int64),
        ...                   next=TensorDict(displacement=torch.randn(10, 2), batch_size=[10]),
        ...                   batch_size=[10])
        >>> _ = buffer.extend(data)
        >>> buffer.sample()["next", "reward"].shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        discriminator: TensorDictModuleBase,
        num_skills: int,
        *,
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        intrinsic_coeff: float = 1.0,
        extrinsic_coeff: float = 0.0,
        skill_key: NestedKey = "skill",
        skill_logits_key: NestedKey = "skill_logits",
        reward_key: NestedKey = "reward",
    ) -> None:
        self.skill_key = unravel_key(skill_key)
        self.skill_logits_key = unravel_key(skill_logits_key)
        self._configure([self.skill_key], intrinsic_coeff, extrinsic_coeff, reward_key)
        known = getattr(discriminator, "num_skills", num_skills)
        if known != num_skills:
            raise ValueError(
                f"DIAYNReward was told of {num_skills} skills, but its discriminator tells {known} "
                "apart. Give both the same num_skills."
            )
        # Past nn.Module.__setattr__: registered here, the parameters would be in two modules.
        self.__dict__["prior"] = as_skill_prior("DIAYNReward", prior, num_skills)
        self.__dict__["discriminator"] = discriminator

    @torch.no_grad()
    def reward(self, skill: Tensor, next_tensordict: TensorDictBase) -> Tensor:
        """Returns log q(z | s') - log p(z), ``[*B, 1]``, for skills ``[*B]`` and states s'.

        It is 0 for skills that are switched off.
        """
        features = next_tensordict.select(*self.discriminator.in_keys)
        logits = self.discriminator(features).get(self.skill_logits_key)
        log_prior = self.prior.log_probs().to(logits)
        off = log_prior == -torch.inf
        index = skill.unsqueeze(-1)
        log_q = logits.masked_fill(off, -torch.inf).log_softmax(-1)
        return (log_q.gather(-1, index) - log_prior[index]).masked_fill(off[index], 0.0)

    def _intrinsic(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
        (skill,) = entries(self, tensordict, [self.skill_key])
        return self.reward(skill, next_tensordict)
