"""Calls of torch and tensordict without their bookkeeping, where a search makes thousands."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor


def is_plain(module: TensorDictModuleBase) -> bool:
    """Return whether a module does nothing but call its network on its inputs, in their order."""
    return (
        isinstance(module, TensorDictModule)
        and type(module).forward is TensorDictModule.forward
        and module._kwargs is None  # no public name tells that the inputs go by keyword
        and module.method is None
        and not module.method_kwargs
    )


def has_hooks(module: TensorDictModuleBase) -> bool:
    """Return whether a call of the module does more than its ``forward``."""
    # torch has no public name for the hooks that somebody has registered.
    return bool(module._forward_hooks or module._forward_pre_hooks)


def put(td: TensorDictBase, key: NestedKey, value: Tensor) -> None:
    """Set an entry of the right shape and device; ``td.set`` checks both at five times the cost."""
    if isinstance(key, str):
        td._set_str(key, value, validated=True, inplace=False, non_blocking=False)
    else:
        td.set(key, value)


def entry(td: TensorDictBase, key: NestedKey) -> Tensor | None:
    """Return an entry or None; ``td.get`` unravels its key at ten times the cost of a look-up."""
    found: Tensor | None = td._get_str(key, None) if isinstance(key, str) else td.get(key, None)
    return found
