"""Tree policies: which option a descent takes in a node.

:class:`UCT`, :class:`PUCT` and :class:`Gumbel` run inside the compiled descent. A policy of your
own is any callable over :class:`NodeStatistics`; it sees the nodes of one level of all descents at
once.

Letters: ``d`` nodes at which descents stand, ``A`` options.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from tensordict import TensorClass
from torch import Tensor

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.planners.docstrings import KeepsDocstring


class NodeStatistics(TensorClass, metaclass=KeepsDocstring):
    """What a tree policy may look at: the nodes where descents of a wave stand, ``[d]``.

    Visits include the options that are being simulated in the same wave. The value of an option
    that was never tried is 0; ``allowed`` says which ones may be chosen.

    Attributes:
        node_visits (Tensor): ``[d]`` float32, visits n of the node, its own evaluation included.
        node_values (Tensor): ``[d]`` float32, value V of the node.
        depths (Tensor): ``[d]`` int64, options from the root.
        option_visits (Tensor): ``[d, A]`` float32, n_j.
        option_values (Tensor): ``[d, A]`` float32, Q_j = R_j + D_j V_j.
        option_squares (Tensor): ``[d, A]`` float32, sum of the squared returns that Q_j is the mean
            of.
        priors (Tensor): ``[d, A]`` float32, P(s, a): sums to 1 over the options that no mask
            forbids, 0 for the others.
        allowed (Tensor): ``[d, A]`` bool.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> def least_visited(statistics):
        ...     return -statistics.option_visits  # [d, A] scores, of which the highest wins
        >>> env = ChainEnv(length=4)
        >>> MCTSPlanner(env, tree_policy=least_visited).plan(env.reset()).options.tolist()
        [1, 1, 1]
    """

    node_visits: Tensor
    node_values: Tensor
    depths: Tensor
    option_visits: Tensor
    option_values: Tensor
    option_squares: Tensor
    priors: Tensor
    allowed: Tensor


ScoreFunction = Callable[[NodeStatistics], Tensor]
"""A tree policy of your own: statistics ``[d]`` to scores ``[d, A]``, of which the highest wins."""


@dataclass(frozen=True)
class UCT:
    r"""Upper confidence bounds applied to trees.

    .. math:: \arg\max_j\; X_j + c \sqrt{\ln n / n_j}

    :math:`X_j = R_j + D_j V_j` is the value of option :math:`j`, :math:`n_j` its visits, :math:`n`
    the visits of the node (its own evaluation included). An option without visits comes first.

    Args:
        c: exploration constant, in units of the return. Default ``1.0``.

    Raises:
        ValueError: if ``c`` is negative or not finite.

    Reference:
        Kocsis and Szepesvari, "Bandit based Monte-Carlo planning", 2006; dissertation, section
        2.4.2.

    Example:
        >>> UCT(c=0.5).c
        0.5
    """

    c: float = 1.0

    def __post_init__(self) -> None:
        _check("UCT", self.c)


@dataclass(frozen=True)
class PUCT:
    r"""Predictor upper confidence bounds: exploration in proportion to a prior.

    .. math:: \arg\max_a\; Q(s,a) + c\, P(s,a)\, \frac{\sqrt{\sum_b N(s,b)}}{1 + N(s,a)}

    P sums to 1 over the options that the mask allows. Options behind which nothing is left to
    find keep their share.

    Args:
        c: exploration constant, in units of :math:`Q`. Default ``1.25``.
        unvisited_value: Q of an option without visits, where values are not normalised. Default
            ``0.0``.
        normalize: scales :math:`Q` to [0, 1], so that ``c`` needs no tuning to the size of the
            rewards: ``"siblings"`` by the lowest and highest value among the node and its options,
            ``"tree"`` by those of the whole tree so far. An option without visits counts as 0.
            Default: not at all.
        c_base: lets ``c`` grow with the visits N of the node, its own evaluation included, as
            :math:`c + \ln((N + c_{base} + 1) / c_{base})`, and puts that N under the root. Default:
            neither.

    Raises:
        ValueError: if a number is out of range, or ``normalize`` is not one of the names.

    Reference:
        Silver et al., 2017; dissertation, section 5.2.1. Schrittwieser et al., arXiv 1911.08265,
        appendix B, for ``c_base`` and the normalised values.

    Example:
        >>> PUCT(c=2.0).unvisited_value
        0.0
        >>> PUCT.mctx()
        PUCT(c=1.25, unvisited_value=0.0, normalize='siblings', c_base=19652.0)
    """

    c: float = 1.25
    unvisited_value: float = 0.0
    normalize: Literal["siblings", "tree"] | None = None
    c_base: float | None = None

    def __post_init__(self) -> None:
        _check("PUCT", self.c)
        if self.normalize not in (None, "siblings", "tree"):
            raise ValueError(
                f"PUCT: normalize is None, 'siblings' or 'tree'; got {self.normalize!r}."
            )
        if not math.isfinite(self.unvisited_value):
            raise ValueError(
                f"PUCT needs an unvisited_value that is finite; got {self.unvisited_value}."
            )
        if self.c_base is not None and not (math.isfinite(self.c_base) and self.c_base > 0.0):
            raise ValueError(f"PUCT needs c_base > 0, or None for a constant c; got {self.c_base}.")

    @classmethod
    def mctx(cls) -> PUCT:
        """Return the formula of MuZero with the constants of mctx's ``muzero_policy``."""
        return cls(c=1.25, normalize="siblings", c_base=19652.0)


