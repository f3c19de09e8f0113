"""Checks of arguments, a line each where a user errs; each message names the argument and value."""

from __future__ import annotations

import inspect
import math
import numbers
import operator
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from tensordict import unravel_key
from tensordict.utils import NestedKey

NO_LIMIT = np.iinfo(np.int64).max


def whole_number(owner: str, name: str, value: Any, *, least: int = 0) -> int:
    """Return a count, at least ``least``, as an int; one beyond int64 is as good as no limit.

    Raises:
        TypeError: if it is no integer: text, a bool or a float, 1e3 included.
        ValueError: if it is smaller.
    """
    try:
        number = None if isinstance(value, (bool, np.bool_)) else operator.index(value)
    except TypeError:
        number = None
    if number is None:
        hint = f" Write {int(value)}." if isinstance(value, float) and value.is_integer() else ""
        raise TypeError(f"{owner} needs a whole number for {name}; got {_described(value)}.{hint}")
    if number < least:
        raise ValueError(f"{owner} needs {name} >= {least}; got {number}.")
    return min(number, NO_LIMIT)


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
    """Return a number as a float: from ``least`` to ``most``, more than ``above``, no NaN.

    Raises:
        TypeError: if it is no number.
        ValueError: if it is outside the bounds.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (numbers.Real, np.number)):
        raise TypeError(f"{owner} needs a number for {name}; got {_described(value)}.")
    number = float(value)
    if not (least <= number <= most and (number > above or above == -math.inf)) or (
        finite and math.isinf(number)
    ):
        bounds = [f">= {least}"] * (least > -math.inf) + [f"> {above}"] * (above > -math.inf)
        bounds += [f"<= {most}"] * (most < math.inf) or ["finite"] * finite
        raise ValueError(f"{owner} needs {name} {' and '.join(bounds)}; got {value}.")
    return number


def no_class(owner: str, name: str, value: Any) -> None:
    """Raise a TypeError if a value is a class, where an object of it is due."""
    if isinstance(value, type):
        given = inspect.signature(value).parameters.values()
        needed = [p.name for p in given if p.default is p.empty and p.kind == 1]
        raise TypeError(
            f"{owner} needs an object for {name}; got the class {value.__name__}. Write "
            f"{name}={value.__name__}({', '.join(needed)})."
        )


def instance(owner: str, name: str, value: Any, *kinds: Any) -> None:
    """Raise a TypeError if a value is of none of the classes."""
    if not isinstance(value, kinds):
        no_class(owner, name, value)
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise TypeError(f"{owner} needs a {wanted} for {name}; got {_described(value)}.")


def one_of(owner: str, name: str, value: str, known: Iterable[str]) -> str:
    """Return a value that is one of those known, or raise a ValueError."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(
            f"{owner} needs {name} to be {' or '.join(map(repr, known))}; got {value!r}."
        )
    return value


def _described(value: Any) -> str:
    kind = type(value).__name__
    return f"{value!r}, {'an' if kind[0] in 'aeiouAEIO' else 'a'} {kind}"


def nested_key(owner: str, name: str, value: Any) -> NestedKey:
    """Return a key of a tensordict in its flat form, or raise a TypeError."""
    if not _is_key(value):
        raise TypeError(
            f"{owner} needs a string or a tuple of strings for {name}; got {_described(value)}."
        )
    return unravel_key(value)


def nested_keys(owner: str, name: str, value: Any) -> list[NestedKey]:
    """Return one key or several in their flat form; raise a ValueError if there is none."""
    several = isinstance(value, Sequence) and not isinstance(value, (str, tuple))
    keys = [nested_key(owner, name, key) for key in (value if several else [value])]
    if not keys:
        raise ValueError(f"{owner} needs at least one entry to compare in {name}; got none.")
    return keys


def _is_key(value: Any) -> bool:
    nested = isinstance(value, tuple) and bool(value) and all(map(_is_key, value))
    return isinstance(value, str) or nested
