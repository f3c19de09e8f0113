"""Frame of the checks: a part breaks its contract, and the error says how.

Letters: *B batch of a tensordict, m rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase


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


def require_kind(part: Any, kind: type) -> str:
    """Return the name of a part for messages, if it is of the class that it must have."""
    name = type(part).__name__
    require(isinstance(part, kind), f"{name} is no {kind.__name__}. Derive it from that class.")
    return name


def require_same(
    one: TensorDictBase,
    other: TensorDictBase,
    message: str,
    keys: Iterable[NestedKey] | None = None,
    tolerance: float = 0.0,
) -> None:
    """Require two tensordicts to have the same entries; NaN equals NaN.

    Args:
        one: what is right, ``[*B]``.
        other: what was found, ``[*B]``.
        message: in which ``<key>``, ``<one>`` and ``<other>`` stand for the first entry that
            differs and its first rows that do.
        keys: what is compared. Default: all entries of ``one``.
        tolerance: difference that is allowed, relative and absolute.
    """
    if not one.batch_size.numel():
        return
    for key in sorted(leaves(one) if keys is None else keys, key=str):
        a, b = one.get(key, None), other.get(key, None)
        row = 0
        if a is not None and b is not None and a.shape == b.shape and a.dtype == b.dtype:
            close = a == b
            if a.is_floating_point():
                close = torch.isclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
            rows = close.reshape(one.batch_size.numel(), -1).all(-1)
            if rows.all():
                continue
            row = int((~rows).nonzero()[0, 0])
        message = message.replace("<one>", _row(one, a, row)).replace(
            "<other>", _row(other, b, row)
        )
        raise ContractError(message.replace("<key>", repr(key)))


def _row(td: TensorDictBase, value: Tensor | None, row: int) -> str:
    """Show the value of an entry in one row of the flattened batch."""
    if value is None:
        return "nothing"
    numbers = value.reshape(td.batch_size.numel(), -1)[row].tolist()
    return f"{numbers[0] if len(numbers) == 1 else numbers!s:.200}"


def require_read(part: str, reader: Any, td: TensorDictBase, what: str) -> None:
    """Require a tensordict to have what a part says it reads."""
    for key in getattr(reader, "in_keys", ()):
        require(
            td.get(key, None) is not None,
            f"{part} reads {key!r}, which {what} does not have: it has "
            f"{sorted(map(str, leaves(td)))}. Add it, or correct in_keys.",
        )


def asked(part: str, function: Callable[[Any], Any], td: Any, doing: str) -> Any:
    """Return what a part says of a tensordict, seeded, if it leaves the tensordict as it was."""
    given = td.clone()
    with during(part, doing), torch.no_grad(), seeded(0):
        out = function(given)
    before, after = td.to_tensordict(), given.to_tensordict()
    message = f"{part} changed <key> of its input. Compute on copies."
    require_same(before, after, message, leaves(before) | leaves(after))
    return out


def require_alone(
    part: str,
    ask: Callable[[Any], Any],
    rows: Any,
    together: Any,
    what: str,
    advice: str = "Judge each by itself (no batch statistics).",
) -> None:
    """Require a part to say of each of the rows ``[m]`` alone what it says of it among others."""
    for i in range(len(rows)):
        alone, among = torch.as_tensor(ask(rows[i : i + 1])[0]), torch.as_tensor(together[i])
        require(
            torch.allclose(alone.double(), among.double(), rtol=1e-4, atol=1e-5, equal_nan=True),
            f"{part} gives {what} {i} {alone.tolist()} alone and {among.tolist()} among others. "
            f"{advice}",
        )


def require_action(part: str, env: EnvBase, td: TensorDictBase) -> None:
    """Require a tensordict to hold an action that fits the specs of an env, in its batch."""
    for key in map(unravel_key, env.action_keys):
        action, leaf = td.get(key, None), env.full_action_spec_unbatched[key]
        require(action is not None, f"{part} wrote no {key!r}, the action of the env.")
        spec = leaf.expand((*td.batch_size, *leaf.shape))
        require(
            action.shape == spec.shape and action.dtype == spec.dtype and spec.is_in(action),
            f"{part} wrote {key!r} = {action.dtype} {list(action.shape)} {action!s:.100} for a "
            f"batch of shape {list(td.batch_size)}, which does not fit {spec}.",
        )


@contextmanager
def during(part: str, doing: str, advice: str = "") -> Iterator[None]:
    """Turn an error inside into a ContractError that says when it happened."""
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
    """Return the keys of all tensors of a tensordict."""
    return {unravel_key(key) for key in tensordict.keys(True, True)}


def refuse_unknown(owner: str, checks: Sequence[str], known: Iterable[str]) -> None:
    """Refuse the name of a check that there is not."""
    for check in checks:
        if check not in known:
            raise ValueError(f"{owner} has no check {check!r}; it has {', '.join(known)}.")
