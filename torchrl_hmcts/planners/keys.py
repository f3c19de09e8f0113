"""Keys of entries of a tensordict, as users give them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import unravel_key
from tensordict.utils import NestedKey


def entry_key(owner: str, name: str, key: Any) -> NestedKey:
    """Return the key of an entry, unravelled; ``name`` is the argument, for messages."""
    try:
        found: NestedKey = unravel_key(key)
    except RuntimeError:  # tensordict's answer to what is neither text nor a tuple
        found = ()
    if not found:
        raise TypeError(f"{owner} needs the key of an entry for {name}; got {key!r}.")
    return found


def entry_keys(owner: str, name: str, key: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """Return one or several keys as a list, for an owner that needs at least one."""
    if not isinstance(key, Sequence):
        raise TypeError(f"{owner} needs a key, or several, for {name}; got {key!r}.")
    keys = [key] if isinstance(key, (str, tuple)) else list(key)
    if not keys:
        raise ValueError(f"{owner} needs at least one entry to compare in {name}; got none.")
    return [entry_key(owner, name, k) for k in keys]
