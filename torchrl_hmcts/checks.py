"""Checks of arguments, a line each where a user errs; each message names the argument and value."""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np
from tensordict import unravel_key
from tensordict.utils import NestedKey

NO_LIMIT = np.iinfo(np.int64).max


def whole_number(owner: str, name: str, value: Any, *, least: int = 0) -> int:
    """Return a count as an int; one beyond int64 is as good as no limit.

    Args:
        owner: who needs it, for messages.
        name: of the argument.
        value: a Python or NumPy integer.
        least: the smallest that makes sense. Default 0.

    Raises:
        TypeError: if it is no integer: text, a bool or a float, 1e3 included.
        ValueError: if it is smaller than ``least``.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, numbers.Integral):
        hint = f" Write {int(value)}." if isinstance(value, float) and value.is_integer() else ""
        raise TypeError(
            f"{owner} needs a whole number for {name}; got {value!r}, a {type(value).__name__}."
            f"{hint}"
        )
    if value < least:
        raise ValueError(f"{owner} needs {name} >= {least}; got {value}.")
    return min(int(value), NO_LIMIT)


def real_number(
    owner: str,
    name: str,
    value: Any,
    *,
    least: float = -math.inf,
    most: float = math.inf,
    above: float = -math.inf,
    finite: bool = True,
) -> float:
    """Return a number as a float.

    Args:
        owner: who needs it, for messages.
        name: of the argument.
        value: a Python or NumPy number, no NaN.
        least: the smallest allowed. Default: any.
        most: the largest allowed. Default: any.
        above: what it must exceed. Default: nothing.
        finite: refuse infinities. Default True.

    Raises:
        TypeError: if it is no number.
        ValueError: if it is NaN or outside the bounds.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (numbers.Real, np.number)):
        raise TypeError(
            f"{owner} needs a number for {name}; got {value!r}, a {type(value).__name__}."
        )
    number = float(value)
    if not (least <= number <= most and (number > above or above == -math.inf)) or (
        finite and math.isinf(number)
    ):
        bounds = [f">= {least}"] * (least > -math.inf) + [f"> {above}"] * (above > -math.inf)
        bounds += [f"<= {most}"] * (most < math.inf) or ["finite"] * finite
        raise ValueError(f"{owner} needs {name} {' and '.join(bounds)}; got {value}.")
    return number


def instance(owner: str, name: str, value: Any, *kinds: type) -> None:
    """Refuse a value that is of none of the given classes.

    Args:
        owner: who needs it, for messages.
        name: of the argument.
        value: what was given.
        *kinds: the classes allowed.

    Raises:
        TypeError: if it is of another class.
    """
    if not isinstance(value, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise TypeError(
            f"{owner} needs a {wanted} for {name}; got {value!r}, a {type(value).__name__}."
        )


def nested_key(owner: str, name: str, value: Any) -> NestedKey:
    """Return a key of a tensordict in its flat form.

    Args:
        owner: who needs it, for messages.
        name: of the argument.
        value: a string, or a tuple of them.

    Raises:
        TypeError: if it is no key.
    """
    if not _is_key(value):
        raise TypeError(
            f"{owner} needs a string or a tuple of strings for {name}; got {value!r}, a "
            f"{type(value).__name__}."
        )
    return unravel_key(value)


def _is_key(value: Any) -> bool:
    nested = isinstance(value, tuple) and bool(value) and all(map(_is_key, value))
    return isinstance(value, str) or nested
