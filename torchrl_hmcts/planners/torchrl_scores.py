"""The scores of ``torchrl.modules.mcts`` as tree policies.

Letters: ``d`` nodes at which descents stand, ``A`` options.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules.mcts.scores import EXP3Score, MCTSScores, UCB1TunedScore

from torchrl_hmcts.planners.tree_policies import NodeStatistics

# Instead of 0 visits where a score divides by them. Adding 1 to it gives exactly 1.
_FEW_VISITS = 1e-30
_QUANTITIES = ("win_count", "visits", "total_visits", "prior_prob", "sum_squared_rewards")
_QUANTITIES_OF_EXP3 = ("weights", "num_actions")


class TorchRLScore:
    r"""Makes a score module of ``torchrl.modules.mcts`` a tree policy of the planner.

    In each node the module is given, per option :math:`a` with value :math:`Q_a` and visits
    :math:`n_a`: the win count :math:`n_a Q_a`, the visits, the total :math:`\sum_b n_b`, the prior,
    and the sum of squared returns. The option of the highest score is taken. An option without
    visits has :math:`Q_a = 0` in ``PUCTScore`` and ``UCBScore`` (which by themselves give NaN), and
    comes first in ``UCB1TunedScore``. ``PUCTScore(c=c)`` builds the same trees as the compiled
    :class:`PUCT`, at the cost of a policy in Python.

    ``EXP3Score`` needs adapting. Its weights are those that the importance-weighted returns would
    have given if each option had been drawn as often as it was expected to be,

    .. math:: w_a = \exp\Bigl(\frac{\gamma}{K} \sum_{t: a_t = a} \frac{r_t}{p_t}\Bigr) \approx
              \exp\Bigl(\frac{\gamma}{K}\, N Q_a\Bigr), \qquad p_t \approx \frac{n_a}{N}, \quad
              N = \sum_b n_b,

    and nothing is drawn: the option with the largest :math:`p_a / (1 + n_a)` is taken, which
    spreads visits in proportion to the probabilities. EXP3's guarantee against an adversary is
    that of random draws and does not carry over. Like UCB1-Tuned it is meant for returns in [0, 1].

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
