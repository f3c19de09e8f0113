"""Networks that can be called on tensors, without the bookkeeping of their TensorDictModule."""

from __future__ import annotations

from tensordict.nn import TensorDictModule, TensorDictModuleBase


def is_plain(module: TensorDictModuleBase) -> bool:
    """Return whether a module does nothing but call its network on its inputs, in their order."""
    return (
        isinstance(module, TensorDictModule)
        and type(module).forward is TensorDictModule.forward
        and type(module)._call_module is TensorDictModule._call_module
        and module._kwargs is None
        and module.method is None
        and not module.method_kwargs
        and not module._get_kwargs
    )
