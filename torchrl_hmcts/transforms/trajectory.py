"""Entries of an option: its base transitions as a padded block, and masks of base actions.

Letters: *B batch of the tensordict, T base steps an option can take at most.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_hmcts.nesting import parts


class OptionTrajectory:
    """Collects chosen entries of an option's base transitions into a tensordict ``[*B, T]``."""

    KEY = "trajectory"
    MASK_KEY = "mask"

    data: TensorDictBase

    def __init__(self, keys: Sequence[NestedKey], max_steps: int) -> None:
        self.keys = [unravel_key(key) for key in keys]
        self.max_steps = max_steps
        if not self.keys:
            raise ValueError(
                "trajectory_keys is empty, so that nothing would be recorded. Name the entries, "
                'e.g. ["observation", "action", ("next", "reward")], or pass None.'
            )

    def make_spec(
        self,
        env: EnvBase,
        root: TensorDictBase,
        memory: Mapping[NestedKey, Tensor],
    ) -> Composite:
        """Return the spec of the block, ``[*B, T]``, of the env's and the worker's entries."""
        after = env.full_observation_spec.clone()
        after.update(env.full_reward_spec)
        after.update(env.full_done_spec)
        shape, ndim = (*env.batch_size, self.max_steps), len(env.batch_size)
        known = {unravel_key(k): (v.shape[ndim:], v.dtype) for k, v in root.items(True, True)}
        for key, leaf in after.items(True, True):
            known[unravel_key(("next", key))] = (leaf.shape[ndim:], leaf.dtype)
        for key, first in memory.items():
            known[unravel_key(("next", key))] = (first.shape, first.dtype)
        spec = Composite(shape=shape, device=env.device)
        for key in self.keys:
            if key not in known:
                raise ValueError(
                    f"trajectory_keys names {key!r}, which is no entry of a base transition of "
                    f"{type(env.base_env).__name__}. Entries: {sorted(map(str, known))}."
                )
            event, dtype = known[key]
            # Not the entry's own bounds: the zeros after an option's end need not lie in them.
            kind = Binary if dtype == torch.bool else Unbounded
            spec[key] = kind(shape=(*shape, *event), dtype=dtype, device=env.device)
        spec[self.MASK_KEY] = Binary(shape=shape, dtype=torch.bool, device=env.device)
        return spec

    def start(self, spec: Composite, batch_size: torch.Size) -> OptionTrajectory:
        """Return a trajectory of its own with a block of zeros for ``batch_size`` options."""
        new = OptionTrajectory(self.keys, self.max_steps)
        ndim = len(spec.shape) - 1  # the options need not have the batch size of the env
        new.data = TensorDict(batch_size=(*batch_size, self.max_steps), device=spec.device)
        for key, leaf in spec.items(True, True):
            shape = (*batch_size, *leaf.shape[ndim:])
            new.data.set(key, torch.zeros(shape, dtype=leaf.dtype, device=leaf.device))
        return new

    def write(
        self, taken: int, rows: Tensor | None, root: TensorDictBase, after: TensorDictBase
    ) -> None:
        """Write what ``taken`` steps into the option happened; ``rows``: indices, a mask or all."""
        lead = self.data.batch_dims - 1
        index = ... if rows is None else rows
        for key in self.keys:
            is_next = isinstance(key, tuple) and key[0] == "next"
            value = after.get(key[1:]) if is_next else root.get(key)
            if rows is not None and rows.dtype == torch.bool:
                value = value[rows]
            self.data.get(key).select(lead, taken)[index] = value
        self.data.get(self.MASK_KEY).select(lead, taken)[index] = True


_CONVENTION = "action_mask"  # TorchRL's name


class BaseMasks:
    """Renames the masks of an env's actions, ``"action_mask"`` to ``"base_action_mask"``.

    Above an OptionTransform the action is the option, and ``"action_mask"`` is the mask of the
    options. Below it, worker, termination and env read the base env's mask.
    """

    def __init__(self, env: EnvBase) -> None:
        shown = list(map(unravel_key, env.full_observation_spec.keys(True, True)))
        self.renamed: dict[NestedKey, NestedKey] = {}
        for key in shown:
            *path, last = parts(key)
            if last == _CONVENTION:
                while (new := unravel_key((*path, f"base_{last}"))) in shown:
                    last = f"base_{last}"
                self.renamed[key] = new

    def hide(self, td: TensorDictBase) -> TensorDictBase:
        """Rename the base masks in the env's output, for the parts above; in place."""
        for key, new in self.renamed.items():
            mask = td.pop(key, None)
            if mask is not None:
                td.set(new, mask)
        return td

    def show(self, td: TensorDictBase) -> TensorDictBase:
        """Write them under their own name too, for the env and the worker; in place."""
        for key, new in self.renamed.items():
            mask = td.get(new, None)
            if mask is not None:
                td.set(key, mask)
        return td

    def hide_specs(self, spec: Composite) -> Composite:
        """Rename them in a spec; in place."""
        for key, new in self.renamed.items():
            if key in spec.keys(True, True):
                spec[new] = spec[key]
                del spec[key]
        return spec
