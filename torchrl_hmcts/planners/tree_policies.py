"""Tree policies, which choose the option that a descent takes in a node.

Letters: ``d`` nodes at which descents stand, ``A`` options.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorClass, TensorDict, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules.mcts.scores import EXP3Score, MCTSScores, UCB1TunedScore

from torchrl_hmcts import notebook
from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.planners.tree import (
    GUMBEL_SCORE,
    PUCT_SCORE,
    RAW_VALUES,
    SIBLINGS,
    UCT_SCORE,
    WHOLE_TREE,
)


class NodeStatistics(TensorClass, metaclass=notebook.KeepsDocstring):
    """Statistics that a tree policy may read: the nodes where descents of a wave stand, ``[d]``.

    Visits include the options that are being simulated. Only ``allowed`` options may be chosen.

    Attributes:
        node_visits (Tensor): ``[d]`` float32, visits n of the node, its own evaluation included.
        node_values (Tensor): ``[d]`` float32, value V of the node.
        depths (Tensor): ``[d]`` int64, options from the root.
        option_visits (Tensor): ``[d, A]`` float32, n_j.
        option_values (Tensor): ``[d, A]`` float32, Q_j = R_j + D_j V_j; 0 if never tried.
        option_squares (Tensor): ``[d, A]`` float32, sum of the squared returns of an option.
        priors (Tensor): ``[d, A]`` float32, P(s, a); 0 for options that a mask forbids.
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


_MOST_HALVED = 2**24  # simulations of Gumbel, whose schedule holds counts in float32

ScoreFunction = Callable[[NodeStatistics], Tensor]
"""A tree policy of your own: statistics ``[d]`` to scores ``[d, A]``, of which the highest wins."""


class CompiledPolicy:
    """A tree policy that is a branch of ``kernels.best_option``."""

    def record(self) -> dict[str, float]:
        """Return the entries of ``tree.RECORD`` that the branch reads, its ``score`` among them."""
        raise NotImplementedError

    def continues(self, other: TreePolicy) -> bool:
        """Return whether a search by this policy has kept all that the other needs."""
        return type(self) is type(other)


@dataclass(frozen=True)
class UCT(CompiledPolicy):
    r"""Upper confidence bounds applied to trees.

    .. math:: \arg\max_j\; X_j + c \sqrt{\ln n / n_j}

    :math:`X_j = R_j + D_j V_j` is the value of option :math:`j`, :math:`n_j` its visits, :math:`n`
    those of the node, its evaluation included. An option without visits comes first.

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
        real_number("UCT", "c", self.c, least=0.0)

    def record(self) -> dict[str, float]:
        """Return what the kernels read."""
        return {"score": UCT_SCORE, "c": self.c}


@dataclass(frozen=True)
class PUCT(CompiledPolicy):
    r"""Predictor upper confidence bounds: exploration in proportion to a prior.

    .. math:: \arg\max_a\; Q(s,a) + c\, P(s,a)\, \frac{\sqrt{\sum_b N(s,b)}}{1 + N(s,a)}

    P sums to 1 over the options that the mask allows. An option keeps its share when nothing is
    left to find behind it.

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
        real_number("PUCT", "c", self.c, least=0.0)
        if self.normalize is not None and (
            not isinstance(self.normalize, str) or self.normalize not in ("siblings", "tree")
        ):
            raise ValueError(
                f"PUCT: normalize is None, 'siblings' or 'tree'; got {self.normalize!r}."
            )
        real_number("PUCT", "unvisited_value", self.unvisited_value)
        if self.c_base is not None:
            real_number("PUCT", "c_base", self.c_base, above=0.0)

    def record(self) -> dict[str, float]:
        """Return what the kernels read."""
        scales = {None: RAW_VALUES, "siblings": SIBLINGS, "tree": WHOLE_TREE}
        return {
            "score": PUCT_SCORE,
            "c": self.c,
            "c_base": self.c_base or 0.0,
            "unvisited_value": self.unvisited_value,
            "normalize": scales[self.normalize],
        }

    def continues(self, other: TreePolicy) -> bool:
        """Return whether the other policy scales values in the same way."""
        return isinstance(other, PUCT) and self.normalize == other.normalize

    @classmethod
    def mctx(cls) -> PUCT:
        """Return the formula of MuZero with the constants of mctx's ``muzero_policy``."""
        return cls(c=1.25, normalize="siblings", c_base=19652.0)


