"""Novelty tests: which new nodes are worth searching.

Letters: ``B`` roots, ``m`` new nodes of a wave, ``F`` features.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey


class NoveltyTest(Protocol):
    """What a planner asks of a novelty test; write your own with these members."""

    in_keys: list[NestedKey]

    def start(self, num_roots: int) -> None:
        """Forget everything: ``num_roots`` searches begin."""

    def features(self, tensordict: TensorDictBase) -> np.ndarray:
        """Return the features of states, float32 ``[m, F]``."""

    def accept(self, roots: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Return which of the new states are novel, bool ``[m]``, in order, and remember those."""

    def relax(self, root: int) -> bool:
        """Be less strict for one root whose search is exhausted; False if that is impossible."""


class RadiusNovelty:
    r"""Refuses a state that lies within a radius of one already in its tree.

    .. math:: \text{novel}(s) \iff \min_{s' \in A} \lVert \phi(s) - \phi(s') \rVert \ge r

    with :math:`A` the accepted states and :math:`\phi` the entries ``key`` side by side, each
    times its scale. Options that lead back to places the tree holds are simulated once and not
    searched further, which is what makes a search over options in a continuous space finite. The
    radius must be smaller than the distance an option covers, or every outcome is refused; an
    exhausted search shrinks it and reopens what it had refused.

    Args:
        key: entry or entries of the simulator's state or observation, ``[*B, f]``.
        radius: in units of the (scaled) entries.
        scale: factor of each entry. Default: all 1.
        relaxation: factor of the radius when a search is exhausted, in ``(0, 1)``. Default
            0.75; a smaller factor reopens more at once, which the hardest searches pay for.
        max_relaxations: how often the radius of a search may be relaxed. Default 14, to a sixtieth.

    Raises:
        ValueError: if the radius is not positive, or the scales do not match the keys.

    Reference:
        The idea for continuous states of width-1 novelty: Lipovetzky, Ramirez and Geffner,
        "Classical planning with simulators", 2015.

    Example:
        >>> import numpy as np, torch
        >>> novelty = RadiusNovelty("position", radius=0.5)
        >>> novelty.start(num_roots=1)
        >>> novelty.accept(np.array([0, 0, 0]), np.array([[0, 0], [0, 0.4], [0, 0.6]], np.float32))
        array([ True, False,  True])
    """

    def __init__(
        self,
        key: NestedKey | Sequence[NestedKey],
        radius: float,
        *,
        scale: Sequence[float] | None = None,
        relaxation: float = 0.75,
        max_relaxations: int = 14,
    ) -> None:
        keys = [key] if isinstance(key, (str, tuple)) else list(key)
        self.in_keys = [unravel_key(k) for k in keys]
        self.scale = [1.0] * len(keys) if scale is None else list(scale)
        if not (math.isfinite(radius) and radius > 0.0):
            raise ValueError(
                f"RadiusNovelty needs a radius > 0, in units of {self.in_keys}; got {radius}. To "
                f"search without a novelty test pass novelty=None to the planner."
            )
        if len(self.scale) != len(keys):
            raise ValueError(
                f"RadiusNovelty needs one scale per key; got {len(self.scale)} for {self.in_keys}."
            )
        self.radius = float(radius)
        if not 0.0 < relaxation < 1.0:
            raise ValueError(
                f"RadiusNovelty needs a relaxation in (0, 1), by which an exhausted search shrinks "
                f"its radius; got {relaxation}."
            )
        self.relaxation = float(relaxation)
        self.max_relaxations = max_relaxations
        self.start(0)

    def start(self, num_roots: int) -> None:
        self._radius = np.full(num_roots, self.radius)
        self._relaxed = np.zeros(num_roots, np.int64)
        self._num_seen = np.zeros(num_roots, np.int64)
        self._seen = np.zeros((num_roots, 0, 0), np.float32)
        self.num_tested = 0
        self.num_refused = 0

    def features(self, tensordict: TensorDictBase) -> np.ndarray:
        parts = []
        for key, scale in zip(self.in_keys, self.scale, strict=True):
            part = tensordict.get(key).to(torch.float32)
            part = part.reshape(len(part), -1)
            parts.append(part if scale == 1.0 else part * scale)
        joined = parts[0] if len(parts) == 1 else torch.cat(parts, -1)
        return joined.cpu().contiguous().numpy()

    def accept(self, roots: np.ndarray, features: np.ndarray) -> np.ndarray:
        from torchrl_hmcts.planners import kernels

        needed = int(self._num_seen.max(initial=0)) + len(roots)
        if self._seen.shape[1] < needed or self._seen.shape[2] != features.shape[1]:
            room = np.zeros((len(self._radius), max(64, 2 * needed), features.shape[1]), np.float32)
            if self._seen.size:
                room[:, : self._seen.shape[1]] = self._seen
            self._seen = room
        accepted = np.empty(len(roots), np.bool_)
        kernels.accept_distant(self._seen, self._num_seen, self._radius, roots, features, accepted)
        self.num_tested += len(roots)
        self.num_refused += int(len(roots) - accepted.sum())
        return accepted

    def relax(self, root: int) -> bool:
        if self._relaxed[root] >= self.max_relaxations:
            return False
        self._relaxed[root] += 1
        self._radius[root] *= self.relaxation
        return True

    def __repr__(self) -> str:
        return f"RadiusNovelty({self.in_keys}, radius={self.radius})"
