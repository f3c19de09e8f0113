"""One network with two heads as option prior and leaf evaluator, called once per node.

Letters: ``m`` states of one call, ``A`` options.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.planners.node_evaluation import Evaluator


class PolicyValueEvaluator:
    r"""A network that says both what to try and what a state is worth, called once for both.

    .. math:: P(s, a) = (1 - \epsilon)\, \mathrm{softmax}_a(l_\theta(s) / T) + \epsilon / A, \qquad
              V(s) = v_\theta(s)

    Give a planner its two sides: ``MCTSPlanner(env, leaf_evaluator=guide.value,
    option_prior=guide.prior, ...)``. The values of a wave's new nodes are asked for first; their
    logits are kept until the prior asks for the same states, which saves the second call that a
    :class:`ValueEvaluator` beside a :class:`ModulePrior` would make. The network is called in the
    mode it is in, without gradients where the planner calls it, and never becomes part of it.

    Args:
        module: a TensorDictModule whose inputs are entries of the macro environment and which
            writes logits ``[m, A]`` and values ``[m, 1]`` or ``[m]``.
        temperature: T > 0 of the prior. Default 1.
        uniform_share: :math:`\epsilon` in [0, 1], how much of the prior is spread over all options,
            so that none is ruled out by a network that is too sure. Default 0.
        logits_key, value_key: its outputs. Defaults ``"logits"`` and ``"state_value"``.

    Raises:
        TypeError: if ``module`` is no TensorDictModule.
        ValueError: if it does not write both entries, or a number is out of its range.

    Reference:
        Silver et al., "Mastering the game of Go without human knowledge", 2017.

    Example:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.planners import PUCT, MCTSPlanner, PolicyValueEvaluator
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> class Right(torch.nn.Module):
        ...     def forward(self, state):
        ...         logits = torch.tensor([0.0, 5.0]).expand(len(state), 2)
        ...         return logits, state / 10
        >>> guide = PolicyValueEvaluator(
        ...     TensorDictModule(Right(), in_keys=["state"], out_keys=["logits", "state_value"]))
        >>> env = ChainEnv(length=5)
        >>> planner = MCTSPlanner(env, tree_policy=PUCT(), leaf_evaluator=guide.value,
        ...                       option_prior=guide.prior, expand="one")
        >>> planner(env.reset())["num_simulations"].item()  # without it: 30
        4
    """

    def __init__(
        self,
        module: TensorDictModuleBase,
        *,
        temperature: float = 1.0,
        uniform_share: float = 0.0,
        logits_key: NestedKey = "logits",
        value_key: NestedKey = "state_value",
    ) -> None:
        if not isinstance(module, TensorDictModuleBase):
            raise TypeError(
                f"PolicyValueEvaluator needs a TensorDictModule; got {type(module).__name__}. Wrap "
                f'a network: TensorDictModule(net, in_keys=["observation"], '
                f"out_keys=[{logits_key!r}, {value_key!r}])."
            )
        self.logits_key, self.value_key = unravel_key(logits_key), unravel_key(value_key)
        writes = [unravel_key(key) for key in module.out_keys]
        for key in (self.logits_key, self.value_key):
            if key not in writes:
                raise ValueError(
                    f"PolicyValueEvaluator reads {key!r}; its module writes {writes}. Name its "
                    f"outputs in logits_key and value_key."
                )
        if not temperature > 0.0:
            raise ValueError(f"PolicyValueEvaluator needs temperature > 0; got {temperature}.")
        if not 0.0 <= uniform_share <= 1.0:
            raise ValueError(
                f"PolicyValueEvaluator needs a uniform_share in [0, 1]; got {uniform_share}."
            )
        self.module = module
        self.temperature = temperature
        self.uniform_share = uniform_share
        self.in_keys = [unravel_key(key) for key in module.in_keys]
        self.value = _Side(self, self._value)
        self.prior = _Side(self, self._prior)
        self._kept: tuple[TensorDictBase, Tensor] | None = None

    def _value(self, td: TensorDictBase) -> Tensor:
        out = self.module(td.select(*self.in_keys))
        self._kept = (td, out.get(self.logits_key))
        return out.get(self.value_key)

    def _prior(self, td: TensorDictBase) -> Tensor:
        # Used once: an env may write its next states into the same tensordict.
        kept, self._kept = self._kept, None
        if kept is not None and kept[0] is td:
            logits = kept[1]
        else:
            logits = self.module(td.select(*self.in_keys)).get(self.logits_key)
        probs = torch.softmax(logits.to(torch.float32) / self.temperature, -1)
        if self.uniform_share:
            probs = (1.0 - self.uniform_share) * probs + self.uniform_share / probs.shape[-1]
        return probs

    def __repr__(self) -> str:
        return (
            f"PolicyValueEvaluator({self.in_keys} -> {self.logits_key!r}, {self.value_key!r}, "
            f"temperature={self.temperature}, uniform_share={self.uniform_share})"
        )


class _Side:
    """The value or the prior of a :class:`PolicyValueEvaluator`, in the form a planner reads."""

    def __init__(self, owner: PolicyValueEvaluator, compute: Evaluator) -> None:
        self.in_keys = owner.in_keys
        self._owner = owner
        self._compute = compute

    def __call__(self, td: TensorDictBase) -> Tensor:
        return self._compute(td)

    def __repr__(self) -> str:
        return repr(self._owner)
