"""Counts that limit a search: whole numbers, however they are written."""

from __future__ import annotations

import numbers
from typing import Any

import numpy as np

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
