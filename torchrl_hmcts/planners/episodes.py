"""Starts of episodes, as a policy can see them in the tensordicts it is given.

Letters: *B batch of the tensordict.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor


class EpisodeStarts:
    """Tells in which elements an episode began since the policy acted last.

    TorchRL's env writes what a step led to under ``"next"`` of the tensordict that the policy has
    written to. Where that was the end, or another state than the one to act in now, the env was
    reset or set to a state in between. ``"is_init"`` and a ``"step_count"`` of 0 say so by
    themselves.

    Args:
        state_keys: entries that are compared; empty for all that a step wrote.
        plan_keys: what the policy carries in the tensordict. Elements in which they are not what it
            wrote last belong to another rollout.
    """

    def __init__(self, state_keys: Sequence[NestedKey], plan_keys: Sequence[NestedKey]) -> None:
        self.state_keys, self.plan_keys = list(state_keys), list(plan_keys)
        self.forget()

    def forget(self) -> None:
        """Take the next call for that of another rollout."""
        self._acted: TensorDictBase | None = None
        self._stale: TensorDictBase | None = None  # what was under "next" already
        self._wrote: dict[NestedKey, Tensor] = {}

    def remember(self, td: TensorDictBase) -> None:
        """Keep the tensordict that the policy has written to, for what a step makes of it."""
        self._acted, self._stale = td, td.get("next", None)
        self._wrote = {key: td.get(key) for key in self.plan_keys}

    def seen(self, td: TensorDictBase) -> Tensor:
        """Return where an episode began, bool ``[*B]``."""
        shape = td.batch_size
        begins = torch.zeros(shape, dtype=torch.bool, device=td.device)
        is_init, count = td.get("is_init", None), td.get("step_count", None)
        if is_init is not None:
            begins = begins | is_init.reshape(shape)
        if count is not None and count.numel() == shape.numel():
            begins = begins | (count.reshape(shape) == 0)
        led_to = None if self._acted is None else self._acted.get("next", None)
        if led_to is None or led_to is self._stale or led_to.batch_size != shape:
            return begins
        done = led_to.get("done", None)
        other = torch.zeros_like(begins) if done is None else _any(done, shape)
        for key in self.state_keys or led_to.keys(True, True):
            one, two = led_to.get(key, None), td.get(key, None)
            if isinstance(one, Tensor) and isinstance(two, Tensor) and one.shape == two.shape:
                nan = (one != one) & (two != two)
                other = other | _any((one != two) & ~nan, shape)
        for key, wrote in self._wrote.items():
            carried = td.get(key, None)
            if carried is None or carried.shape != wrote.shape:
                return begins
            other = other & ~_any(carried != wrote, shape)
        return begins | other


def _any(flags: Tensor, shape: torch.Size) -> Tensor:
    """Whether any flag of an element is set, bool ``[*B]``."""
    return flags.reshape(*shape, -1).any(-1)
