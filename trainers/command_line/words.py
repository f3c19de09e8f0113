"""Words of the command line: keys of the command itself, and the rest."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence

from torchrl_hmcts.trainers.runs.config import home, unknown_key

LOG_LEVELS = ("debug", "info", "warning", "error")
LOG_LEVEL_HELP = (
    "log_level=debug|info|warning|error: how much is said (default info; with warning\n"
    "  and error no progress is shown either)."
)


def split_words(words: Sequence[str], own: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take the keys of the command out of its words.

    Args:
        words: of the command line, without the verb.
        own: keys of the command; ``log_level`` always is one.

    Returns:
        The values of these keys, and all other words.

    Raises:
        ValueError: if one of the keys is given twice, or has no value.

    Example:
        >>> split_words(["experiment=labmaze", "seed=1"], ["experiment"])
        ({'experiment': 'labmaze'}, ['seed=1'])
    """
    found: dict[str, str] = {}
    rest = []
    for word in words:
        key, separator, value = word.partition("=")
        if not separator or key not in (*own, "log_level"):
            rest.append(word)
            continue
        if key in found:
            raise ValueError(f"{key} is given twice: {key}={found[key]} and {word}.")
        if not value:
            raise ValueError(f"{key}= has no value.")
        found[key] = value
    return found, rest


def folders_of(words: Sequence[str], own: Sequence[str]) -> list[str]:
    """Return words as folders, none of which may be a key.

    Args:
        words: left over by :func:`split_words`.
        own: keys of the command, for the message.

    Raises:
        ValueError: if a word is a key that the command does not have.
    """
    for word in words:
        key, separator, _ = word.partition("=")
        if separator and not os.path.isdir(home(word)):
            raise ValueError(unknown_key(key, [*own, "log_level"]))
    return [home(word) for word in words]


def set_log_level(level: str) -> bool:
    """Set how much this process says; return whether progress is shown.

    Args:
        level: one of ``LOG_LEVELS``.

    Raises:
        ValueError: if it is none of them.

    Example:
        >>> set_log_level("info")
        True
    """
    if level not in LOG_LEVELS:
        raise ValueError(f"log_level is one of {', '.join(LOG_LEVELS)}; got {level!r}.")
    # TorchRL's own messages (a collector that shuts down, ...) are for those who ask for them.
    others = {"info": "WARNING"}.get(level, level.upper())
    os.environ.setdefault("RL_LOGGING_LEVEL", others)
    logging.getLogger("torchrl").setLevel(os.environ["RL_LOGGING_LEVEL"])
    logging.getLogger("torchrl_hmcts").setLevel(level.upper())
    return level in ("debug", "info")
