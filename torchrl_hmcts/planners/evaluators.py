"""Leaf evaluators and option priors: a search's first estimates for a new state.

Letters: ``m`` states of one call, ``A`` options, ``w`` rollouts that still run.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_hmcts.checks import nested_key, real_number, whole_number
from torchrl_hmcts.direct_calls import has_hooks, is_plain
from torchrl_hmcts.planners.evaluation import Evaluation, Evaluator
from torchrl_hmcts.planners.outcomes import check_priors, check_values
from torchrl_hmcts.planners.random_streams import SEED_KEY, mix, uniform_bits, with_seeds
from torchrl_hmcts.planners.simulator import Simulator


class ValueEvaluator:
    r"""Takes the value of a state from a network: :math:`V(s) = v_\theta(s)`.

    The network is called without gradients, in its present mode (call ``module.eval()`` yourself),
    and does not become a part of the planner. Networks may round differently when more states share
    a call; then the last digits of a tree depend on the trees beside it.

    Args:
        module: a TensorDictModule whose inputs are entries of the macro environment.
        value_key: its output to use, ``[m, 1]`` or ``[m]``. Default ``"state_value"``.

    Raises:
        TypeError: if ``module`` is no TensorDictModule.
        ValueError: if it has no output ``value_key``.

    Reference:
        Silver et al., "Mastering the game of Go without human knowledge", 2017.

    Example:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.planners import MCTSPlanner, ValueEvaluator
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> class Distance(torch.nn.Module):
        ...     def forward(self, state):
        ...         return state / 10
        >>> value = TensorDictModule(Distance(), in_keys=["state"], out_keys=["state_value"])
        >>> env = ChainEnv(length=5)
        >>> planner = MCTSPlanner(env, leaf_evaluator=ValueEvaluator(value))
        >>> planner(env.reset())["action"]
        tensor(1)
    """

    def __init__(self, module: TensorDictModuleBase, value_key: NestedKey = "state_value") -> None:
        self._network = _Network("ValueEvaluator", module, value_key)
        self.module = module
        self.in_keys = self._network.in_keys

    def __call__(self, td: TensorDictBase) -> Tensor:
        return self._network(td)[0]

    def __repr__(self) -> str:
        return f"ValueEvaluator({self._network})"


class ModulePrior:
    r"""Takes the prior of the options from a network: :math:`P(s, \cdot)`.

    Args:
        module: a TensorDictModule that writes probabilities or logits ``[m, A]``. Of a
            ``ProbabilisticActor`` only the part before the distribution is used.
        prob_key: its output with probabilities.
        logits_key: its output with logits, of which the softmax is taken. Default, if neither key
            is given: ``"probs"`` if the module writes it, else ``"logits"``.

    Raises:
        TypeError: if ``module`` is no TensorDictModule.
        ValueError: if both keys are given, or the module does not write the entry.

    Reference:
        Silver et al., "Mastering the game of Go without human knowledge", 2017.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.planners import ModulePrior
        >>> net = TensorDictModule(torch.nn.Identity(), in_keys=["x"], out_keys=["logits"])
        >>> ModulePrior(net)(TensorDict({"x": torch.zeros(1, 4)}, [1]))
        tensor([[0.2500, 0.2500, 0.2500, 0.2500]])
    """

    def __init__(
        self,
        module: TensorDictModuleBase,
        *,
        prob_key: NestedKey | None = None,
        logits_key: NestedKey | None = None,
    ) -> None:
        if prob_key is not None and logits_key is not None:
            raise ValueError(
                f"ModulePrior reads probabilities or logits; got prob_key={prob_key!r} and "
                f"logits_key={logits_key!r}. Leave one of the two out."
            )
        self.module = module
        if isinstance(module, ProbabilisticTensorDictSequential):
            module = module.det_part
        key = prob_key if logits_key is None else logits_key
        if key is None:
            writes = getattr(module, "out_keys", ())
            key = "logits" if "probs" not in writes and "logits" in writes else "probs"
            logits_key = key if key == "logits" else None
        self._network = _Network("ModulePrior", module, key)
        self._is_logits = logits_key is not None
        self.in_keys = self._network.in_keys

    def __call__(self, td: TensorDictBase) -> Tensor:
        out = self._network(td)[0]
        return torch.softmax(out.to(torch.float32), -1) if self._is_logits else out

    def __repr__(self) -> str:
        return f"ModulePrior({self._network})"


class PolicyValueEvaluator:
    r"""Takes the prior of the options and the value of a state from one network, in one call.

    .. math:: P(s, a) = (1 - \epsilon)\, \mathrm{softmax}_a(l_\theta(s) / T) + \epsilon / A, \qquad
              V(s) = v_\theta(s)

    A planner needs it only as ``leaf_evaluator``; it saves the second call that a
    :class:`ValueEvaluator` beside a :class:`ModulePrior` makes, and calls the network like it.

    Args:
        module: a TensorDictModule whose inputs are entries of the macro environment and which
            writes logits ``[m, A]`` and values ``[m, 1]`` or ``[m]``.
        temperature: T > 0 of the prior. Default 1.
        uniform_share: :math:`\epsilon` in [0, 1], so that no option is ruled out. Default 0.
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
        >>> planner = MCTSPlanner(env, tree_policy=PUCT(), leaf_evaluator=guide, expand="one")
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
        self._network = _Network("PolicyValueEvaluator", module, logits_key, value_key)
        self.temperature = real_number(
            "PolicyValueEvaluator", "temperature", temperature, above=0.0, finite=False
        )
        self.uniform_share = real_number(
            "PolicyValueEvaluator", "uniform_share", uniform_share, least=0.0, most=1.0
        )
        self.module = module
        self.in_keys = self._network.in_keys

    def __call__(self, td: TensorDictBase) -> Evaluation:
        logits, values = self._network(td)
        priors = torch.softmax(logits.to(torch.float32) / self.temperature, -1)
        if self.uniform_share:
            priors = (1.0 - self.uniform_share) * priors + self.uniform_share / priors.shape[-1]
        return Evaluation(priors, values)

    def __repr__(self) -> str:
        return (
            f"PolicyValueEvaluator({self._network}, temperature={self.temperature}, "
            f"uniform_share={self.uniform_share})"
        )


