"""Values of the states of a small random env, from what its simulator has shown so far."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_hmcts.planners import Search

_BACKUPS = 4  # of states, for each outcome that is noted


class ValueTable:
    r"""Estimates values of states that are met again and again, with chance between them.

    .. math:: V(s) = \max_o \frac{1}{n_{so}} \sum_i \bigl(R_i + \gamma^{k_i} V(s'_i)\bigr)

    over the outcomes that option :math:`o` had in :math:`s`; 0 where nothing is known. So what was
    drawn in one branch of a tree counts in all others. An outcome backs up its state, then those
    that led to it, a few at a time (prioritized sweeping). ``keys`` are the entries that tell
    states apart, but for clocks and generators.

    Reference:
        Moore and Atkeson, "Prioritized sweeping", 1993.
    """

    def __init__(self, keys: Sequence[Any], gamma: float) -> None:
        self.keys, self.in_keys, self.gamma = list(keys), list(keys), gamma
        self.clear()

    def clear(self) -> None:
        """Forget all outcomes."""
        self.values: defaultdict[bytes, float] = defaultdict(float)
        # By state and option the outcomes: how often, reward, discount and state of each.
        self._outcomes: defaultdict[bytes, dict[int, dict[Any, int]]] = defaultdict(dict)
        self._before: defaultdict[bytes, dict[bytes, None]] = defaultdict(dict)
        self._waiting: deque[bytes] = deque()

    def _states(self, td: TensorDictBase) -> list[bytes]:
        parts = [td.get(key).reshape(len(td), -1).numpy() for key in self.keys]
        return [b"".join(part[i].tobytes() for part in parts) for i in range(len(td))]

    def note(self, before: TensorDictBase, after: TensorDictBase) -> None:
        """Take note of outcomes."""
        discounts = np.where(after["terminated"], 0.0, self.gamma ** after["duration"].numpy())
        rows = zip(
            self._states(before.reshape(-1)),
            before["option"].flatten().tolist(),
            after["reward"].flatten().tolist(),
            discounts.flatten().tolist(),
            self._states(after.reshape(-1)),
            strict=True,
        )
        for state, option, reward, discount, then in rows:
            seen = self._outcomes[state].setdefault(option, {})
            outcome = (reward, discount, then)
            seen[outcome] = seen.get(outcome, 0) + 1
            self._before[then][state] = None
            self._waiting.appendleft(state)
            for _ in range(min(_BACKUPS, len(self._waiting))):
                self._back_up(self._waiting.popleft())

    def _option_values(self, state: bytes) -> dict[int, float]:
        values, known = self.values, self._outcomes[state].items()
        return {
            option: sum(n * (r + d * values[then]) for (r, d, then), n in seen.items())
            / sum(seen.values())
            for option, seen in known
        }

    def _back_up(self, state: bytes) -> None:
        value = max(self._option_values(state).values())
        if abs(value - self.values[state]) > 1e-4:
            self.values[state] = value
            self._waiting.extend(s for s in self._before[state] if s not in self._waiting)

    def choose(self, search: Search) -> np.ndarray:
        """Return the best option of each root, by all that is known of its state, ``[B]``."""
        roots = np.arange(search.num_roots)
        states = search.tree.get_states(roots, 0 * roots, self.keys)
        found = [self._option_values(state) for state in self._states(states)]
        return np.array([max(values, key=values.__getitem__) for values in found], np.int64)

    def __call__(self, td: TensorDictBase) -> Tensor:
        """Return the values of states ``[m]``."""
        return torch.tensor([self.values[state] for state in self._states(td)])
