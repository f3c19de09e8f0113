"""Discounting macro-steps by their durations in TorchRL's estimators."""

from __future__ import annotations

from typing import TypeVar

from tensordict.utils import NestedKey, unravel_key
from torchrl.objectives import LossModule
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_hmcts.checks import instance, real_number

Discounting = TypeVar("Discounting", LossModule, ValueEstimatorBase)


def use_durations(
    module: Discounting,
    *,
    gamma: float | None = None,
    duration_key: NestedKey = "duration",
) -> Discounting:
    r"""Tell a loss or a value estimator to discount each macro-step by its base steps.

    .. math:: R + \gamma^k (1 - d) V(s')

    TorchRL's on-policy trainers (``PPOTrainer``, ``A2CTrainer``, ``ReinforceTrainer``) estimate
    advantages by a ``GAE`` of their own, which does not know the loss's setting: give them
    ``gae=use_durations(GAE(...))``. A later ``make_value_estimator`` makes an estimator that does
    not know durations; call this again after it.

    Args:
        module (LossModule or ValueEstimatorBase): what discounts, e.g. a ``DQNLoss`` or a ``GAE``.
        gamma (float, optional): discount per base step, in ``(0, 1]``, for a loss, whose default
            value estimator is made with it. Default: a loss keeps the estimator it has, or makes
            one with its own defaults.
        duration_key (NestedKey): base steps of a macro-step, int64 ``[*B, 1]``, under ``"next"``.

    Returns:
        The module.

    Raises:
        TypeError: if the module is neither a loss nor an estimator.
        ValueError: if ``gamma`` is out of range, or is given for an estimator, which has its own.

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
