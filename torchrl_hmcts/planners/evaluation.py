"""The evaluation of new nodes: priors and values by a planner's parts, in one checked call.

Letters: m nodes, A options.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_hmcts.checks import no_class
from torchrl_hmcts.planners.outcomes import RootStates, check_priors, check_values
from torchrl_hmcts.planners.random_streams import with_seeds
from torchrl_hmcts.planners.settings import SearchSettings
from torchrl_hmcts.planners.simulator import Simulator


class Evaluation(NamedTuple):
    """Priors and values of states; None if not known.

    Attributes:
        priors (Tensor): ``[m, A]`` probabilities of the options. Default: uniform.
        values (Tensor): ``[m]`` or ``[m, 1]`` values. Default: 0.

    Example:
        >>> import torch
        >>> from torchrl_hmcts.planners import Evaluation, MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> def to_the_right(td):  # priors and values of states, together
        ...     priors = torch.tensor([0.1, 0.9]).expand(len(td), 2)
        ...     return Evaluation(priors, td["state"].float() / 10)
        >>> env = ChainEnv(length=4)
        >>> MCTSPlanner(env, leaf_evaluator=to_the_right).plan(env.reset()).options.tolist()
        [1, 1, 1]
    """

    priors: Tensor | None = None
    values: Tensor | None = None


Evaluator = Callable[[TensorDictBase], Any]
"""``evaluator(td [m])`` returns a tensor or an :class:`Evaluation`."""


class NodeEvaluator:
    """Computes priors and values of new nodes; priors of ``option_prior`` take precedence."""

    def __init__(
        self, leaf_evaluator: Evaluator | None, option_prior: Evaluator | None, num_options: int
    ) -> None:
        self.leaf_evaluator, self.option_prior = leaf_evaluator, option_prior
        self.num_options = num_options
        self._parts = [part for part in (leaf_evaluator, option_prior) if part is not None]
        for name, part in (("leaf_evaluator", leaf_evaluator), ("option_prior", option_prior)):
            no_class("MCTSPlanner", name, part)
            if part is not None and not callable(part):
                raise TypeError(f"{name} must be callable on a tensordict; got {part!r}.")
            if type(part).__module__.startswith("torch.nn."):
                wrapper = "ValueEvaluator" if name == "leaf_evaluator" else "ModulePrior"
                raise TypeError(
                    f"{name} is called on a tensordict; got {type(part).__name__}, which reads "
                    f"tensors. Write {name}={wrapper}(TensorDictModule(net, in_keys, out_keys))."
                )

    def describe(
        self,
        td: TensorDictBase,
        terminated: np.ndarray,
        simulator: Simulator,
        settings: SearchSettings,
        seeds: Callable[[], np.ndarray],
    ) -> RootStates:
        """Return all that a search knows of states ``[m]`` before it is in them."""
        novelty, transpositions = settings.novelty, settings.transpositions
        priors, values = self(td, terminated, seeds)
        return RootStates(
            values=values,
            done=simulator.done(td),
            priors=priors,
            masks=simulator.masks(td),
            features=None if novelty is None else novelty.features(td),
            codes=None if transpositions is None else transpositions.codes(td),
        )

    def bind(self, simulator: Simulator, gamma: float) -> None:
        """Give the simulator and the discount to the parts that simulate."""
        for part in self._parts:
            if hasattr(part, "bind"):
                part.bind(simulator, gamma)

    def __call__(
        self, td: TensorDictBase, terminated: np.ndarray, seeds: Callable[[], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return priors ``[m, A]``, or ``[0, A]`` if all are equal, and values ``[m]``, float32."""
        m, num_options = td.batch_size[0], self.num_options
        priors, values = np.zeros((0, num_options), np.float32), np.zeros(m, np.float32)
        if not self._parts:
            return priors, values
        td = td.clone()  # what is stored must not depend on what the parts do with it
        found = Evaluation()
        if self.leaf_evaluator is not None:
            answer = self.leaf_evaluator(with_seeds(self.leaf_evaluator, td, seeds))
            found = answer if isinstance(answer, Evaluation) else Evaluation(values=answer)
        if self.option_prior is not None:
            answer = self.option_prior(with_seeds(self.option_prior, td, seeds))
            prior = answer.priors if isinstance(answer, Evaluation) else answer
            found = found._replace(priors=prior)
        if found.priors is not None:
            checked = check_priors(found.priors, (m, num_options), "option prior")
            priors = checked.float().numpy()
        if found.values is not None:
            checked = check_values(found.values, m, "leaf evaluator")
            values = np.where(terminated, np.float32(0.0), checked.numpy())
        return priors, values
