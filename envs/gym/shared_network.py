"""A network whose weights all processes share, run for one state in a few microseconds.

Letters: H width of a layer, O outputs, Z heads.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.processes import share


class SharedNetwork:
    """The weights of a ``SkillMLP`` with Z heads in shared memory, in the order of their use."""

    def __init__(
        self,
        num_inputs: int,
        num_outputs: int,
        num_heads: int,
        hidden: Sequence[int],
    ) -> None:
        self.num_outputs, self.num_heads = num_outputs, num_heads
        self.sizes = sizes = [num_inputs, *hidden]
        shapes = [(n, m) for n, m in zip(sizes[:-1], sizes[1:], strict=True)]
        shapes += [(sizes[-1], num_outputs)] * num_heads
        self._offsets = np.cumsum([0] + [n * m + m for n, m in shapes])
        self.weights = torch.zeros(int(self._offsets[-1]))
        """All weights, float32, in shared memory, in the order in which they are used."""
        share([self.weights], type(self).__name__)
        self._prepare()

    def _prepare(self) -> None:
        self._array = self.weights.numpy()
        self._sizes = np.array(self.sizes, np.int64)
        self._heads = np.array(self._offsets[len(self.sizes) - 1 :], np.int64)
        self._logits = np.zeros(self.num_outputs, np.float32)

    def __getstate__(self) -> dict[str, Any]:
        views = ("_array", "_sizes", "_heads", "_logits")
        return {k: v for k, v in self.__dict__.items() if k not in views}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    def load(self, parameters: Iterable[Tensor]) -> None:
        """Take over the parameters of a ``SkillMLP`` of the same sizes, in the processes too.

        They are weight ``[out, in]`` and bias ``[out]`` of each shared layer, then of the heads,
        ``[Z * O, H]`` and ``[Z * O]``.
        """
        for view, parameter in self._pairs(parameters):
            view.copy_(parameter.detach().view_as(view))

    def store(self, parameters: Iterable[Tensor]) -> None:
        """Overwrite the parameters of a ``SkillMLP``, the inverse of :meth:`load`."""
        for view, parameter in self._pairs(parameters):
            parameter.detach().view_as(view).copy_(view)

    def _pairs(self, parameters: Iterable[Tensor]) -> list[tuple[Tensor, Tensor]]:
        """Pair the weights, as a ``SkillMLP`` has them, with its parameters."""
        views: list[Tensor] = []
        wanted: list[tuple[int, ...]] = []
        at = 0
        for n, m in zip(self.sizes[:-1], self.sizes[1:], strict=True):
            views += [self.weights[at : at + n * m].view(n, m).t(), self.weights[at + n * m :][:m]]
            wanted += [(m, n), (m,)]
            at += n * m + m
        heads = self.weights[at:].view(self.num_heads, -1)
        last, rows = self.sizes[-1], self.num_heads * self.num_outputs
        split = last * self.num_outputs
        views.append(heads[:, :split].unflatten(1, (last, self.num_outputs)).transpose(1, 2))
        views.append(heads[:, split:])
        wanted += [(rows, last), (rows,)]
        given = list(parameters)
        if [tuple(p.shape) for p in given] != wanted:
            raise ValueError(
                f"{type(self).__name__} needs parameters of the shapes {wanted}; got "
                f"{[tuple(p.shape) for p in given]}. Build the network with the same widths, "
                "options and actions."
            )
        return list(zip(views, given, strict=True))


@njit()
def choose(
    x: np.ndarray,
    weights: np.ndarray,
    sizes: np.ndarray,
    head: int,
    logits: np.ndarray,
    draw: float,
    scale: float,
) -> int:
    """The most probable action, or that at which the cumulative probability passes ``draw``."""
    run_network(x, weights, sizes, head, logits, scale)
    best = int(logits.argmax())
    if draw < 0.0:
        return best
    shares = np.exp(logits - logits[best])
    left = draw * shares.sum()
    for action in range(len(shares)):
        left -= shares[action]
        if left < 0.0:
            return action
    return best  # rounding


@njit()
def run_network(
    x: np.ndarray,
    weights: np.ndarray,
    sizes: np.ndarray,
    head: int,
    out: np.ndarray,
    scale: float,
) -> None:
    """Write the outputs of a head for ``x / scale``, without rows that a zero would multiply."""
    x = x.astype(np.float32) / np.float32(scale)
    at = 0
    for layer in range(len(sizes)):
        last = layer == len(sizes) - 1
        if last:
            at = head
        width = len(out) if last else sizes[layer + 1]
        bias = at + len(x) * width
        y = weights[bias : bias + width].copy()
        used = np.flatnonzero(x)
        k = 0
        while k + 4 <= len(used):  # four rows at a time: what is summed is loaded and stored less
            i0, i1, i2, i3 = used[k], used[k + 1], used[k + 2], used[k + 3]
            x0, x1, x2, x3 = x[i0], x[i1], x[i2], x[i3]
            row0 = weights[at + i0 * width : at + i0 * width + width]
            row1 = weights[at + i1 * width : at + i1 * width + width]
            row2 = weights[at + i2 * width : at + i2 * width + width]
            row3 = weights[at + i3 * width : at + i3 * width + width]
            for j in range(width):
                y[j] += x0 * row0[j] + x1 * row1[j] + x2 * row2[j] + x3 * row3[j]
            k += 4
        for i in used[k:]:
            row = weights[at + i * width : at + i * width + width]
            for j in range(width):
                y[j] += x[i] * row[j]
        if not last:
            y = np.maximum(y, np.float32(0.0))
        at = bias + width
        x = y
    out[:] = x
