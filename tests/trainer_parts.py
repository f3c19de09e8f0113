"""Parts of the tests of several trainers: a bar that remembers, a comparison to the bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch


class Bar:
    """A progress bar that remembers what it was told."""

    def __init__(self, total: int) -> None:
        self.total, self.n, self.closed = total, 0, False
        self.moves: list[int] = []
        self.figures: dict[str, str] = {}

    def update(self, n: int) -> None:
        self.n += n
        self.moves.append(n)

    def set_postfix(self, values: Mapping[str, str] | None = None, **figures: Any) -> None:
        figures.pop("refresh", None)
        self.figures = {**(values or {}), **figures}

    def close(self) -> None:
        self.closed = True


class Bars(list[Bar]):
    """Makes progress bars, and keeps them."""

    def __call__(self, total: int) -> Bar:
        self.append(Bar(total))
        return self[-1]


def weights(trainer: Any) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in trainer.loss_module.parameters()]).clone()


def differences(a: Any, b: Any, path: str = "") -> list[str]:
    """Returns the paths at which two nested structures differ in any bit."""
    if isinstance(a, torch.Tensor):
        same = a.dtype == b.dtype and torch.equal(a, b)
        return [] if same else [path]
    if isinstance(a, Mapping):
        if list(a) != list(b):
            return [f"{path}: {sorted(map(str, a))} and {sorted(map(str, b))}"]
        return [d for key in a for d in differences(a[key], b[key], f"{path}.{key}")]
    if isinstance(a, Sequence) and not isinstance(a, str):
        if len(a) != len(b):
            return [f"{path}: {len(a)} and {len(b)}"]
        return [d for i in range(len(a)) for d in differences(a[i], b[i], f"{path}.{i}")]
    return [] if a == b else [f"{path}: {a} and {b}"]
