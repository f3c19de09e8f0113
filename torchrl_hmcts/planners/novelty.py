"""Novelty tests: which new nodes are worth searching.

Letters: ``B`` roots, ``m`` new nodes of a wave, ``F`` features.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key

from torchrl_hmcts.checks import instance, nested_keys, real_number, whole_number


class NoveltyTest(Protocol):
    """Protocol of a novelty test; a test of your own needs these members.

    A method ``statistics() -> dict`` is optional: its counts join those of the search.

    Example:
        >>> import numpy as np
        >>> class Always:  # finds everything new
        ...     in_keys = []
        ...     def start(self, num_roots): ...
        ...     def restart(self, root): ...
        ...     def features(self, tensordict):
        ...         return np.zeros((len(tensordict), 0), np.float32)
        ...     def accept(self, roots, features, base_steps):
        ...         return np.ones(len(roots), bool)
        ...     def relax(self, root):
        ...         return False
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> MCTSPlanner(env, novelty=Always()).plan(env.reset()).options.tolist()
        [1, 1, 1]
    """

    in_keys: list[NestedKey]

    def start(self, num_roots: int) -> None:
        """Forget everything: ``num_roots`` searches begin.

        Assign new arrays here: each search starts a shallow copy of the test.
        """

    def restart(self, root: int) -> None:
        """Forget the states of one root."""

    def features(self, tensordict: TensorDictBase) -> np.ndarray:
        """Return the features of states, ``[m, F]`` of any numeric type."""

    def accept(self, roots: np.ndarray, features: np.ndarray, base_steps: np.ndarray) -> np.ndarray:
        """Return which of the new states are novel, bool ``[m]``, in order, and remember those.

        ``base_steps`` (int64 ``[m]``) lie between the root and the state.
        """

    def relax(self, root: int) -> bool:
        """Be less strict for one exhausted root; return False if that is impossible."""


def ask(
    test: NoveltyTest, roots: np.ndarray, features: np.ndarray, base_steps: np.ndarray
) -> np.ndarray:
    """Return the answer of a novelty test, bool ``[m]``, checked."""
    novel = np.asarray(test.accept(roots, features, base_steps))
    if novel.shape != (len(features),) or novel.dtype != np.bool_:
        raise ValueError(
            f"The novelty test returned {novel.dtype} {list(novel.shape)}; return a bool for each "
            f"of the {len(features)} states, True where it is new."
        )
    return novel


class _Compiled:
    """Novelty by a compiled loop, which stops where it needs more room, and its counts."""

    num_tested: int
    _dtype: type
    _tally: np.ndarray
    _num_features = -1  # not known yet

    def accept(self, roots: np.ndarray, features: np.ndarray, base_steps: np.ndarray) -> np.ndarray:
        """Return which new states are novel, bool ``[m]``, and remember those."""
        features = np.ascontiguousarray(features, self._dtype)
        if self._num_features < 0:
            self._make_room(features.shape[1])
        if features.shape[1] != self._num_features:
            raise ValueError(
                f"{self} has seen states with {self._num_features} features; got "
                f"{features.shape[1]}. Call start(num_roots) before testing others."
            )
        accepted = np.zeros(len(roots), np.bool_)
        begin = self._accept(roots, features, base_steps, accepted, 0)
        while begin < len(roots):
            self._make_room(features.shape[1])
            begin = self._accept(roots, features, base_steps, accepted, begin)
        self.num_tested += len(roots)
        return accepted

    def _make_room(self, num_features: int) -> None:
        raise NotImplementedError

    def _accept(self, *wave: Any) -> int:
        raise NotImplementedError

    @property
    def num_refused(self) -> int:
        """Number of the states that were refused."""
        return int(self._tally[0])

    def statistics(self) -> dict[str, int]:
        """Return how many tests were made, and how many states they refused.

        Tests repeated after a relaxation, or when the root moved on, are counted again.
        """
        return {"novelty_tested": self.num_tested, "novelty_refused": self.num_refused}


class RadiusNovelty(_Compiled):
    r"""Refuses a state that lies within a radius of one already in its tree.

    .. math:: \text{novel}(s) \iff \min_{s' \in A} \lVert \phi(s) - \phi(s') \rVert \ge r

    with :math:`A` the accepted states and :math:`\phi` the entries ``key`` side by side, each times
    its scale. This makes a search over options in a continuous space finite. The radius must be
    smaller than the distance that an option covers, or every outcome is refused. An exhausted
    search shrinks the radius and reopens refused nodes.

    With ``shorter_paths`` a state is novel as well if its :math:`k` base steps from the root are
    fewer than those of all accepted states around it, so that plans get shorter after the first:

    .. math:: k(s) < \min_{s' \in A,\, \lVert \phi(s) - \phi(s') \rVert < r} k(s')

    States lie in a grid of cells, so that the cost of a test does not depend on the size of the
    tree.

    Args:
        key: entry or entries of the simulator's state or observation, ``[*B, f]``.
        radius: in units of the (scaled) entries.
        scale: factor of each entry. Default: all 1.
        relaxation: factor of the radius when a search is exhausted, in ``(0, 1)``. Default 0.75.
        max_relaxations: how often the radius of a search may be relaxed. Default 14, to a sixtieth.
        shorter_paths: also accept a state near others if it is reached in fewer base steps, for a
            budget that continues after the first plan (``improve_expansions``). Default False.
        encoder (TensorDictModule, optional): writes ``key`` from entries of the state or
            observation, e.g. a :class:`~torchrl_hmcts.modules.SkillEncoder`. Default: none.

    Raises:
        ValueError: if no key is given, the radius is not positive, the scales do not match the
            keys, or a factor is out of its range.

    Reference:
        Width-1 novelty: Lipovetzky, Ramirez and Geffner, "Classical planning with simulators",
        2015. Shorter paths: Li, Littlefield and Bekris, "Asymptotically optimal sampling-based
        kinodynamic planning", 2016.

    Example:
        >>> import numpy as np, torch
        >>> novelty = RadiusNovelty("position", radius=0.5)
        >>> novelty.start(num_roots=1)
        >>> states = np.array([[0, 0], [0, 0.4], [0, 0.6]], np.float32)
        >>> novelty.accept(np.array([0, 0, 0]), states, base_steps=np.array([0, 10, 10]))
        array([ True, False,  True])
    """

    _dtype = np.float32

    def __init__(
        self,
        key: NestedKey | Sequence[NestedKey],
        radius: float,
        *,
        scale: Sequence[float] | None = None,
        relaxation: float = 0.75,
        max_relaxations: int = 14,
        shorter_paths: bool = False,
        encoder: TensorDictModuleBase | None = None,
    ) -> None:
        self.keys = nested_keys("RadiusNovelty", "key", key)
        self.encoder, self.in_keys = encoder, self.keys
        if encoder is not None:
            instance("RadiusNovelty", "encoder", encoder, TensorDictModuleBase)
            if unknown := set(self.keys) - {unravel_key(k) for k in encoder.out_keys}:
                raise ValueError(
                    f"RadiusNovelty compares {sorted(map(str, unknown))}; its encoder writes "
                    f"{encoder.out_keys}."
                )
            self.in_keys = [unravel_key(k) for k in encoder.in_keys]
        self.radius = real_number("RadiusNovelty", "radius", radius, above=0.0)
        if scale is not None:
            instance("RadiusNovelty", "scale", scale, Sequence, np.ndarray)
        self.scale = [1.0] * len(self.keys) if scale is None else list(scale)
        if len(self.scale) != len(self.keys):
            raise ValueError(
                f"RadiusNovelty needs one scale per key; got {self.scale} for {self.keys}."
            )
        for factor in self.scale:
            real_number("RadiusNovelty", "scale", factor)
        self.relaxation = real_number("RadiusNovelty", "relaxation", relaxation)
        if not 0.0 < self.relaxation < 1.0:
            raise ValueError(
                f"RadiusNovelty needs a relaxation in (0, 1), by which an exhausted search shrinks "
                f"its radius; got {relaxation}."
            )
        self.max_relaxations = whole_number("RadiusNovelty", "max_relaxations", max_relaxations)
        instance("RadiusNovelty", "shorter_paths", shorter_paths, bool)
        self.shorter_paths = shorter_paths
        self.start(0)

    def start(self, num_roots: int) -> None:
        """Forget everything: ``num_roots`` searches begin."""
        self._num_roots, self._num_features = num_roots, -1
        self._known: np.ndarray | None = None  # [B] of novelty_kernels.RADIUS_ROOT
        self._relaxed = np.zeros(num_roots, np.int64)
        self.num_tested = 0
        self._tally = np.zeros(2, np.int64)

    def _make_room(self, num_features: int) -> None:
        """Allocate for the first states, or double what there is; the grids are built again."""
        from torchrl_hmcts.planners.novelty_kernels import RADIUS_ROOT, accept_distant

        self._accept_distant, self._num_features = accept_distant, num_features
        if self._known is None:
            self._known = np.zeros(self._num_roots, RADIUS_ROOT)
            self._known["radius"] = self.radii
            self._seen = np.zeros((self._num_roots, 0, num_features), np.float32)
            self._seen_steps = np.zeros((self._num_roots, 0), np.int64)
        old = self._seen.shape[1]
        shape = (self._num_roots, max(64, 2 * old))
        seen = np.zeros((*shape, num_features), np.float32)
        seen[:, :old] = self._seen
        steps = np.zeros(shape, np.int64)
        steps[:, :old] = self._seen_steps
        self._seen, self._seen_steps = seen, steps
        self._links = np.zeros(shape, np.int32)
        self._heads = np.zeros(shape, np.int32)
        self._known["cell"] = 0.0

    @property
    def radii(self) -> np.ndarray:
        """The radius of each root after its relaxations, float64 ``[B]``."""
        return self.radius * self.relaxation**self._relaxed

    def features(self, tensordict: TensorDictBase) -> np.ndarray:
        """Return the features of states, ``[m, F]``."""
        if self.encoder is not None:
            with torch.no_grad():
                tensordict = self.encoder(tensordict.select(*self.in_keys))
        parts = [tensordict.get(key).to(torch.float32) for key in self.keys]
        scaled = zip(parts, self.scale, strict=True)
        return _side_by_side([part if scale == 1.0 else part * scale for part, scale in scaled])

    def restart(self, root: int) -> None:
        """Forget the states of one root."""
        self._relaxed[root] = 0
        if self._known is not None:
            self._known[root] = 0
            self._known["radius"][root] = self.radius

    def _accept(self, *wave: Any) -> int:
        arrays = self._seen, self._seen_steps, self._links, self._heads, self._known, self._tally
        begin: int = self._accept_distant(*arrays, self.shorter_paths, *wave)
        return begin

    def relax(self, root: int) -> bool:
        """Be less strict for one root from now on; False if that is impossible."""
        if self._relaxed[root] >= self.max_relaxations:
            return False
        self._relaxed[root] += 1
        if self._known is not None:
            self._known["radius"][root] = self.radii[root]
        return True

    def statistics(self) -> dict[str, int]:
        """Return the counts; with ``shorter_paths`` also of states new for a shorter path alone."""
        counts = super().statistics()
        if self.shorter_paths:
            counts["novelty_shorter"] = int(self._tally[1])
        return counts

    def __repr__(self) -> str:
        shorter = ", shorter_paths=True" if self.shorter_paths else ""
        return f"RadiusNovelty({self.keys}, radius={self.radius}{shorter})"


class WidthNovelty(_Compiled):
    r"""Refuses a state in which no feature has a value that is new to its tree.

    .. math:: \text{novel}(s) \iff \exists f:\ \lvert \{ s' \in A : s'_f = s_f \} \rvert < n

    with :math:`A` the accepted states. :math:`n` is 1, and one more each time a search is
    exhausted. This is width-1 search, the "IW(1)" of classical planning, meant for discrete
    features, e.g. the 128 RAM bytes of an Atari game.

    Args:
        key: entry or entries of the simulator's state or observation, ``[*B, f]``, of an integer
            type or bool.
        max_relaxations: how often :math:`n` may be raised for a search. Default 14; at most 254.
        stages (sequence of int): number of features, counted from the first, to compare at first,
            after one relaxation, and so on; after the last stage all are compared, and only then
            :math:`n` is raised. Features that tell many states apart come last. Default: all.

    Raises:
        ValueError: if no key is given, ``max_relaxations`` is out of its range, or the stages do
            not rise from 1; at the call, if there are no more features than in the last stage.
        TypeError: at the call, if an entry is not of an integer type.

    Reference:
        Lipovetzky, Ramirez and Geffner, "Classical planning with simulators: results on the Atari
        video games", 2015.

    Example:
        >>> import numpy as np
        >>> novelty = WidthNovelty("ram")
        >>> novelty.start(num_roots=1)
        >>> states = np.array([[1, 1], [2, 1], [2, 2], [1, 2]], np.uint8)
        >>> novelty.accept(np.array([0, 0, 0, 0]), states, base_steps=np.array([0, 1, 1, 2]))
        array([ True,  True,  True, False])
    """

    _dtype = np.int64

    def __init__(
        self,
        key: NestedKey | Sequence[NestedKey],
        *,
        max_relaxations: int = 14,
        stages: Sequence[int] = (),
    ) -> None:
        self.in_keys = nested_keys("WidthNovelty", "key", key)
        instance("WidthNovelty", "stages", stages, Sequence)
        self.stages = tuple(whole_number("WidthNovelty", "stages", n, least=1) for n in stages)
        if any(a >= b for a, b in pairwise(self.stages)):
            raise ValueError(
                f"WidthNovelty compares more features in each stage; got stages={self.stages}."
            )
        self.max_relaxations = whole_number("WidthNovelty", "max_relaxations", max_relaxations)
        if self.max_relaxations > 254:
            raise ValueError(
                f"WidthNovelty counts values up to 255, so that max_relaxations is from 0 to 254; "
                f"got {max_relaxations}."
            )
        self.start(0)

    def start(self, num_roots: int) -> None:
        """Forget everything: ``num_roots`` searches begin."""
        self._limits = np.ones(num_roots, np.int64)
        self._stage = np.zeros(num_roots, np.int64)
        self._used: np.ndarray | None = None
        self._num_features = -1
        self.num_tested = 0
        self._tally = np.zeros(1, np.int64)

    def features(self, tensordict: TensorDictBase) -> np.ndarray:
        """Return the features of states, ``[m, F]``."""
        parts = []
        for key in self.in_keys:
            part = tensordict.get(key)
            if part.is_floating_point() or part.is_complex():
                raise TypeError(
                    f"WidthNovelty compares discrete values; {key!r} is of type {part.dtype}. Use "
                    f"RadiusNovelty({key!r}, radius=...), or discretise the entry."
                )
            parts.append(part.to(torch.uint8) if part.dtype == torch.bool else part)
        return _side_by_side(parts)

    def restart(self, root: int) -> None:
        """Forget the states of one root."""
        self._limits[root], self._stage[root] = 1, 0
        if self._used is not None:
            self._used[root] = 0
            self._counts[root] = 0
            self._owners[root] = -1

    def _make_room(self, num_features: int) -> None:
        """Allocate the hash tables of values, or double them."""
        from torchrl_hmcts.planners import novelty_kernels

        self._kernels = novelty_kernels
        num_roots = len(self._limits)
        if self._used is None:
            if self.stages and self.stages[-1] >= num_features:
                raise ValueError(
                    f"WidthNovelty(stages={self.stages}) needs more than {self.stages[-1]} "
                    f"features; {self.in_keys} have {num_features}."
                )
            self._num_features = num_features
            self._compared = np.array([*self.stages, num_features])  # features, by stage
            self._used = np.zeros(num_roots, np.int64)  # values in the table
            self._slots = np.zeros(num_features, np.int64)
            self._values = np.zeros((num_roots, 0), np.int64)
            self._owners = np.zeros((num_roots, 0), np.int32)
            self._counts = np.zeros((num_roots, 0), np.uint8)
        size = 64
        while size < 4 * num_features or size <= self._owners.shape[1]:
            size *= 2
        values = np.zeros((num_roots, size), np.int64)
        owners = np.full((num_roots, size), -1, np.int32)
        counts = np.zeros((num_roots, size), np.uint8)
        self._kernels.move_values(self._values, self._owners, self._counts, values, owners, counts)
        self._values, self._owners, self._counts = values, owners, counts

    def _accept(self, *wave: Any) -> int:
        arrays = self._values, self._owners, self._counts, self._used, self._limits
        compared = self._compared[self._stage]
        begin: int = self._kernels.accept_new(*arrays, compared, self._tally, self._slots, *wave)
        return begin

    def relax(self, root: int) -> bool:
        """Be less strict for one root from now on; False if that is impossible."""
        if self._stage[root] < len(self.stages):
            self._stage[root] += 1
            return True
        if self._limits[root] > self.max_relaxations:
            return False
        self._limits[root] += 1
        return True

    def __repr__(self) -> str:
        stages = f", stages={self.stages}" if self.stages else ""
        return f"WidthNovelty({self.in_keys}{stages})"


def _side_by_side(parts: list[torch.Tensor]) -> np.ndarray:
    flat = [part.reshape(len(part), part.shape[1:].numel()) for part in parts]
    joined = flat[0] if len(flat) == 1 else torch.cat(flat, -1)
    return joined.cpu().contiguous().numpy()