@dataclass(eq=False)
class RolloutEvaluator:
    r"""Takes the value of a state from rollouts that begin there: the textbook's simulation step.

    .. math:: V(s) = R_1 + D_1 (R_2 + D_2 (\dots (R_n + D_n\, b(s_n)))), \qquad D_i = \gamma^{k_i}

    A policy takes options of :math:`k_i` base steps in the planner's own simulator, up to the end
    of the episode or ``max_options``. :math:`b` is 0 at a terminal state, else the bootstrap
    evaluator's value. All rollouts of a wave share a simulator call per option. A state's value
    depends on the state and its seed only. The budget of the search does not count these steps;
    ``num_base_steps`` does.

    Args:
        policy: ``policy(td) -> probabilities [m, A]``, e.g. :class:`ModulePrior`. Default: uniform.
        max_options: options of a rollout at most. Default 10.
        num_rollouts: rollouts from each state, of which the mean is taken. Default 1.
        bootstrap: evaluator of the state in which a rollout is cut off. Default: 0.

    Raises:
        ValueError: if a number is below 1; at the call if the policy gives no probabilities.
        RuntimeError: at the call if no planner has given it a simulator.

    Reference:
        Kocsis and Szepesvari, "Bandit based Monte-Carlo planning", 2006; dissertation, section
        2.4.2.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner, RolloutEvaluator
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=5)
        >>> rollouts = RolloutEvaluator(max_options=20, num_rollouts=4)
        >>> planner = MCTSPlanner(env, leaf_evaluator=rollouts, seed=0)
        >>> planner(env.reset())["action"]
        tensor(1)
        >>> rollouts.num_base_steps > 0
        True
    """

    policy: Evaluator | None = None
    max_options: int = 10
    num_rollouts: int = 1
    bootstrap: Evaluator | None = field(default=None, kw_only=True)
    is_random: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name in ("max_options", "num_rollouts"):
            number = whole_number("RolloutEvaluator", name, getattr(self, name), least=1)
            setattr(self, name, number)
        self.in_keys = _joined_keys(policy=self.policy, bootstrap=self.bootstrap)
        self.num_base_steps = 0
        self._simulator: Simulator | None = None
        self._gamma = 1.0

    def bind(self, simulator: Simulator, gamma: float) -> None:
        """Take the simulator and the discount per base step of a planner; a planner calls this."""
        bound = self._simulator
        if bound is not None and (
            bound.given_env is not simulator.given_env or gamma != self._gamma
        ):
            raise ValueError(
                "This RolloutEvaluator belongs to a planner with another env or discount. Make "
                "one for each planner."
            )
        self._simulator, self._gamma = simulator, gamma
        _bind(self.bootstrap, simulator, gamma)

    @torch.no_grad()
    def __call__(self, td: TensorDictBase) -> Tensor:
        simulator = self._simulator
        if simulator is None:
            raise RuntimeError(
                "RolloutEvaluator has no simulator yet. Pass it to a planner, "
                "MCTSPlanner(env, leaf_evaluator=...), or call its bind(simulator, gamma)."
            )
        num_states, device = td.batch_size[0], td.device
        streams = self._streams(td)  # [m * num_rollouts]
        values, discounts = np.zeros(len(streams)), np.ones(len(streams))
        walkers = np.arange(len(streams))  # [w] rollouts that still run
        if self.num_rollouts > 1:
            td = td[torch.arange(num_states).repeat_interleave(self.num_rollouts)]
        for step in range(self.max_options + 1):
            terminated = simulator.terminated(td)
            stops = terminated | simulator.done(td) | (step == self.max_options)
            masks = None if simulator.mask_key is None else simulator.masks(td)
            if masks is not None:
                stops |= ~masks.any(-1)
            if self.bootstrap is not None:
                cut = np.flatnonzero(stops & ~terminated)
                if len(cut):
                    rows = walkers[cut]
                    seeds = uniform_bits(streams[rows], step)
                    values[rows] += discounts[rows] * self._bootstrap(_rows(td, cut), seeds)
            runs = np.flatnonzero(~stops)
            if not len(runs):
                break
            if len(runs) < len(walkers):
                td, walkers = _rows(td, runs), walkers[runs]
                masks = None if masks is None else masks[runs]
            options = self._draw(td, masks, uniform_bits(streams[walkers], step))
            td = simulator.step(simulator.state(td), options)
            durations = simulator.durations(td)
            rewards = simulator.rewards(td)
            if not np.isfinite(rewards).all():
                raise ValueError(
                    f"The simulator returned a reward of {rewards[~np.isfinite(rewards)][0]} in a "
                    f"rollout. Rewards must be finite; find the step from which the env wrote it."
                )
            values[walkers] += discounts[walkers] * rewards
            discounts[walkers] *= self._gamma**durations
            self.num_base_steps += int(durations.sum())
        means = values.reshape(num_states, self.num_rollouts).mean(-1)
        return torch.from_numpy(means.astype(np.float32)).to(device or "cpu")

    def _streams(self, td: TensorDictBase) -> np.ndarray:
        """One random stream for each rollout, uint64 ``[m * num_rollouts]``."""
        seeds = td.get(SEED_KEY, None)
        if seeds is None:
            raise ValueError(
                f'RolloutEvaluator reads a seed for each state from "{SEED_KEY}" (int64 [m]), '
                f"which a planner writes; this tensordict has none. Outside of a planner set it: "
                f'td.set("{SEED_KEY}", torch.arange(len(td))).'
            )
        states = mix(seeds.cpu().reshape(-1).numpy().astype(np.uint64))
        rollouts = np.arange(self.num_rollouts, dtype=np.uint64)
        return mix(states[:, None] + rollouts).reshape(-1)

    def _draw(self, td: TensorDictBase, masks: np.ndarray | None, bits: np.ndarray) -> np.ndarray:
        """Draw an option for each state, int64 ``[w]``, from random bits, uint64 ``[w]``."""
        assert self._simulator is not None
        shape = (td.batch_size[0], self._simulator.num_options)
        weights = np.ones(shape) if masks is None else masks.astype(np.float64)
        if self.policy is not None:
            given = check_priors(self.policy(td), shape, "rollout policy").double().numpy()
            weights = weights * given
        cumulative = weights.cumsum(-1)
        total = cumulative[:, -1:]
        if not (total > 0.0).all():
            raise ValueError(
                "The rollout policy gives probability 0 to every option that may be taken in a "
                "state. Give each option some."
            )
        # 32 bits keep the threshold below the total: an option of weight 0 is never met.
        threshold = (bits >> np.uint64(32)).astype(np.float64)[:, None] * 2.0**-32 * total
        options: np.ndarray = (cumulative <= threshold).sum(-1)
        return options

    def _bootstrap(self, td: TensorDictBase, bits: np.ndarray) -> np.ndarray:
        assert self.bootstrap is not None
        td = with_seeds(self.bootstrap, td, lambda: (bits >> np.uint64(1)).astype(np.int64))
        return check_values(self.bootstrap(td), len(td), "bootstrap").double().numpy()


