"""Envs with a state of their own as simulators: set to some states, stepped, set to the next.

Letters: ``m`` states of one call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_hmcts.direct_calls import put
from torchrl_hmcts.nesting import flat_transforms, set_states, step_states


class Turns:
    """Steps an env from any number of states, as many at a time as it holds."""

    def __init__(
        self,
        env: EnvBase,
        state_keys: Sequence[NestedKey],
        option_key: NestedKey,
        encode: Callable[[Tensor], Tensor],
    ) -> None:
        self.env, self.state_keys = env, state_keys
        self.option_key, self.encode = option_key, encode
        last = flat_transforms(env)[-1:] if type(env) is TransformedEnv else []
        self._run_from = getattr(last[0], "run_from", None) if last else None

    def step(self, states: TensorDictBase, options: Tensor) -> TensorDictBase:
        """Take the options ``[m]``, which ``states`` holds encoded; return what comes next."""
        env, m = self.env, len(states)
        if not env.batch_dims:
            return self._step_one_by_one(states, options)
        size = env.batch_size.numel()
        parts = []
        for begin in range(0, m, size):
            rows = torch.arange(begin, begin + size).clamp_max(m - 1)  # the last one fills up
            part = states[rows].reshape(env.batch_size)
            before = env.reset(part.select(*self.state_keys), set_state=True)
            # A reset sets what transforms keep in the tensordict, e.g. a step count, back to 0.
            after = env.step(before.update(part)).get("next")
            parts.append(after.reshape(-1)[: min(size, m - begin)])
        return torch.cat(parts) if len(parts) > 1 else parts[0]

    def _step_one_by_one(self, states: TensorDictBase, options: Tensor) -> TensorDictBase:
        parts = []
        alone = states.select(*self.state_keys).unbind(0)
        for state, option in zip(alone, options, strict=True):
            after = None if self._run_from is None else self._run_from(state, option)
            if after is None:
                root = set_states(self.env, state).update(state)
                put(root, self.option_key, self.encode(option))
                after = step_states(self.env, root)
            parts.append(after)
        stacked: TensorDictBase = torch.stack(parts)
        return stacked

    def leave(self, td: TensorDictBase, continues: Tensor) -> None:
        """Set the env back to ``td`` where an episode continues, bool ``[*B, 1]``."""
        if continues.any():  # a state at its end is reset by whoever acts
            state = td.select(*self.state_keys)
            if not continues.all():
                for key in self.env.reset_keys:
                    state.set(key, continues.to(self.env.device))
            self.env.reset(state, set_state=True)
