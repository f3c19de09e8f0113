"""Displacement since the current skill began."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Composite, Unbounded

from torchrl_hmcts.checks import nested_key
from torchrl_hmcts.nesting import given
from torchrl_hmcts.transforms.env_transform import EnvTransform


class DisplacementTransform(EnvTransform):
    r"""Writes how far an entry has moved since the current skill began.

    .. math:: \Delta_t = x_t - x_{t_0}, \qquad t_0 = \text{the step at which the skill was drawn}

    A discriminator that reads it tells skills apart by direction instead of place. The origin
    :math:`x_{t_0}` is kept in the tensordict, so the env stays stateless. On the last transition of
    a mini-episode ``("next", "displacement")`` is measured from the old origin; the next root is
    zero again.

    Args:
        in_key (NestedKey): entry ``[*B, D]`` to measure. Default ``"position"``.
        out_key (NestedKey): entry ``[*B, D]`` to write, in the units of ``in_key``.
        origin_key (NestedKey): entry ``[*B, D]`` of the origin. Default ``"origin"``.
        skill_step_key (NestedKey, optional): the entry :class:`SkillTransform` counts in; an origin
            moves where it is zero. Default ``"skill_step"``. ``None`` measures from the reset.

    Raises:
        KeyError: when the specs are made, if ``in_key`` or ``skill_step_key`` is missing: the
            transform goes after the :class:`SkillTransform`.

    Reference:
        Bartley 2023, section 4.2; the choice of displacement is this project's.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv, Compose
        >>> from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform
        >>> env = TransformedEnv(GymEnv("CartPole-v1"), Compose(
        ...     SkillTransform(4, max_skill_steps=3), DisplacementTransform("observation")))
        >>> data = env.rollout(4, break_when_any_done=False)
        >>> bool((data["displacement"][3] == 0).all())
        True
        >>> bool((data["next", "displacement"][2] == 0).all())
        False
    """

    def __init__(
        self,
        in_key: NestedKey = "position",
        out_key: NestedKey = "displacement",
        *,
        origin_key: NestedKey = "origin",
        skill_step_key: NestedKey | None = "skill_step",
    ) -> None:
        self.in_key = nested_key("DisplacementTransform", "in_key", in_key)
        self.out_key = nested_key("DisplacementTransform", "out_key", out_key)
        self.origin_key = nested_key("DisplacementTransform", "origin_key", origin_key)
        self.skill_step_key: NestedKey | None = None
        if skill_step_key is not None:
            self.skill_step_key = nested_key(
                "DisplacementTransform", "skill_step_key", skill_step_key
            )
        super().__init__(in_keys=[self.in_key], out_keys=[self.out_key, self.origin_key])

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        position = tensordict_reset.get(self.in_key)
        origin = given(tensordict, self.origin_key)
        if origin is None:
            origin = position.clone()
        tensordict_reset.set(self.origin_key, origin)
        return tensordict_reset.set(self.out_key, position - origin)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        origin = self._carried(tensordict, self.origin_key)
        next_tensordict.set(self.origin_key, origin)
        return next_tensordict.set(self.out_key, next_tensordict.get(self.in_key) - origin)

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        if self.skill_step_key is None:
            return tensordict, tensordict_
        began = tensordict_.get(self.skill_step_key) == 0  # [*B, 1]
        if began.any():
            position = tensordict_.get(self.in_key)
            origin = torch.where(began, position, tensordict_.get(self.origin_key))
            tensordict_.set(self.origin_key, origin)
            tensordict_.set(self.out_key, position - origin)
        return tensordict, tensordict_

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        read = [key for key in (self.in_key, self.skill_step_key) if key is not None]
        self._require(
            observation_spec.keys(True, True),
            *read,
            advice="Put it after the SkillTransform, or pass skill_step_key=None to measure from "
            "the reset.",
        )
        like = observation_spec[self.in_key]
        for key in (self.out_key, self.origin_key):
            observation_spec[key] = Unbounded(like.shape, dtype=like.dtype, device=like.device)
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        like = self.parent.full_observation_spec[self.in_key]
        state_spec[self.origin_key] = Unbounded(like.shape, dtype=like.dtype, device=like.device)
        return state_spec

    def _stays_outside(self) -> str | None:
        return None if self.skill_step_key is None else "moves its origin between two steps"
