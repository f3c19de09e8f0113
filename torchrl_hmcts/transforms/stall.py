"""Base steps for which an entry has not moved: an option is stuck."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite

from torchrl_hmcts.checks import nested_key, real_number
from torchrl_hmcts.transforms.env_transform import EnvTransform, count_spec, zero_count


class StallTransform(EnvTransform):
    r"""Counts the consecutive base steps in which an entry has not moved.

    .. math::

        n_{t+1} = \begin{cases} n_t + 1 & \text{if } \lVert x_{t+1} - x_t \rVert < \epsilon \\
        0 & \text{else} \end{cases}

    Put it before the :class:`OptionTransform`; a :class:`~torchrl_hmcts.modules.StallTermination`
    then ends an option when :math:`n` is large enough. The count is kept in the tensordict, so the
    env stays stateless. It is not part of the state: if a tensordict has none, e.g. a state to plan
    from, the count begins at 0. Plans do not depend on that, since the termination only counts
    steps of the present option.

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
        self.tolerance = real_number("StallTransform", "tolerance", tolerance, least=0.0)
        self.in_key = nested_key("StallTransform", "in_key", in_key)
        self.out_key = nested_key("StallTransform", "out_key", out_key)
        super().__init__(in_keys=[self.in_key], out_keys=[self.out_key])

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.set(self.out_key, zero_count(tensordict_reset))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before, after = self._carried(tensordict, self.in_key), next_tensordict.get(self.in_key)
        still = _distance(before, after, next_tensordict.batch_dims) < self.tolerance
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


def _distance(before: Tensor, after: Tensor, batch_dims: int) -> Tensor:
    """Euclidean distance over all but the batch dimensions, ``[*B, 1]``."""
    shape = (*after.shape[:batch_dims], -1)
    difference = (after - before).reshape(shape)
    if not difference.is_floating_point():
        difference = difference.to(torch.get_default_dtype())
    return torch.linalg.vector_norm(difference, dim=-1, keepdim=True)
