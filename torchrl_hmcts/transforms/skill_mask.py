"""The mask of options while skills are switched on and off."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite

from torchrl_hmcts.checks import instance, nested_key
from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.transforms.env_transform import EnvTransform


class SkillMaskTransform(EnvTransform):
    r"""Writes which options may be taken: those whose skill the prior has switched on.

    .. math:: \text{mask}(z) = [\,p(z) > 0\,]

    It is for a macro environment whose action is a skill: append it after the
    :class:`OptionTransform`. :class:`~torchrl_hmcts.planners.MCTSPlanner` reads the entry by its
    default ``mask_key``. TorchRL's ``ActionMask`` behind it restricts random actions, too. The
    prior is read at every step; it is not a sub-module of the transform.

    Args:
        prior (SkillPrior): over the skills, one per option, ``Z``.
        mask_key (NestedKey): entry to write, bool ``[*B, Z]``. Default ``"action_mask"``.

    Raises:
        TypeError: if the prior is no :class:`~torchrl_hmcts.modules.SkillPrior`.
        ValueError: when the specs are made, if the env has another number of options.

    Reference:
        This project's (section 6.2 of Bartley 2023 asks for skills that are added as needed).

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_hmcts.modules import GrowingSkillPrior
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> from torchrl_hmcts.transforms import OptionTransform, SkillMaskTransform
        >>> prior = GrowingSkillPrior(2, num_active=1)
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> env = TransformedEnv(
        ...     ChainEnv(length=6),
        ...     Compose(OptionTransform(worker, 2, 4), SkillMaskTransform(prior)),
        ... )
        >>> env.reset()["action_mask"].tolist()
        [True, False]
        >>> prior.set_num_active(2)
        >>> env.reset()["action_mask"].tolist()
        [True, True]
    """

    def __init__(self, prior: SkillPrior, mask_key: NestedKey = "action_mask") -> None:
        instance("SkillMaskTransform", "prior", prior, SkillPrior)
        self.mask_key = nested_key("SkillMaskTransform", "mask_key", mask_key)
        super().__init__(in_keys=[], out_keys=[self.mask_key])
        # Past nn.Module.__setattr__: a sub-module would be saved and moved with the env.
        self.__dict__["prior"] = prior

    prior: SkillPrior

    def mask(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the mask into a tensordict of states ``[*B]``, e.g. ones made without the env."""
        active: Tensor = self.prior.active()
        if tensordict.device is not None:
            active = active.to(tensordict.device)
        shape = (*tensordict.batch_size, self.prior.num_skills)
        return tensordict.set(self.mask_key, active.expand(shape).clone())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.mask(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.mask(next_tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        number = self.prior.num_skills
        for key in () if self.parent is None else self.parent.action_keys:
            options = getattr(self.parent.full_action_spec[key].space, "n", number)
            if int(options) != number:
                raise ValueError(
                    f"SkillMaskTransform has a mask of {number} skills, but the action {key!r} has "
                    f"{int(options)} options. Build the OptionTransform with num_options={number}, "
                    "and append the mask after it."
                )
        shape = torch.Size([*observation_spec.shape, number])
        observation_spec[self.mask_key] = Binary(
            number, shape=shape, dtype=torch.bool, device=observation_spec.device
        )
        return observation_spec

    def _stays_outside(self) -> str | None:
        return "reads a prior that changes here, and not in copies of it"