@dataclass(frozen=True)
class Gumbel:
    r"""Gumbel search: sequential halving at the root, a policy improvement below it.

    At the root, ``max_considered`` options are drawn without replacement by Gumbel noise
    :math:`g` and halved while the simulations are spent; the survivor of the largest

    .. math:: g(a) + \ln P(s,a) + \sigma(\hat Q(s,a)), \qquad
              \sigma(q) = (c_{visit} + \max_b N(s,b))\, c_{scale}\, q

    is chosen. Below the root, visits follow the improved policy

    .. math:: \arg\max_a\; \pi'(a) - \frac{N(s,a)}{1 + \sum_b N(s,b)}, \qquad
              \pi' = \mathrm{softmax}(\ln P + \sigma(\hat Q)).

    :math:`\hat Q` are values scaled to [0, 1] within the node; an option without visits is
    completed by the mixed value of the node. It chooses well with very few simulations. The
    planner must know their number (``SearchBudget(simulations=...)``) and takes one option at a
    time (``expand="one"``, ``leaves_per_wave=1``).

    Args:
        max_considered: options considered at the root. Default 16.
        c_visit: Default 50.
        c_scale: Default 0.1.
        scale: of the Gumbel noise; 0 for a search without noise. Default 1.

    Raises:
        ValueError: if a number is out of range.

    Reference:
        Danihelka et al., "Policy improvement by planning with Gumbel", ICLR 2022.

    Example:
        >>> Gumbel(max_considered=4).considered_visits(num_considered=4, num_simulations=8)
        [0, 0, 0, 0, 1, 1, 2, 2]
    """

    max_considered: int = 16
    c_visit: float = 50.0
    c_scale: float = 0.1
    scale: float = 1.0

    def __post_init__(self) -> None:
        whole_number("Gumbel", "max_considered", self.max_considered, least=1)
        for name in ("c_visit", "c_scale", "scale"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"Gumbel needs {name} >= 0 that is finite; got {value}.")

    @staticmethod
    def considered_visits(num_considered: int, num_simulations: int) -> list[int]:
        """Return how many visits an option must have to be tried in simulation 0, 1, 2, ..."""
        if num_considered <= 1:
            return list(range(num_simulations))
        rounds = math.ceil(math.log2(num_considered))
        visits = [0] * num_considered
        sequence: list[int] = []
        remaining = num_considered
        while len(sequence) < num_simulations:
            for _ in range(max(1, num_simulations // (rounds * remaining))):
                sequence += visits[:remaining]
                for i in range(remaining):
                    visits[i] += 1
            remaining = max(2, remaining // 2)
        return sequence[:num_simulations]


TreePolicy = UCT | PUCT | Gumbel | ScoreFunction


def _check(name: str, c: float) -> None:
    if not (math.isfinite(c) and c >= 0.0):
        raise ValueError(f"{name} needs an exploration constant c >= 0 that is finite; got {c}.")
