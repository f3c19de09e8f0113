"""What a sweep may vary, as it is typed on the command line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from torchrl_hmcts.trainers.runs.config import RunConfig, parse_overrides, read_value, unknown_key


@dataclass(frozen=True)
class Choice:
    """A key that takes one of several values.

    Example:
        >>> Choice("num_skills", (3, 4)).kind
        'choice'
    """

    key: str
    values: tuple[Any, ...]
    kind: str = "choice"


@dataclass(frozen=True)
class Range:
    """A key that takes a number between two, both included.

    Args:
        key: of the configuration.
        low: least value.
        high: largest value.
        integer: whether it is a whole number.
        step: between neighbouring values. Default: 1 of whole numbers, none of others.
        log: whether it is drawn evenly in its logarithm.

    Raises:
        ValueError: if the range is empty, or a logarithm is asked for of what is not positive.
    """

    key: str
    low: float
    high: float
    integer: bool
    step: float | None = None
    log: bool = False
    kind: str = "range"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise ValueError(f"{self.key}={self.low}..{self.high} needs two finite ends.")
        if not self.low < self.high:
            raise ValueError(f"{self.key}={self.low}..{self.high} is an empty range.")
        if self.log and not self.low > 0:
            raise ValueError(f"{self.key}={self.low}..{self.high}:log needs a lower end above 0.")
        if self.step is not None and not 0 < self.step <= self.high - self.low:
            raise ValueError(
                f"{self.key}={self.low}..{self.high} cannot be walked in steps of {self.step}."
            )


Dimension = Choice | Range


def parse_space(
    config_class: type, words: Sequence[str], others: Sequence[str] = ()
) -> tuple[list[Dimension], list[str]]:
    """Take the keys that are varied out of the words of a sweep.

    Args:
        config_class: of the experiment.
        words: ``key=[a,b]``, ``key=low..high``, ``key=low..high:log``, ``key=low..high:step``, or
            ``key=value``, which is the same in all trials.
        others: further keys of the command, for the message about an unknown one.

    Returns:
        What is varied, and the words of the rest.

    Raises:
        ValueError: if a key is unknown or given twice, or its values are not of its type.

    Example:
        >>> from torchrl_hmcts.trainers.experiments.settings import DemoConfig
        >>> parse_space(DemoConfig, ["num_skills=[3,4]", "gamma=0.9..0.99", "mazes=5"])[0][0].values
        (3, 4)
    """
    types = {field.name: str(field.type) for field in fields(config_class)}
    dimensions: list[Dimension] = []
    fixed = []
    for word in words:
        key, separator, value = word.partition("=")
        if not separator:
            raise ValueError(f"{word!r} is no key=value.")
        if key not in types:
            raise ValueError(unknown_key(key, [*types, *others]))
        if key in ("resume", "overwrite"):
            raise ValueError(f"{key} is for hmcts train; the same command continues a sweep.")
        if any(dimension.key == key for dimension in dimensions):
            raise ValueError(f"{key} is given twice.")
        if value.startswith("[") and value.endswith("]"):
            items = [item.strip() for item in value[1:-1].split(",") if item.strip()]
            if len(items) < 2:
                raise ValueError(f"{word} leaves nothing to choose; give two values or more.")
            typed = [
                getattr(parse_overrides(config_class, [f"{key}={item}"]), key) for item in items
            ]
            dimensions.append(Choice(key, tuple(typed)))
        elif ".." in value and types[key] in ("int", "float"):
            dimensions.append(_range(key, value, types[key] == "int"))
        else:
            fixed.append(word)
    return dimensions, fixed


def _range(key: str, value: str, integer: bool) -> Range:
    ends, _, how = value.partition(":")
    first, _, last = ends.partition("..")
    low: Any
    high: Any
    try:
        low, high, step = (
            None if text in ("", "log") else read_value(key, text, "int" if integer else "float")
            for text in (first, last, how)
        )
        if low is None or high is None:
            raise ValueError
    except ValueError:
        kind = "whole numbers" if integer else "numbers"
        raise ValueError(
            f"{key}={value} is no range of {kind}, e.g. {key}=1..10, {key}=1..10:log or "
            f"{key}=1..10:2 (in steps of 2)."
        ) from None
    if key == "seed":
        RunConfig(seed=low), RunConfig(seed=high)  # raise
    return Range(key, low, high, integer, step, how == "log")
