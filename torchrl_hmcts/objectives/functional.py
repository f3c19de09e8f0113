"""Running a module with the parameters that a loss holds of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor

from torchrl_hmcts.modules.skill_mlp import SkillNetwork, entries


def without_terminal_entries(
    next_tensordict: TensorDictBase, terminated: Tensor, keys: Iterable[NestedKey]
) -> TensorDictBase:
    """Returns a copy of what follows transitions, with zeros for the entries of terminal states.

    Nothing follows a terminal state, so its entries may be anything, NaN included; a product with
    zero would be NaN all the same, and its gradients too.
    """
    out = next_tensordict.copy()
    terminated = terminated.reshape(out.batch_size)
    for key in keys:
        entry = out.get(key, None)
        if entry is not None and entry.is_floating_point():
            out.set(key, entry.masked_fill(expand_as_right(terminated, entry), 0.0))
    return out


def run_module(
    module: TensorDictModuleBase,
    params: TensorDictBase,
    tensordict: TensorDictBase,
    key: NestedKey,
) -> Tensor:
    """Returns what a module writes to a key, run with ``params`` in place of its own parameters.

    Putting parameters into a module and taking them out again costs more than running a small
    network, so networks that can be handed their weights are.
    """
    if takes_weights(module):
        return run_network(module, params, tensordict)
    with params.to_module(module, preserve_module_state=False):
        return module(tensordict.select(*module.in_keys)).get(key)


def takes_weights(module: TensorDictModuleBase) -> bool:
    """Returns whether :func:`run_network` can run a module."""
    plain = isinstance(module, SkillNetwork) and type(module).forward is SkillNetwork.forward
    network: Any = getattr(module, "network", None)
    return plain and hasattr(network, "run") and network.stackable


def run_network(module: SkillNetwork, params: TensorDictBase, tensordict: TensorDictBase) -> Tensor:
    """Returns the output of a module's network; of N stacked copies, with N first."""
    network: Any = module.network
    inputs = entries(module, tensordict, module.in_keys)
    return network.run(weights_of(params), *inputs)


def weights_of(params: TensorDictBase) -> list[Tensor]:
    """Returns the tensors of parameters, be they trained, targets or detached."""
    # Three ways, from fast to slow.
    weights: list[Tensor] = []
    if hasattr(params, "parameters"):
        weights = list(params.parameters()) or list(params.buffers())
    return weights or list(params.values(True, True))
