"""Masks of the base actions, under a name that is not that of the options' masks."""

from __future__ import annotations

from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torchrl.data import Composite
from torchrl.envs import EnvBase

from torchrl_hmcts.nesting import parts

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