@dataclass(frozen=True)
class Gumbel(CompiledPolicy):
    r"""Gumbel search: sequential halving at the root, a policy improvement below it.

    At the root, ``max_considered`` options are drawn without replacement by Gumbel noise
    :math:`g` and halved while the simulations are spent; the survivor of the largest

    .. math:: g(a) + \ln P(s,a) + \sigma(\hat Q(s,a)), \qquad
              \sigma(q) = (c_{visit} + \max_b N(s,b))\, c_{scale}\, q

    is taken. Below the root, visits follow the improved policy

    .. math:: \arg\max_a\; \pi'(a) - \frac{N(s,a)}{1 + \sum_b N(s,b)}, \qquad
              \pi' = \mathrm{softmax}(\ln P + \sigma(\hat Q)).

    :math:`\hat Q` are values scaled to [0, 1] within the node; an option without visits has the
    mixed value of the node. It chooses well with few simulations, of a known number
    (``SearchBudget(simulations=...)``), one at a time (``expand="one"``, ``leaves_per_wave=1``).

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
            real_number("Gumbel", name, getattr(self, name), least=0.0)

    def record(self) -> dict[str, float]:
        """Return what the kernels read."""
        return {"score": GUMBEL_SCORE, "c": self.c_visit, "c_scale": self.c_scale}

    def continues(self, other: TreePolicy) -> bool:
        """Return whether the other policy has the same schedule."""
        return self == other

    @staticmethod
    def check_simulations(
        num_simulations: int | None, expand: str, leaves_per_wave: int, waves_in_flight: int
    ) -> None:
        """Refuse simulations of unknown or very large number, or several at a time."""
        if num_simulations is None or expand != "one" or leaves_per_wave * waves_in_flight != 1:
            raise ValueError(
                "Gumbel needs a fixed number of simulations of one option each; got "
                f"budget.simulations={num_simulations}, expand={expand!r}, "
                f"leaves_per_wave={leaves_per_wave}, waves_in_flight={waves_in_flight}. Pass "
                "budget=SearchBudget(simulations=32, until_plan=False), expand='one' and "
                "leaves_per_wave=1."
            )
        if num_simulations > _MOST_HALVED:
            raise ValueError(
                f"Gumbel plans every simulation ahead, {_MOST_HALVED:,} at most; got "
                f"{num_simulations:,}."
            )

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


TreePolicy = CompiledPolicy | ScoreFunction

# Instead of 0 visits where a score divides by them. Adding 1 to it gives exactly 1.
_FEW_VISITS = 1e-30
_QUANTITIES = ("win_count", "visits", "total_visits", "prior_prob", "sum_squared_rewards")
_QUANTITIES_OF_EXP3 = ("weights", "num_actions")


class TorchRLScore:
    r"""Makes a score module of ``torchrl.modules.mcts`` a tree policy of the planner.

    In each node the module is given, per option :math:`a` with value :math:`Q_a` and visits
    :math:`n_a`: the win count :math:`n_a Q_a`, the visits, the total :math:`\sum_b n_b`, the prior,
    and the sum of squared returns. An option without visits has :math:`Q_a = 0` in ``PUCTScore``
    and ``UCBScore`` (which by themselves give NaN), and comes first in ``UCB1TunedScore``.

    The weights of ``EXP3Score`` are those that the importance-weighted returns would have given if
    each option had been drawn as often as it was expected to be,

    .. math:: w_a = \exp\Bigl(\frac{\gamma}{K} \sum_{t: a_t = a} \frac{r_t}{p_t}\Bigr) \approx
              \exp\Bigl(\frac{\gamma}{K}\, N Q_a\Bigr), \qquad p_t \approx \frac{n_a}{N}, \quad
              N = \sum_b n_b,

    and the option with the largest :math:`p_a / (1 + n_a)` is taken, so visits are in proportion to
    the probabilities (EXP3's guarantee against an adversary holds for random draws only). Like
    UCB1-Tuned it is meant for returns in [0, 1].

    Args:
        score_module: e.g. ``PUCTScore(c=1.25)``, a member of ``MCTSScores``, or a module of your
            own that reads entries of these names (or says otherwise in its ``*_key`` attributes)
            and writes scores ``[d, A]`` to its first output. Numbers are float64.

    Raises:
        TypeError: if ``score_module`` is no TensorDictModule.
        ValueError: if it reads an entry that a search does not have.

    Reference:
        The scores of ``torchrl.modules.mcts``, which name their own papers.

    Example:
        >>> from torchrl.modules.mcts.scores import PUCTScore
        >>> from torchrl_hmcts.planners import MCTSPlanner, TorchRLScore
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=5)
        >>> planner = MCTSPlanner(env, tree_policy=TorchRLScore(PUCTScore(c=1.25)))
        >>> planner(env.reset())["action"]
        tensor(1)
    """

    def __init__(self, score_module: TensorDictModuleBase | MCTSScores) -> None:
        if isinstance(score_module, MCTSScores):
            score_module = score_module.value()
        if not isinstance(score_module, TensorDictModuleBase):
            raise TypeError(
                f"TorchRLScore needs a score module of torchrl.modules.mcts, e.g. "
                f"PUCTScore(c=1.25); got {score_module!r}. A function of NodeStatistics is a tree "
                f"policy without it."
            )
        self._is_exp3 = isinstance(score_module, EXP3Score)
        quantities = _QUANTITIES + (_QUANTITIES_OF_EXP3 if self._is_exp3 else ())
        names = {quantity: quantity for quantity in quantities}
        for quantity in quantities:
            key = getattr(score_module, f"{quantity}_key", None)
            if key is not None:
                names[unravel_key(key)] = quantity
        self._reads = {}
        for key in map(unravel_key, score_module.in_keys):
            if key not in names:
                raise ValueError(
                    f"{type(score_module).__name__} reads {key!r}, which a search does not have. "
                    f"It has {', '.join(quantities)}; name the entries so, or write the policy as "
                    f"a function of NodeStatistics."
                )
            self._reads[key] = names[key]
        self._score_key = unravel_key(getattr(score_module, "score_key", score_module.out_keys[0]))
        # UCB1Tuned puts options without visits first by itself.
        self._few_visits = 0.0 if isinstance(score_module, UCB1TunedScore) else _FEW_VISITS
        self.score_module = score_module

    def __call__(self, statistics: NodeStatistics) -> Tensor:
        node = TensorDict(
            {key: self._quantity(name, statistics) for key, name in self._reads.items()},
            batch_size=statistics.batch_size,
        )
        scores: Tensor = self.score_module(node).get(self._score_key)
        if self._is_exp3:
            scores = scores / (1.0 + statistics.option_visits)
        return scores

    def _quantity(self, name: str, statistics: NodeStatistics) -> Tensor:
        visits = statistics.option_visits.double()
        if name == "win_count":
            return visits * statistics.option_values
        if name == "visits":
            return visits.clamp_min(self._few_visits)
        if name == "total_visits":
            return visits.sum(-1)
        if name == "prior_prob":
            return statistics.priors.double()
        if name == "sum_squared_rewards":
            return statistics.option_squares.double()
        num_options = visits.shape[-1]
        if name == "num_actions":
            return torch.full(visits.shape[:-1], num_options)
        assert isinstance(self.score_module, EXP3Score)
        rate = self.score_module.gamma / num_options
        exponents = rate * visits.sum(-1, keepdim=True) * statistics.option_values
        exponents = exponents.masked_fill(~statistics.allowed, -torch.inf)
        # A common factor of the weights does not matter: the largest is 1, none overflows.
        return (exponents - exponents.amax(-1, keepdim=True)).exp()

    def __repr__(self) -> str:
        return f"TorchRLScore({type(self.score_module).__name__})"
