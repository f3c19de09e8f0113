"""Displacement since the current skill began."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Transform


class DisplacementTransform(Transform):
    r"""Writes how far an entry has moved since the current skill began.

    .. math:: \Delta_t = x_t - x_{t_0}, \qquad t_0 = \text{the step at which the skill was drawn}

    A discriminator that reads it tells skills apart by direction instead of place. The origin
    :math:`x_{t_0}` travels in the tensordict, so the env stays stateless. On the last transition of
    a mini-episode ``("next", "displacement")`` is measured from the old origin; the next root is
    zero again.

    Args:
        in_key (NestedKey): entry ``[*B, D]`` to measure. Default ``"position"``.
        out_key (NestedKey): entry ``[*B, D]`` to write, in the units of ``in_key``. Default
            ``"displacement"``.
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
        self.in_key = unravel_key(in_key)
        self.out_key = unravel_key(out_key)
        self.origin_key = unravel_key(origin_key)
        self.skill_step_key = None if skill_step_key is None else unravel_key(skill_step_key)
        super().__init__(in_keys=[self.in_key], out_keys=[self.out_key, self.origin_key])

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        position = tensordict_reset.get(self.in_key)
        partial = any(
            (key if isinstance(key, str) else key[-1]) == "_reset"
            for key in tensordict.keys(True, True)
        )
        origin = None if partial else tensordict.get(self.origin_key, None)
        if origin is None:
            origin = position.clone()
        tensordict_reset.set(self.origin_key, origin)
        tensordict_reset.set(self.out_key, position - origin)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        origin = tensordict.get(self.origin_key, None)
        if origin is None:
            raise KeyError(
                f"DisplacementTransform carries the origin in the tensordict, but "
                f"{self.origin_key!r} is missing from the one to step. Start from env.reset()."
            )
        next_tensordict.set(self.origin_key, origin)
        next_tensordict.set(self.out_key, next_tensordict.get(self.in_key) - origin)
        return next_tensordict

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

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "DisplacementTransform follows an env from step to step; stored data hold the "
            "displacement already. Append it to a TransformedEnv instead of a replay buffer."
        )

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        keys = set(observation_spec.keys(True, True))
        for key in (self.in_key, self.skill_step_key):
            if key is not None and key not in keys:
                raise KeyError(
                    f"DisplacementTransform reads {key!r}, which the env before it does not write; "
                    f"it writes {sorted(map(str, keys))}. Put it after the SkillTransform, or pass "
                    "skill_step_key=None to measure from the reset."
                )
        like = observation_spec[self.in_key]
        for key in (self.out_key, self.origin_key):
            observation_spec[key] = Unbounded(like.shape, dtype=like.dtype, device=like.device)
        return observation_spec

    def transform_state_spec(self, state_spec: TensorSpec) -> TensorSpec:
        like = self.parent.full_observation_spec[self.in_key]
        state_spec[self.origin_key] = Unbounded(like.shape, dtype=like.dtype, device=like.device)
        return state_spec

    def _check_batched_worker_compat(self) -> None:
        if self.skill_step_key is not None:
            raise RuntimeError(
                "DisplacementTransform moves its origin between two steps, which the workers of a "
                "SerialEnv or ParallelEnv do not do. Put it outside: "
                "TransformedEnv(ParallelEnv(n, make_env), Compose(SkillTransform(...), "
                "DisplacementTransform(...)))."
            )
