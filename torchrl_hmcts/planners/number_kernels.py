"""Whether the numbers of a wave's outcomes are some that a search can use."""

# numba compiles these functions; it does not read annotations as strings.
import numba

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.planners.tree import LARGEST

GOOD, MISFIT = -1, -2  # what becomes of a wave's outcomes, if not the row of one that is bad


@njit(error_model="numpy", _nrt=False)
def first_bad(rewards, discounts, values, priors):
    """The first outcome with a number that no search can use, or GOOD.

    Those are rewards and values from LARGEST on, discounts outside [0, 1], priors below 0, and what
    is not finite. ``values`` and ``priors`` may be empty.
    """
    for i in range(rewards.shape[0]):
        good = (abs(rewards[i]) < LARGEST) & (0.0 <= discounts[i]) & (discounts[i] <= 1.0)
        if values.shape[0]:
            good &= abs(values[i]) < LARGEST
        if priors.shape[0]:
            least, total = priors[i, 0], priors[i, 0]
            for a in range(1, priors.shape[1]):
                least = min(least, priors[i, a])
                total += priors[i, a]
            good &= (0.0 <= least) & (total < LARGEST)
        if not good:
            return i
    return GOOD


@numba.njit(forceinline=True, error_model="numpy", _nrt=False)
def fits(rows, count, num_options):
    """Whether there is a row for each outcome, or none for all."""
    return (rows.shape[0] == count or rows.shape[0] == 0) and rows.shape[1] == num_options
