"""The intrinsic reward of skill discovery."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Transform

from torchrl_hmcts.transforms.skill import check_prior


class DIAYNReward(Transform):
    r"""Rewards a transition for showing which skill it belongs to.

    .. math:: r = c_i \bigl(\log q(z \mid s') - \log p(z)\bigr) + c_e\, r_{\text{env}}

    On a replay buffer it scores the sampled transitions with the discriminator as it is now, so old
    data never carry stale rewards; that is the usual place. On an env it scores each step as it is
    taken. Use it in one of the two places, or the second counts the first as the env's reward
    (harmless while ``extrinsic_coeff`` is 0).

    Args:
        discriminator (TensorDictModuleBase): writes the logits ``[*B, Z]`` of q(z | s') from its
            ``in_keys``, which are read from the ``"next"`` part of a transition. It stays the
            property of whoever trains it: its parameters are not listed among the transform's.
        num_skills (int): number of skills ``Z``.
        prior (sequence of float or Tensor, optional): p(z), ``[Z]``, normalised. Default ``None``:
            uniform.
        intrinsic_coeff (float): :math:`c_i`. Default ``1.0``.
        extrinsic_coeff (float): :math:`c_e`. Default ``0.0``: the env's reward is replaced.
        skill_key (NestedKey): entry of the skill, int64 ``[*B]``. Default ``"skill"``.
        skill_logits_key (NestedKey): entry the discriminator writes. Default ``"skill_logits"``.
        reward_key (NestedKey): reward to write, ``[*B, 1]``, under ``"next"``. Default
            ``"reward"``.

    Returns:
        The transitions with ``("next", reward_key)`` set to ``r`` ``[*B, 1]``, detached.

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

    log_prior: Tensor

    def __init__(
        self,
        discriminator: TensorDictModuleBase,
        num_skills: int,
        *,
        prior: Sequence[float] | Tensor | None = None,
        intrinsic_coeff: float = 1.0,
        extrinsic_coeff: float = 0.0,
        skill_key: NestedKey = "skill",
        skill_logits_key: NestedKey = "skill_logits",
        reward_key: NestedKey = "reward",
    ) -> None:
        self.skill_key = unravel_key(skill_key)
        self.skill_logits_key = unravel_key(skill_logits_key)
        self.reward_key = unravel_key(reward_key)
        super().__init__(in_keys=[self.skill_key], out_keys=[self.reward_key])
        known = getattr(discriminator, "num_skills", num_skills)
        if known != num_skills:
            raise ValueError(
                f"DIAYNReward was told of {num_skills} skills, but its discriminator tells {known} "
                "apart. Give both the same num_skills."
            )
        probabilities = check_prior("DIAYNReward", prior, num_skills)
        if probabilities is None:
            log_prior = torch.full((num_skills,), -math.log(num_skills))
        else:
            log_prior = probabilities.log()
        self.register_buffer("log_prior", log_prior)
        self.intrinsic_coeff = float(intrinsic_coeff)
        self.extrinsic_coeff = float(extrinsic_coeff)
        # Past nn.Module.__setattr__: registered here, the parameters would be in two modules.
        self.__dict__["discriminator"] = discriminator

    @torch.no_grad()
    def reward(self, skill: Tensor, next_tensordict: TensorDictBase) -> Tensor:
        """Returns log q(z | s') - log p(z), ``[*B, 1]``, for skills ``[*B]`` and states s'."""
        features = next_tensordict.select(*self.discriminator.in_keys)
        log_q = self.discriminator(features).get(self.skill_logits_key).log_softmax(-1)
        index = skill.unsqueeze(-1)
        return log_q.gather(-1, index) - self.log_prior.to(log_q.dtype)[index]

    def _score(self, skill: Tensor, next_tensordict: TensorDictBase) -> TensorDictBase:
        reward = self.reward(skill, next_tensordict)
        if self.intrinsic_coeff != 1.0:
            reward = self.intrinsic_coeff * reward
        if self.extrinsic_coeff != 0.0:
            extrinsic = next_tensordict.get(self.reward_key, None)
            if extrinsic is None:
                raise KeyError(
                    f"DIAYNReward mixes in the env's reward (extrinsic_coeff="
                    f"{self.extrinsic_coeff}), but ('next', {self.reward_key!r}) is missing. Store "
                    "it, or pass extrinsic_coeff=0."
                )
            reward = reward + self.extrinsic_coeff * extrinsic
        return next_tensordict.set(self.reward_key, reward)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._score(tensordict.get(self.skill_key), tensordict.get("next"))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._score(tensordict.get(self.skill_key), next_tensordict)

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        old = reward_spec[self.reward_key]
        reward_spec[self.reward_key] = Unbounded(old.shape, dtype=old.dtype, device=old.device)
        return reward_spec
