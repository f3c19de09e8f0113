"""The intrinsic reward of skill discovery."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from torchrl_hmcts.checks import instance, nested_key, real_number
from torchrl_hmcts.modules.skill_spec import require_known
from torchrl_hmcts.objectives.skill_objective import SkillObjective


class SkillReward(Transform):
    r"""Rewards transitions by a skill objective.

    .. math:: r = c_i\, r_\phi(s, z, s') + c_e\, r_{\text{env}}

    On a replay buffer, where it belongs, it rewards sampled transitions by the present objective;
    on an env, each step when it is taken. Use it in one of the two places only.

    Args:
        objective (SkillObjective): gives the reward :math:`r_\phi`, e.g. ``loss.objective`` of a
            :class:`~torchrl_hmcts.objectives.DiscreteSkillSACLoss`. It stays its owner's.
        intrinsic_coeff (float): :math:`c_i`.
        extrinsic_coeff (float): :math:`c_e`. Default ``0.0``: the env's reward is replaced.
        reward_key (NestedKey): reward to write, ``[*B, 1]``, under ``"next"``. An env gets a reward
            of another name beside its own.

    Raises:
        ValueError: on an env that draws other skills than the objective distinguishes, or has no
            reward of this name to mix in.

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
        >>> after = TensorDict(displacement=torch.randn(10, 2), batch_size=[10])
        >>> _ = buffer.extend(TensorDict(skill=torch.arange(10) % 4, next=after, batch_size=[10]))
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
        instance("SkillReward", "objective", objective, SkillObjective)
        self.reward_key = nested_key("SkillReward", "reward_key", reward_key)
        super().__init__(in_keys=[objective.tensor_keys.skill], out_keys=[self.reward_key])
        # Past nn.Module.__setattr__: registered here, the parameters would be in two modules.
        self.__dict__["objective"] = objective
        self.intrinsic_coeff = real_number("SkillReward", "intrinsic_coeff", intrinsic_coeff)
        self.extrinsic_coeff = real_number("SkillReward", "extrinsic_coeff", extrinsic_coeff)

    def _score(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.get("next", None) is not next_tensordict:
            tensordict = tensordict.copy().set("next", next_tensordict)
        reward = self.objective.finite_reward(tensordict)
        if self.intrinsic_coeff != 1.0:
            reward = self.intrinsic_coeff * reward
        if self.extrinsic_coeff != 0.0:
            extrinsic = next_tensordict.get(self.reward_key, None)
            if extrinsic is None:
                raise KeyError(
                    f"SkillReward mixes in the env's reward (extrinsic_coeff="
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

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        shown = self.parent.full_observation_spec
        if (skill := self.objective.tensor_keys.skill) in shown.keys(True, True):
            require_known("SkillReward", self.objective, self.objective.skill_spec, shown[skill])
        shape, dtype, device = (*reward_spec.shape, 1), torch.float32, reward_spec.device
        if self.reward_key in reward_spec.keys(True, True):
            old = reward_spec[self.reward_key]
            shape, dtype, device = old.shape, old.dtype, old.device
        elif self.extrinsic_coeff != 0.0:
            raise ValueError(
                f"SkillReward mixes in the env's reward {self.reward_key!r} (extrinsic_coeff="
                f"{self.extrinsic_coeff}), but the env has {self.parent.reward_keys}. Name one of "
                f"them by reward_key, or pass extrinsic_coeff=0."
            )
        reward_spec[self.reward_key] = Unbounded(shape, dtype=dtype, device=device)
        return reward_spec
