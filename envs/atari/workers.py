"""Workers: what carries an option out inside the processes that emulate.

A worker is any object that can be sent to a process (pickled), with

- ``num_options`` (int),
- ``act(ram, option, generator) -> int``, the index of the next action; ``ram`` is uint8 ``[128]``
  and is overwritten in the next step, ``generator`` a ``numpy.random.Generator`` from which all
  random choices must be drawn,
- optionally ``ends(ram, option, steps) -> bool``, whether the option ends after so many steps.

Letters: H width of a layer, A actions, Z options.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.compiling import njit
from torchrl_hmcts.processes import share


class OptionWorker(Protocol):
    """What a pool needs of a worker; it may have ``ends(ram, option, steps) -> bool`` too.

    Example:
        >>> class LeftOrRight:
        ...     num_options = 2
        ...     def act(self, ram, option, generator):
        ...         return (3, 2)[option]
        >>> from torchrl_hmcts.envs import AtariOptionPool
        >>> pool = AtariOptionPool("Breakout", LeftOrRight(), max_steps=4, num_processes=0)
        >>> pool.num_options
        2
    """

    num_options: int

    def act(self, ram: np.ndarray, option: int, generator: np.random.Generator) -> int:
        """Return the index of the action to take, seeing the RAM, uint8 ``[128]``."""
        ...


class RepeatActions:
    """Options that take one action all the time.

    Args:
        actions (int or sequence of int): the index of each option's action; a number means all
            actions below it.

    Raises:
        ValueError: if there is no action.

    Reference:
        Braylan et al., "Frame skip is a powerful parameter for learning to play Atari", 2015.

    Example:
        >>> from torchrl_hmcts.envs import RepeatActions
        >>> RepeatActions(4).num_options, RepeatActions([0, 2]).act(None, 1, None)
        (4, 2)
    """

    def __init__(self, actions: int | Sequence[int]) -> None:
        self.actions = tuple(range(actions)) if isinstance(actions, int) else tuple(actions)
        if not self.actions:
            raise ValueError("RepeatActions needs at least one action; got none.")
        self.num_options = len(self.actions)

    def act(self, ram: np.ndarray, option: int, generator: np.random.Generator) -> int:
        """Return the option's action."""
        return self.actions[option]