@dataclass(eq=False)
class MixedEvaluator:
    r"""A mean of two evaluators, e.g. of a value network and rollouts.

    .. math:: V(s) = (1 - \lambda)\, V_1(s) + \lambda\, V_2(s)

    Args:
        first: the evaluator :math:`V_1`.
        second: the evaluator :math:`V_2`.
        weight: :math:`\lambda`, in [0, 1]. Default 0.5.

    Raises:
        ValueError: if the weight is not in [0, 1].

    Reference:
        Silver et al., "Mastering the game of Go with deep neural networks and tree search", 2016.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.planners import MixedEvaluator
        >>> mixed = MixedEvaluator(lambda td: td["a"], lambda td: td["b"], weight=0.25)
        >>> mixed(TensorDict({"a": torch.zeros(2), "b": torch.ones(2)}, [2]))
        tensor([0.2500, 0.2500])
    """

    first: Evaluator
    second: Evaluator
    weight: float = 0.5

    def __post_init__(self) -> None:
        self.weight = real_number("MixedEvaluator", "weight", self.weight, least=0.0, most=1.0)
        self.in_keys = _joined_keys(first=self.first, second=self.second)
        self.is_random = any(getattr(p, "is_random", False) for p in (self.first, self.second))

    def bind(self, simulator: Simulator, gamma: float) -> None:
        """Give the simulator and the discount of a planner to both evaluators."""
        for part in (self.first, self.second):
            _bind(part, simulator, gamma)

    def __call__(self, td: TensorDictBase) -> Tensor:
        first = check_values(self.first(td), len(td), "first evaluator")
        second = check_values(self.second(td), len(td), "second evaluator")
        return (1.0 - self.weight) * first + self.weight * second


