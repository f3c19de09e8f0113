"""The share of the state space that training has seen.

Letters: n base steps of a batch, D size of the watched entry, C distinct cells.
"""

from __future__ import annotations

import itertools
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_hmcts.checks import instance, real_number, whole_number


class StateCoverage(TrainerHookBase):
    r"""Counts the distinct cells of an entry that were visited: lately, and since the start.

    .. math::

        C_t = \bigl|\{\lfloor x_i / h \rfloor : t - w < i \le t\}\bigr|

    with the watched entry :math:`x_i` after base step i. Coverage of the window falls when skills
    forget where they went. A hook of any TorchRL ``Trainer``, and usable alone.

    Args:
        key (NestedKey): entry ``[*B, D]`` to watch, read under ``"next"``.
        cell_side (float): h, in the units of the entry; 0.5 is the diameter of Waterworld's disc.
        window (int): w, base steps that count as late, in whole batches.

    Returns:
        From ``coverage(batch)``: ``{"state_coverage": C of the window, "state_coverage_total": C
        since the start}``, which a ``Trainer`` logs under these names.

    Raises:
        ValueError: if ``cell_side`` or ``window`` is not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.trainers.skills.coverage import StateCoverage
        >>> coverage = StateCoverage(cell_side=1.0, window=2)
        >>> def visit(*x):
        ...     moved = torch.tensor(x).unsqueeze(-1)
        ...     return coverage(TensorDict(next=TensorDict(displacement=moved)))
        >>> visit(0.1, 2.3)
        {'state_coverage': 2.0, 'state_coverage_total': 2.0}
        >>> visit(2.9, 2.1)
        {'state_coverage': 1.0, 'state_coverage_total': 2.0}
    """

    def __init__(
        self, key: NestedKey = "displacement", *, cell_side: float = 0.5, window: int = 4_000
    ) -> None:
        instance("StateCoverage", "key", key, str, tuple)
        self.key = unravel_key(("next", key))
        self.cell_side = real_number("StateCoverage", "cell_side", cell_side, above=0.0)
        self.window = whole_number("StateCoverage", "window", window, least=1)
        self._total: set[tuple[int, ...]] = set()
        self._recent: Counter[tuple[int, ...]] = Counter()
        self._batches: deque[list[tuple[int, ...]]] = deque()
        self._steps = 0

    def __call__(self, batch: TensorDictBase) -> dict[str, float]:
        value = batch.get(self.key)
        rows = value.detach().reshape(-1, value.shape[-1]).numpy(force=True)
        cells = np.floor(rows / self.cell_side).astype(np.int32)
        self._add(list(map(tuple, cells.tolist())))
        return {
            "state_coverage": float(len(self._recent)),
            "state_coverage_total": float(len(self._total)),
        }

    def _add(self, cells: list[tuple[int, ...]]) -> None:
        self._total.update(cells)
        self._recent.update(cells)
        self._batches.append(cells)
        self._steps += len(cells)
        # The last batch stays, even if it alone is longer than the window.
        while self._steps > self.window and len(self._batches) > 1:
            old = self._batches.popleft()
            self._steps -= len(old)
            for cell in old:
                self._recent[cell] -= 1
                if not self._recent[cell]:
                    del self._recent[cell]

    def state_dict(self) -> dict[str, Any]:
        """Returns the visited cells, int32 ``[*, D]``, and the sizes of the window's batches."""
        recent = [cell for batch in self._batches for cell in batch]
        return {
            "total": torch.tensor(sorted(self._total), dtype=torch.int32),
            "recent": torch.tensor(recent, dtype=torch.int32),
            "batch_steps": [len(batch) for batch in self._batches],
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continues from what :meth:`state_dict` returned."""
        total, recent = (map(tuple, state_dict[name].tolist()) for name in ("total", "recent"))
        self._total = set(total)
        self._recent.clear()
        self._batches.clear()
        self._steps = 0
        for steps in state_dict["batch_steps"]:
            self._add(list(itertools.islice(recent, steps)))

    def register(self, trainer: Trainer, name: str = "state_coverage") -> None:
        trainer.register_op("pre_steps_log", self)
        trainer.register_module(name, self)
