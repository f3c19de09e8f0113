"""Outcomes of options as arrays, answers of evaluators, and the refusal of what no search can use.

Letters: ``m`` outcomes of one wave, or roots; ``A`` options, ``F`` novelty features, ``K`` bytes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.planners.tree import LARGEST, MOST_BASE_STEPS


class Outcomes(NamedTuple):
    """Outcomes of a wave's triples."""

    rewards: np.ndarray  # [m] float32, R
    discounts: np.ndarray  # [m] float32, D: gamma ** duration, 0 after a terminal state
    durations: np.ndarray  # [m] int64, base steps
    values: np.ndarray  # [m] float32, the leaf evaluator's
    done: np.ndarray  # [m] bool: terminated or truncated
    priors: np.ndarray  # [m, A] float32, or [0, A] for uniform
    masks: np.ndarray  # [m, A] bool: options that may be taken, or [0, A] for all
    features: np.ndarray | None = None  # [m, F], the novelty test's
    codes: np.ndarray | None = None  # [m, K] uint8, states as bytes: for equal states


class RootStates(NamedTuple):
    """Values, priors and masks of roots before they are searched."""

    values: np.ndarray  # [m] float32
    done: np.ndarray  # [m] bool
    priors: np.ndarray  # [m, A] float32, or [0, A] for uniform
    masks: np.ndarray  # [m, A] bool, or [0, A] for all
    features: np.ndarray | None = None  # [m, F]
    codes: np.ndarray | None = None  # [m, K] uint8


def check_rows(known: Outcomes | RootStates, m: int, num_options: int) -> None:
    """Refuse arrays without a row for each of ``m`` states: the kernels trust them."""
    for name, array in zip(type(known).__annotations__, known, strict=True):
        wide = name in ("priors", "masks")
        if array is None or (wide and array.shape == (0, num_options)):
            continue
        if array.shape[0] != m or (wide and array.shape[1] != num_options):
            expected = [m, num_options] if wide else [m]
            raise ValueError(
                f"A search got {name} {list(array.shape)} for {m} states; it needs {expected}."
            )


def refuse(outcomes: Outcomes, bad: int) -> None:
    """Raise if there is an outcome ``bad``."""
    if bad >= 0:
        raise ValueError(
            f"An outcome has the reward {outcomes.rewards[bad]}, the discount "
            f"{outcomes.discounts[bad]}, the value {outcomes.values[bad]} and the priors "
            f"{outcomes.priors[bad : bad + 1].tolist()}. All must be finite, rewards and "
            f"values smaller than {LARGEST:g}, discounts in [0, 1] and priors not negative; "
            f"scale the rewards, or find the step from which the env wrote them."
        )


def check_durations(durations: np.ndarray, above: np.ndarray) -> None:
    """Refuse durations that no option can have, and paths whose length would overflow."""
    good = (durations >= 1) & (durations <= MOST_BASE_STEPS - above.astype(np.int64))
    if not good.all():
        raise ValueError(
            f"The simulator returned a duration of {durations[~good][0]}. An option takes one base "
            f"step or more, and a path {MOST_BASE_STEPS:,} at most; find the step from which the "
            f"env wrote it."
        )


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
