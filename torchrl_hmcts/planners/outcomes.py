"""Outcomes of options, as arrays, and the refusal of numbers that no search can use.

Letters: ``m`` outcomes of one wave, or roots; ``A`` options, ``F`` novelty features, ``K`` bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchrl_hmcts.planners.tree import LARGEST, MOST_BASE_STEPS


class Outcomes(NamedTuple):
    """Outcomes of a wave's triples."""

    rewards: np.ndarray  # [m] float32, R
    discounts: np.ndarray  # [m] float32, D: gamma ** duration, 0 after a terminal state
    durations: np.ndarray  # [m] int64, base steps
    done: np.ndarray  # [m] bool: terminated or truncated
    values: np.ndarray  # [m] float32, the leaf evaluator's
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
