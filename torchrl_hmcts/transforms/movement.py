"""How far an entry has moved since the skill began, and for how long it has not moved."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Composite, Unbounded

from torchrl_hmcts.checks import nested_key, real_number
from torchrl_hmcts.nesting import given
from torchrl_hmcts.transforms.env_transform import EnvTransform, count_spec, zero_count


class DisplacementTransform(EnvTransform):
    r"""Writes how far an entry has moved since the current skill began.

    .. math:: \Delta_t = x_t - x_{t_0}, \qquad t_0 = \text{the step at which the skill was drawn}

    A discriminator that reads it tells skills apart by direction instead of place. The origin is
    kept in the tensordict. On the last transition of a mini-episode ``("next", "displacement")`` is
    measured from the old origin; the next root is zero again.

    Args:
        in_key (NestedKey): entry ``[*B, D]`` to measure.
        out_key, origin_key (NestedKey): entries ``[*B, D]`` to write, in the units of ``in_key``.
        skill_step_key (NestedKey, optional): the entry :class:`SkillTransform` counts in; an origin
            moves where it is zero. ``None`` measures from the reset.

    Raises:
        KeyError: when the specs are made, if an entry is missing: the transform goes after the
            :class:`SkillTransform`.

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
        origin = tensordict[self.origin_key]
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


class StallTransform(EnvTransform):
    r"""Counts the consecutive base steps in which an entry has not moved.

    .. math::

        n_{t+1} = \begin{cases} n_t + 1 & \text{if } \lVert x_{t+1} - x_t \rVert < \epsilon \\
        0 & \text{else} \end{cases}

    Put it before the :class:`OptionTransform`; a :class:`~torchrl_hmcts.modules.StallTermination`
    then ends an option when :math:`n` is large enough. The count is no part of the state: it begins
    at 0 in a state to plan from.

    Args:
        in_key (NestedKey): entry ``[*B, ...]`` that should move.
        tolerance (float): distance (Euclidean, over all but the batch dimensions), in the units of
            ``in_key``, below which a base step is no movement. At 0 nothing counts.
        out_key (NestedKey): entry of the count, int64 ``[*B, 1]``.

    Raises:
        KeyError: when the specs are made, if the env has no ``in_key``.

    Reference:
        This project's.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_hmcts.modules import StallTermination
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> from torchrl_hmcts.transforms import OptionTransform, StallTransform
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> env = TransformedEnv(ChainEnv(length=9), Compose(
        ...     StallTransform("state", tolerance=0.5),
        ...     OptionTransform(worker, 2, 50, termination=StallTermination(2))))
        >>> td = env.reset().set("state", torch.tensor(3)).set("option", torch.tensor(0))
        >>> td = env.step(td)  # three steps to the left end, and two in which nothing changes
        >>> td["next", "duration"].item(), td["next", "stalled_steps"].item()
        (5, 2)
    """

    def __init__(
        self,
        in_key: NestedKey = "position",
        tolerance: float = 1e-3,
        out_key: NestedKey = "stalled_steps",
    ) -> None:
        self.tolerance = real_number("StallTransform", "tolerance", tolerance, least=0.0)
        self.in_key = nested_key("StallTransform", "in_key", in_key)
        self.out_key = nested_key("StallTransform", "out_key", out_key)
        super().__init__(in_keys=[self.in_key], out_keys=[self.out_key])

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.set(self.out_key, zero_count(tensordict_reset))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before, after = tensordict[self.in_key], next_tensordict.get(self.in_key)
        moved = (after - before).reshape(*next_tensordict.batch_size, -1)
        if not moved.is_floating_point():
            moved = moved.to(torch.get_default_dtype())
        still = torch.linalg.vector_norm(moved, dim=-1, keepdim=True) < self.tolerance
        count = tensordict.get(self.out_key, None)
        count = still if count is None else (count + 1) * still
        return next_tensordict.set(self.out_key, count.to(torch.int64))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        states = self.parent.full_state_spec.keys(True, True)
        self._require([*observation_spec.keys(True, True), *states], self.in_key)
        observation_spec[self.out_key] = count_spec(observation_spec)
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        # A step reads the entry, so that a planner has to keep it with the state.
        if self.in_key not in state_spec.keys(True, True):
            state_spec[self.in_key] = self.parent.full_observation_spec[self.in_key].clone()
        return state_spec
