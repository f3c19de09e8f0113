"""The base of the losses: keys, weights of samples, reduction, running the networks they hold."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_hmcts.checks import instance, one_of, real_number
from torchrl_hmcts.modules.skill_mlp import SkillNetwork, entries

_Base: Any = LossModule if TYPE_CHECKING else object


class Reduction(_Base):
    """Weighs and reduces losses; for TorchRL's own losses as well as for :class:`Loss`."""

    tensor_keys: Any  # of the class's own _AcceptedKeys

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if hasattr(cls, "_AcceptedKeys"):
            cls.default_keys = cls._AcceptedKeys  # what set_keys(key=None) returns to

    def _maybe_get_priority_weight(self, tensordict: TensorDictBase) -> Tensor | None:
        # TorchRL's lookup refuses a nested key.
        if self.use_prioritized_weights not in (True, "auto"):
            return None
        return tensordict.get(self.tensor_keys.priority_weight, None)

    def _reduce(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights)

    def _average(self, diagnostic: Tensor) -> Tensor:
        diagnostic = diagnostic.detach()
        return diagnostic if self.reduction == "none" else diagnostic.mean()

    def _output(self, tensordict: TensorDictBase, losses: Mapping[str, Tensor]) -> TensorDict:
        batch_size = tensordict.batch_size if self.reduction == "none" else torch.Size([])
        return TensorDict(dict(losses), batch_size=batch_size)


class Loss(Reduction, LossModule):
    """Base of this package's losses; they define ``losses`` and ``_reads``."""

    @dataclass
    class _AcceptedKeys:
        priority_weight: NestedKey = "priority_weight"

    _in_keys: Any = None  # list of keys, or None until it is known

    def __init__(self, reduction: str = "mean") -> None:
        super().__init__()
        self.reduction = one_of(type(self).__name__, "reduction", reduction, REDUCTIONS)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Returns the reduced ``loss_*`` entries and detached diagnostics of transitions."""
        raise NotImplementedError

    def _reads(self) -> Iterable[NestedKey]:
        """Returns the keys that ``losses`` reads."""
        raise NotImplementedError

    def _set_in_keys(self) -> None:
        self._in_keys = list(dict.fromkeys(unravel_key(key) for key in self._reads()))

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that ``forward`` reads."""
        if self._in_keys is None:
            self._set_in_keys()
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns what :meth:`losses` does, as a TensorDict."""
        return self._output(tensordict, self.losses(tensordict))


REDUCTIONS = ("mean", "sum", "none")
DISTANCES = ("l2", "l1", "smooth_l1")


def without_terminal_entries(
    after: TensorDictBase, terminated: Tensor, keys: Iterable[NestedKey]
) -> TensorDictBase:
    """Returns a copy of what follows transitions, with zeros for the entries of terminal states.

    Nothing follows a terminal state, so its entries may be anything, NaN included; a product with
    zero would be NaN all the same, and its gradients too.
    """
    out = after.copy()
    terminated = terminated.reshape(out.batch_size)
    for key in keys:
        entry = out.get(key, None)
        if entry is not None and entry.is_floating_point():
            out.set(key, entry.masked_fill(expand_as_right(terminated, entry), 0.0))
    return out


def run_module(
    module: TensorDictModuleBase, params: TensorDictBase, tensordict: TensorDictBase
) -> TensorDictBase:
    """Returns what a module writes, run with ``params`` in place of its own parameters."""
    with params.to_module(module, preserve_module_state=False):
        return module(tensordict.select(*module.in_keys))


def output_of(
    module: TensorDictModuleBase, params: TensorDictBase, tensordict: TensorDictBase, key: NestedKey
) -> Tensor:
    """Returns one entry of :func:`run_module`, by the short way where there is one."""
    if takes_weights(module):
        return run_network(module, params, tensordict)
    return run_module(module, params, tensordict).get(key)


def takes_weights(module: TensorDictModuleBase) -> bool:
    """Returns whether :func:`run_network` can run a module."""
    plain = isinstance(module, SkillNetwork) and type(module).forward is SkillNetwork.forward
    network: Any = getattr(module, "network", None)
    return plain and hasattr(network, "run") and network.stackable


def run_network(module: SkillNetwork, params: TensorDictBase, tensordict: TensorDictBase) -> Tensor:
    """Returns the output of a module's network; of N stacked copies, with N first.

    Putting parameters into a module and taking them out again costs more than running a small
    network, so networks that can be handed their weights are.
    """
    network: Any = module.network
    weights: list[Tensor] = []  # be they trained, targets or detached; from fast to slow
    if hasattr(params, "parameters"):
        weights = list(params.parameters()) or list(params.buffers())
    weights = weights or list(params.values(True, True))
    return network.run(weights, *entries(module, tensordict, module.in_keys))


Discounting = TypeVar("Discounting", LossModule, ValueEstimatorBase)


def use_durations(
    module: Discounting,
    *,
    gamma: float | None = None,
    duration_key: NestedKey = "duration",
) -> Discounting:
    r"""Tell a loss or a value estimator to discount each macro-step by its base steps.

    .. math:: R + \gamma^k (1 - d) V(s')

    TorchRL's on-policy trainers estimate advantages by a ``GAE`` of their own: give them
    ``gae=use_durations(GAE(...))``. Call this again after each ``make_value_estimator``.

    Args:
        module (LossModule or ValueEstimatorBase): what discounts, e.g. a ``DQNLoss`` or a ``GAE``.
        gamma (float, optional): discount per base step, in ``(0, 1]``, for a loss, whose default
            value estimator is made with it. Default: that of the estimator it has.
        duration_key (NestedKey): base steps of a macro-step, int64 ``[*B, 1]``, under ``"next"``.

    Returns:
        The module.

    Raises:
        ValueError: if ``gamma`` is given for an estimator, which has its own.

    Reference:
        Sutton, Precup and Singh, "Between MDPs and semi-MDPs", 1999.

    Examples:
        >>> import torch
        >>> from torchrl.modules import ValueOperator
        >>> from torchrl.objectives.value import GAE
        >>> from torchrl_hmcts.objectives import use_durations
        >>> critic = ValueOperator(torch.nn.Linear(2, 1), in_keys=["velocity"])
        >>> gae = use_durations(GAE(gamma=0.99, lmbda=0.95, value_network=critic))
        >>> gae.tensor_keys.steps_to_next_obs
        ('next', 'duration')
    """
    instance("use_durations", "module", module, LossModule, ValueEstimatorBase)
    if gamma is not None:
        real_number("use_durations", "gamma", gamma, above=0.0, most=1.0)
        if isinstance(module, ValueEstimatorBase):
            raise ValueError(
                f"use_durations got gamma={gamma} for a {type(module).__name__}, which has its "
                f"own. Pass gamma where you make it."
            )
        module.make_value_estimator(gamma=gamma)
    # A loss makes one with its defaults where there is none.
    estimator = module if isinstance(module, ValueEstimatorBase) else module.value_estimator
    estimator.set_keys(steps_to_next_obs=unravel_key(("next", duration_key)))
    return module
