"""How long an entry has not moved: the base steps an option is stuck."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform


class StallTransform(Transform):
    r"""Counts the consecutive base steps in which an entry has not moved.

    .. math::

        n_{t+1} = \begin{cases} n_t + 1 & \text{if } \lVert x_{t+1} - x_t \rVert < \epsilon \\
        0 & \text{else} \end{cases}

    Put it before the :class:`OptionTransform`, whose option a
    :class:`~torchrl_hmcts.modules.StallTermination` then ends when :math:`n` is large enough. The
    count travels in the tensordict, so the env stays stateless. It is a read-out, not part of the
    state: where a tensordict has none, e.g. a state to plan from, the count begins at 0, and since
    the termination never looks behind the beginning of an option, plans are the same with it.

    Args:
        in_key (NestedKey): entry ``[*B, ...]`` that should move. Default ``"position"``.
        tolerance (float): distance (Euclidean, over all but the batch dimensions), in the units of
            ``in_key``, below which a base step is no movement. At 0 nothing counts.
        out_key (NestedKey): entry of the count, int64 ``[*B, 1]``. Default ``"stalled_steps"``.

    Raises:
        ValueError: if ``tolerance`` is negative or not finite.
        KeyError: when the specs are made, if the env has no ``in_key``; when stepping, if it is
            missing from the tensordict.

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
        if not (math.isfinite(tolerance) and tolerance >= 0.0):
            raise ValueError(
                f"StallTransform needs a tolerance >= 0, a distance in units of {in_key!r} per "
                f"base step; got {tolerance}. Use e.g. a tenth of what a usual step moves."
            )
        self.in_key = unravel_key(in_key)
        self.out_key = unravel_key(out_key)
        super().__init__(in_keys=[self.in_key], out_keys=[self.out_key])
        self.tolerance = float(tolerance)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shape, device = tensordict_reset.batch_size, tensordict_reset.device
        zero = torch.zeros((*shape, 1), dtype=torch.int64, device=device)
        return tensordict_reset.set(self.out_key, zero)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before = tensordict.get(self.in_key, None)
        if before is None:
            raise KeyError(
                f"StallTransform compares {self.in_key!r} before and after a step, but it is "
                f"missing from the tensordict to step. Start from env.reset()."
            )
        after = next_tensordict.get(self.in_key)
        moved = _distance(before, after, next_tensordict.batch_dims)
        count = tensordict.get(self.out_key, None)
        still = (moved < self.tolerance).to(torch.int64)
        next_tensordict.set(self.out_key, still if count is None else (count + 1) * still)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Not defined: the count follows an env from step to step."""
        raise RuntimeError(
            "StallTransform follows an env from step to step; stored data hold the count already. "
            "Append it to a TransformedEnv instead of a replay buffer."
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        keys = {*observation_spec.keys(True, True), *self.parent.full_state_spec.keys(True, True)}
        if self.in_key not in set(map(unravel_key, keys)):
            raise KeyError(
                f"StallTransform reads {self.in_key!r}, which the env before it does not have; it "
                f"has {sorted(map(str, keys))}. Pass one of them as in_key."
            )
        observation_spec[self.out_key] = Unbounded(
            (*observation_spec.shape, 1), dtype=torch.int64, device=observation_spec.device
        )
        return observation_spec

    def transform_state_spec(self, state_spec: TensorSpec) -> TensorSpec:
        # A step reads the entry, so that a planner has to keep it with the state.
        if self.in_key not in set(map(unravel_key, state_spec.keys(True, True))):
            state_spec[self.in_key] = self.parent.full_observation_spec[self.in_key].clone()
        return state_spec


def _distance(before: Tensor, after: Tensor, batch_dims: int) -> Tensor:
    """Euclidean distance over all but the batch dimensions, ``[*B, 1]``."""
    shape = (*after.shape[:batch_dims], -1)
    difference = (after - before).reshape(shape)
    if not difference.is_floating_point():
        difference = difference.to(torch.get_default_dtype())
    return torch.linalg.vector_norm(difference, dim=-1, keepdim=True)
