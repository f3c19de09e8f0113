"""Skills in an env: drawn in mini-episodes, and masked while they are switched off."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite

from torchrl_hmcts.checks import instance, nested_key, whole_number
from torchrl_hmcts.modules.skill_prior import SkillPrior, as_skill_prior
from torchrl_hmcts.modules.skill_spec import (
    Skills,
    as_skill_spec,
    draw_vectors,
    no_prior,
    number_of,
)
from torchrl_hmcts.nesting import given
from torchrl_hmcts.transforms.env_transform import EnvTransform, count_spec, zero_count


class SkillTransform(EnvTransform):
    r"""Samples a skill at reset and, mini-episode after mini-episode, again every few steps.

    .. math:: z \sim p(z) \quad \text{at reset and whenever } k \text{ steps were taken with it}

    Writes the skill, int64 ``[*B]`` or a vector ``[*B, D]``, and ``skill_step``, int64 ``[*B, 1]``,
    the base steps taken with it so far. On the last transition of a mini-episode ``("next",
    "skill")`` is still the skill that acted, for bootstrapping; the next root holds the new one.
    Episodes continue: nothing is done. A reset tensordict that holds a skill and no ``"_reset"``
    mask keeps its skill.

    Step by ``env.step_and_maybe_reset`` or ``env.rollout``, between whose steps new skills are
    drawn; for the same reason the transform goes outside of ``SerialEnv`` and ``ParallelEnv``.

    Args:
        num_skills (int or TensorSpec): number of skills ``Z``, or the spec of one skill that is a
            vector: a :class:`~torchrl_hmcts.modules.UnitSphere` (``D``), ``Bounded(low, high,
            shape=(D,))`` (even between the bounds) or ``Unbounded(shape=(D,))`` (normal).
        max_skill_steps (int, optional): base steps per mini-episode. Default: one skill per
            episode.
        skill_key, skill_step_key (NestedKey): entries of the skill and of the steps taken.
        prior (sequence of float, Tensor or SkillPrior, optional): probabilities ``[Z]`` of the
            skills, normalised and kept as the buffer ``prior``. Default: uniform, or as the spec of
            vectors says. A :class:`~torchrl_hmcts.modules.SkillPrior` stays its owner's and is read
            at every step: where the skill in use was switched off, the mini-episode ends.
        seed (int, optional): seed of an own generator, whose state is saved in the state dict.
            Default: torch's global generator.

    Raises:
        ValueError: if a prior is given for vectors, or is no distribution over the skills.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070; Bartley 2023, ch. 4
        (mini-episodes of 100 steps).

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_hmcts.transforms import SkillTransform
        >>> env = TransformedEnv(GymEnv("CartPole-v1"), SkillTransform(4, max_skill_steps=3))
        >>> env.rollout(7, break_when_any_done=False)["skill_step"].flatten().tolist()
        [0, 1, 2, 0, 1, 2, 0]
    """

    prior: Tensor | None
    skill_prior: SkillPrior | None

    def __init__(
        self,
        num_skills: Skills,
        max_skill_steps: int | None = None,
        *,
        skill_key: NestedKey = "skill",
        skill_step_key: NestedKey = "skill_step",
        prior: SkillPrior | Sequence[float] | Tensor | None = None,
        seed: int | None = None,
    ) -> None:
        self.skill_spec = as_skill_spec("SkillTransform", num_skills)
        self.num_skills = number_of(self.skill_spec)
        if self.num_skills is None and prior is not None:
            raise ValueError(no_prior("SkillTransform", self.skill_spec))
        self.max_skill_steps: int | None = None
        if max_skill_steps is not None:
            self.max_skill_steps = whole_number(
                "SkillTransform", "max_skill_steps", max_skill_steps, least=1
            )
        self.skill_key = nested_key("SkillTransform", "skill_key", skill_key)
        self.skill_step_key = nested_key("SkillTransform", "skill_step_key", skill_step_key)
        super().__init__(in_keys=[], out_keys=[self.skill_key, self.skill_step_key])
        live = isinstance(prior, SkillPrior)
        made = None
        if prior is not None and self.num_skills is not None:
            made = as_skill_prior("SkillTransform", prior, self.num_skills)
        # Past nn.Module.__setattr__: a sub-module would be saved and moved with the env.
        self.__dict__["skill_prior"] = made if live else None
        self.register_buffer("prior", None if live or made is None else made.probs())
        self.generator: torch.Generator | None = None
        if seed is not None:
            self.set_seed(whole_number("SkillTransform", "seed", seed))

    def set_seed(self, seed: int) -> None:
        """Gives the transform its own generator, seeded with ``seed``."""
        self.generator = torch.Generator()
        self.generator.manual_seed(seed)

    def sample(self, shape: Sequence[int], device: torch.device | None = None) -> Tensor:
        """Returns skills drawn from p(z), int64 of the given shape; vectors of ``[*shape, D]``."""
        if self.num_skills is None:
            vectors = draw_vectors(self.skill_spec, shape, self.generator)
            return vectors if device is None else vectors.to(device)
        prior = self.prior
        if self.skill_prior is not None:
            prior = self.skill_prior.probs().detach()
        if prior is None:
            skill = torch.randint(self.num_skills, tuple(shape), generator=self.generator)
        else:
            count = torch.Size(shape).numel()
            skill = torch.multinomial(
                prior.to("cpu"), count, replacement=True, generator=self.generator
            )
            skill = skill.view(tuple(shape))
        return skill if device is None else skill.to(device)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        skill = given(tensordict, self.skill_key)
        step = None if skill is None else tensordict.get(self.skill_step_key, None)
        if skill is None:
            skill = self.sample(tensordict_reset.batch_size, tensordict_reset.device)
        if step is None:
            step = zero_count(tensordict_reset)
        tensordict_reset.set(self.skill_key, skill)
        return tensordict_reset.set(self.skill_step_key, step)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict.set(self.skill_key, tensordict[self.skill_key])
        step = tensordict[self.skill_step_key]
        return next_tensordict.set(self.skill_step_key, step + 1)

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        if self.max_skill_steps is None and self.skill_prior is None:
            return tensordict, tensordict_
        step = tensordict_.get(self.skill_step_key)
        skill = tensordict_.get(self.skill_key)
        if self.max_skill_steps is None:
            ended = torch.zeros_like(step, dtype=torch.bool)
        else:
            ended = step >= self.max_skill_steps  # [*B, 1]
        if self.skill_prior is not None:
            off = ~self.skill_prior.active().to(skill.device)
            ended = ended | off[skill].unsqueeze(-1)
        if ended.any():
            # New tensors: the old ones are also the ("next", ...) entries of the transition.
            fresh = self.sample(step.shape[:-1], skill.device)
            began = ended if self.num_skills is None else ended.squeeze(-1)
            tensordict_.set(self.skill_key, torch.where(began, fresh, skill))
            tensordict_.set(self.skill_step_key, step.masked_fill(ended, 0))
        return tensordict, tensordict_

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        shape, device = state_spec.shape, state_spec.device
        state_spec[self.skill_key] = self.skill_spec.expand(*shape, *self.skill_spec.shape).to(
            device
        )
        state_spec[self.skill_step_key] = count_spec(state_spec)
        if self.max_skill_steps is not None:
            state_spec[self.skill_step_key] = Bounded(
                0, self.max_skill_steps, shape=(*shape, 1), dtype=torch.int64, device=device
            )
        return state_spec

    transform_observation_spec = transform_state_spec

    def _stays_outside(self) -> str | None:
        draws = self.max_skill_steps is not None or self.skill_prior is not None
        return "draws new skills between two steps" if draws else None

    def get_extra_state(self) -> dict[str, Tensor]:
        """Returns the state of its own generator, if it has one, for the state dict."""
        return {} if self.generator is None else {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Sets its own generator to a saved state."""
        if "generator" in state:
            if self.generator is None:
                self.generator = torch.Generator()
            self.generator.set_state(state["generator"])


class SkillMaskTransform(EnvTransform):
    r"""Writes which options may be taken: those whose skill the prior has switched on.

    .. math:: \text{mask}(z) = [\,p(z) > 0\,]

    Append it after the :class:`OptionTransform` of an env whose options are skills.
    :class:`~torchrl_hmcts.planners.MCTSPlanner` reads the entry; TorchRL's ``ActionMask`` behind it
    restricts random actions, too. The prior is read at every step and stays its owner's.

    Args:
        prior (SkillPrior): over the skills, one per option, ``Z``.
        mask_key (NestedKey): entry to write, bool ``[*B, Z]``.

    Raises:
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
        >>> options = OptionTransform(TensorDictModule(lambda z: z, ["skill"], ["action"]), 2, 4)
        >>> env = TransformedEnv(ChainEnv(), Compose(options, SkillMaskTransform(prior)))
        >>> env.reset()["action_mask"].tolist()
        [True, False]
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