class SharedMLP:
    r"""A network with shared layers and a head per option, its weights shared with all processes.

    .. math:: \pi(a \mid s, z) = \mathrm{softmax}_a(W_z h(s) + b_z), \qquad h = \mathrm{ReLU}(...)

    reads RAM / 255. One forward pass for one state takes a few microseconds; a module of torch
    needs ten times that. :meth:`load` writes new weights, which the processes use from their next
    step on: no copies, no messages, no locks (a step taken meanwhile may see some of both).

    Args:
        num_options (int): Z.
        num_actions (int): A.
        hidden (sequence of int): widths H of the shared layers. Default: three of 128.
        deterministic (bool): take the most probable action instead of a sample. Default False.

    Raises:
        ValueError: if a size is not positive, or the weights loaded have other shapes.
        OSError: if there is too little shared memory.

    Reference:
        Dissertation, chapter 5: the Atari worker.

    Example:
        >>> import numpy as np
        >>> from torchrl_hmcts.envs import SharedMLP
        >>> from torchrl_hmcts.modules import SkillMLP
        >>> network = SkillMLP(128, out_features=4, num_skills=3, hidden=(128, 128, 128))
        >>> worker = SharedMLP(num_options=3, num_actions=4, deterministic=True)
        >>> worker.load(network.parameters())
        >>> ram = np.arange(128, dtype=np.uint8)
        >>> with torch.no_grad():
        ...     logits = network(torch.from_numpy(ram) / 255.0, torch.tensor(1))
        >>> worker.act(ram, 1, np.random.default_rng(0)) == int(logits.argmax())
        True
    """

    def __init__(
        self,
        num_options: int,
        num_actions: int,
        *,
        hidden: Sequence[int] = (128, 128, 128),
        deterministic: bool = False,
    ) -> None:
        sizes = [128, *map(int, hidden)]
        for name, value in (
            ("num_options", num_options),
            ("num_actions", num_actions),
            ("every hidden width", min(sizes)),
        ):
            if value < 1:
                raise ValueError(f"SharedMLP needs {name} >= 1; got {value}.")
        self.num_options, self.num_actions = int(num_options), int(num_actions)
        self.deterministic = deterministic
        self.sizes = sizes
        shapes = [(n, m) for n, m in zip(sizes[:-1], sizes[1:], strict=True)]
        shapes += [(sizes[-1], num_actions)] * num_options
        self._offsets = np.cumsum([0] + [n * m + m for n, m in shapes])
        self.weights = torch.zeros(int(self._offsets[-1]))
        """All weights, float32, in shared memory, in the order in which they are used."""
        share([self.weights], "SharedMLP")
        self._prepare()

    def _prepare(self) -> None:
        self._array = self.weights.numpy()
        self._sizes = np.array(self.sizes, np.int64)
        self._heads = np.array(self._offsets[len(self.sizes) - 1 :], np.int64)
        self._logits = np.zeros(self.num_actions, np.float32)

    def __getstate__(self) -> dict[str, Any]:
        views = ("_array", "_sizes", "_heads", "_logits")
        return {k: v for k, v in self.__dict__.items() if k not in views}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    def load(self, parameters: Iterable[Tensor]) -> None:
        """Take over the weights of a network, in the processes too.

        Args:
            parameters: weight ``[out, in]`` and bias ``[out]`` of each shared layer, then of the
                heads, ``[Z * A, H]`` and ``[Z * A]``: the parameters of a ``SkillMLP``.
        """
        given = [p.detach().to("cpu", torch.float32) for p in parameters]
        self._check_shapes(given)
        parts = []
        for weight, bias in zip(given[:-2:2], given[1:-2:2], strict=True):
            parts += [weight.t().reshape(-1), bias]
        heads = given[-2].view(self.num_options, self.num_actions, -1)
        for weight, bias in zip(heads, given[-1].view(self.num_options, -1), strict=True):
            parts += [weight.t().reshape(-1), bias]
        self.weights.copy_(torch.cat(parts))

    @torch.no_grad()
    def store(self, parameters: Iterable[Tensor]) -> None:
        """Write the weights into a network, the inverse of :meth:`load`.

        Args:
            parameters: of a ``SkillMLP`` of the same sizes, overwritten.

        Raises:
            ValueError: if their shapes are others.
        """
        given = list(parameters)
        self._check_shapes(given)
        layers, at = [], 0
        for n, m in zip(self.sizes[:-1], self.sizes[1:], strict=True):
            layers += [self.weights[at : at + n * m].view(n, m).t(), self.weights[at + n * m :][:m]]
            at += n * m + m
        heads = self.weights[at:].view(self.num_options, -1)
        split = self.sizes[-1] * self.num_actions
        weight = heads[:, :split].reshape(self.num_options, self.sizes[-1], self.num_actions)
        layers.append(weight.transpose(1, 2).reshape(-1, self.sizes[-1]))
        layers.append(heads[:, split:].reshape(-1))
        for parameter, value in zip(given, layers, strict=True):
            parameter.copy_(value)

    def _check_shapes(self, given: Sequence[Tensor]) -> None:
        pairs = list(zip(self.sizes[:-1], self.sizes[1:], strict=True))
        pairs.append((self.sizes[-1], self.num_options * self.num_actions))
        wanted = [shape for n, m in pairs for shape in ((m, n), (m,))]
        if [tuple(p.shape) for p in given] != wanted:
            raise ValueError(
                f"SharedMLP wants parameters of the shapes {wanted}; got "
                f"{[tuple(p.shape) for p in given]}. Build the network with the same widths, "
                f"options and actions."
            )

    def act(self, ram: np.ndarray, option: int, generator: np.random.Generator) -> int:
        """Return an action drawn from the option's policy, or the most probable one."""
        draw = -1.0 if self.deterministic else generator.random()
        return int(_choose(ram, self._array, self._sizes, self._heads[option], self._logits, draw))


@njit()
def _choose(
    ram: np.ndarray,
    weights: np.ndarray,
    sizes: np.ndarray,
    head: int,
    logits: np.ndarray,
    draw: float,
) -> int:
    """The most probable action, or that at which the cumulative probability passes ``draw``."""
    _logits(ram, weights, sizes, head, logits)
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
def _logits(
    ram: np.ndarray, weights: np.ndarray, sizes: np.ndarray, head: int, out: np.ndarray
) -> None:
    """Write the outputs of one head; rows that a zero would multiply are left out."""
    x = ram.astype(np.float32) / np.float32(255.0)
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
