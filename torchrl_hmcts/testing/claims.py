"""How a check says that a part breaks its contract.

Letters: *B batch of a tensordict.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor


class ContractError(AssertionError):
    """A part breaks its contract; the message names the part, what is wrong, why, and the fix.

    Example:
        >>> from torchrl_hmcts.testing import ContractError, check_skill_prior
        >>> from torchrl_hmcts.modules import SkillPrior
        >>> class Twice(SkillPrior):
        ...     def probs(self):
        ...         return torch.full((self.num_skills,), 2.0 / self.num_skills)
        >>> try:
        ...     check_skill_prior(Twice(4))
        ... except ContractError as error:
        ...     print(error)
        Twice: probs() sums to 2, not 1. Divide by the sum.
    """


def require(holds: bool | Tensor, message: str) -> None:
    """Raise a ContractError with ``message`` unless ``holds``."""
    if not bool(holds):
        raise ContractError(message)


@contextmanager
def during(part: str, doing: str, advice: str = "") -> Iterator[None]:
    """Turn whatever goes wrong inside into a ContractError that says when it did."""
    try:
        yield
    except ContractError:
        raise
    except Exception as error:
        text = str(error).strip() or "no message"
        message = f"{part} fails {doing}: {type(error).__name__}: {text}"
        if advice:
            message = f"{message.rstrip('.')}. {advice}"
        raise ContractError(message) from error


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed torch's global generator inside, and leave it as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def leaves(tensordict: TensorDictBase) -> set[NestedKey]:
    """The keys of all tensors of a tensordict."""
    return {unravel_key(key) for key in tensordict.keys(True, True)}


def different(
    one: TensorDictBase, other: TensorDictBase, keys: Iterable[NestedKey], tolerance: float = 0.0
) -> tuple[NestedKey, int] | None:
    """The first key in which two tensordicts differ and its first row that does, or None.

    Rows are counted over the flattened batch; NaN equals NaN.
    """
    for key in keys:
        a, b = one.get(key), other.get(key)
        if a.shape != b.shape or a.dtype != b.dtype:
            return key, 0
        close = a == b
        if a.is_floating_point():
            close = torch.isclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
        rows = close.reshape(one.batch_size.numel(), -1).all(-1)
        if not rows.all():
            return key, int((~rows).nonzero()[0, 0])
    return None


def row(tensordict: TensorDictBase, key: NestedKey, index: int) -> list[float] | float:
    """The value of an entry in one row of the flattened batch, for a message."""
    value = tensordict.get(key).reshape(tensordict.batch_size.numel(), -1)[index]
    numbers: list[float] = value.tolist()
    return numbers[0] if len(numbers) == 1 else numbers