class _Network:
    """Outputs of a TensorDictModule, whose bookkeeping costs six times a small network's call."""

    def __init__(self, owner: str, module: TensorDictModuleBase, *keys: NestedKey) -> None:
        if not isinstance(module, TensorDictModuleBase):
            raise TypeError(
                f"{owner} needs a TensorDictModule; got {type(module).__name__}. Wrap a network: "
                f'TensorDictModule(net, in_keys=["observation"], out_keys={list(keys)!r}).'
            )
        writes = [unravel_key(k) for k in module.out_keys]
        self.keys = [nested_key(owner, "its outputs", k) for k in keys]
        for key in self.keys:
            if key not in writes:
                raise ValueError(f"{owner} reads {key!r}; its module writes {writes}.")
        self.in_keys = [unravel_key(k) for k in module.in_keys]
        self.module = module
        if type(module) is TensorDictSequential and len(module) == 1:
            module = module[0]
        self._inner = module
        self._indices = [writes.index(key) for key in self.keys]
        self._num_outputs = len(writes)
        self._direct = self.in_keys == module.in_keys and is_plain(module)

    def __call__(self, td: TensorDictBase) -> list[Tensor]:
        inner = self._inner
        if self._direct and not has_hooks(inner):
            out = inner.module(*(td.get(key) for key in self.in_keys))
            outputs = out if isinstance(out, tuple) else (out,)
            if len(outputs) == self._num_outputs:
                chosen = [outputs[i] for i in self._indices]
                if all(isinstance(output, Tensor) for output in chosen):
                    return chosen
        after = self.module(td.select(*self.in_keys))
        return [after.get(key) for key in self.keys]

    def __repr__(self) -> str:
        return f"{self.in_keys} -> {', '.join(map(repr, self.keys))}"


def _joined_keys(**parts: Evaluator | None) -> list[NestedKey]:
    for name, part in parts.items():
        if part is not None and not callable(part):
            raise TypeError(f"{name} must be callable on a tensordict; got {part!r}.")
    keys = (unravel_key(key) for part in parts.values() for key in getattr(part, "in_keys", ()))
    return list(dict.fromkeys(keys))


def _bind(part: Evaluator | None, simulator: Simulator, gamma: float) -> None:
    bind = getattr(part, "bind", None)
    if bind is not None:
        bind(simulator, gamma)


def _rows(td: TensorDictBase, rows: np.ndarray) -> TensorDictBase:
    return td if len(rows) == td.batch_size[0] else td[torch.from_numpy(rows)]
