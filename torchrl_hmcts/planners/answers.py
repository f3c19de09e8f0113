"""Answers of evaluators and priors: tensors that a search can use, or an error that names them.

Letters: m states, A options.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_hmcts.planners.tree import LARGEST


def check_priors(priors: Any, shape: tuple[int, int], reader: str) -> Tensor:
    """Return probabilities, contiguous on the CPU; refuse numbers that are no probabilities."""
    _check_tensor(priors, reader)
    if tuple(priors.shape) != shape:
        raise ValueError(
            f"The {reader} returned shape {list(priors.shape)}; it must give one probability per "
            f"state and option, {list(shape)}."
        )
    good = (priors >= 0) & (priors < LARGEST)
    if not good.all():
        raise ValueError(
            f"The {reader} returned {priors[~good][0].item()}. Probabilities must be finite and "
            f"not negative; apply a softmax to logits."
        )
    return priors.detach().cpu().contiguous()


def check_values(values: Any, num_states: int, reader: str) -> Tensor:
    """Return values, float32 ``[m]`` on the CPU; refuse those that no search can use."""
    _check_tensor(values, reader)
    if tuple(values.shape) not in ((num_states,), (num_states, 1)):
        raise ValueError(
            f"The {reader} returned shape {list(values.shape)}; it must give one value per state, "
            f"[{num_states}] or [{num_states}, 1]."
        )
    found: Tensor = values.detach().reshape(-1).to("cpu", torch.float32)
    good = found.abs() < LARGEST
    if not good.all():
        raise ValueError(
            f"The {reader} returned {found[~good][0].item()}. Values must be finite and smaller "
            f"than {LARGEST:g}; check the network's input and weights."
        )
    return found


def _check_tensor(value: Any, reader: str) -> None:
    if not isinstance(value, Tensor):
        raise TypeError(
            f"The {reader} must return a tensor; got {type(value).__name__}. Wrap a module in "
            f"ModulePrior or ValueEvaluator."
        )
