"""What a search is told of new nodes: the values and priors that a planner's parts give, checked.

Letters: m nodes, A options.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.planners.transpositions import Transpositions
from torchrl_hmcts.planners.tree import LARGEST

Evaluator = Callable[[TensorDictBase], Tensor]

# Entry with a seed for each state, int64 [m], given to evaluators that draw random numbers.
SEED_KEY = "_seed"


def leaf_values(
    evaluator: Evaluator | None,
    td: TensorDictBase,
    terminated: np.ndarray,
    seeds: Callable[[], np.ndarray],
) -> np.ndarray:
    """Return the values of nodes, float32 ``[m]``: 0 of terminal ones and without an evaluator.

    Args:
        evaluator: ``evaluator(td) -> values``, ``[m]`` or ``[m, 1]``.
        td: state and observation of the nodes, ``[m]``.
        terminated: which are terminal, bool ``[m]``.
        seeds: called for the seeds of the nodes, int64 ``[m]``, if the evaluator draws numbers.

    Raises:
        TypeError: if the evaluator returns no tensor.
        ValueError: if its values have another shape or are not finite.
    """
    if evaluator is None:
        return np.zeros(td.batch_size[0], np.float32)
    if getattr(evaluator, "is_random", False):
        td = td.copy().set(SEED_KEY, torch.from_numpy(seeds()))
    values = _as_tensor(evaluator(td), "leaf_evaluator")
    num_states = td.batch_size[0]
    if tuple(values.shape) not in ((num_states,), (num_states, 1)):
        raise ValueError(
            f"The leaf evaluator returned shape {list(values.shape)}; it must give one value "
            f"per state, [{num_states}] or [{num_states}, 1]."
        )
    values_np: np.ndarray = values.reshape(-1).to(torch.float32).cpu().numpy()
    good = np.abs(values_np) < LARGEST
    if not good.all():
        raise ValueError(
            f"The leaf evaluator returned {values_np[~good][0]}. Values must be finite and smaller "
            f"than {LARGEST:g}; check the network's input and weights."
        )
    return np.where(terminated, np.float32(0.0), values_np)


def option_priors(evaluator: Evaluator | None, td: TensorDictBase, num_options: int) -> np.ndarray:
    """Return the priors of nodes' options, float32 ``[m, A]``, or ``[0, A]`` if all are equal.

    The search scales those of the options that may be taken to sum to 1.

    Args:
        evaluator: ``evaluator(td) -> probabilities [m, A]``.
        td: state and observation of the nodes, ``[m]``.
        num_options: A.

    Raises:
        TypeError: if the evaluator returns no tensor.
        ValueError: if its probabilities have another shape, are negative or not finite.
    """
    if evaluator is None:
        return np.zeros((0, num_options), np.float32)
    priors = _as_tensor(evaluator(td), "option_prior")
    shape = (td.batch_size[0], num_options)
    if tuple(priors.shape) != shape:
        raise ValueError(
            f"The option prior returned shape {list(priors.shape)}; it must give one "
            f"probability per node and option, {list(shape)}."
        )
    priors = priors.to(torch.float32)
    good = (priors >= 0) & (priors < LARGEST)
    if not good.all():
        bad = priors[~good][0].item()
        raise ValueError(
            f"The option prior returned {bad}. Probabilities must be finite and not negative; "
            f"apply a softmax to logits."
        )
    return priors.cpu().contiguous().numpy()


def node_features(novelty: NoveltyTest | None, td: TensorDictBase) -> np.ndarray | None:
    """Return what a novelty test looks at in nodes, ``[m, F]``, or None without one."""
    return None if novelty is None else novelty.features(td)


def node_codes(transpositions: Transpositions | None, td: TensorDictBase) -> np.ndarray | None:
    """Return the states of nodes as bytes, uint8 ``[m, K]``, or None without transpositions."""
    return None if transpositions is None else transpositions.codes(td)


def _as_tensor(value: Tensor, name: str) -> Tensor:
    if not isinstance(value, Tensor):
        raise TypeError(
            f"{name} must return a tensor; got {type(value).__name__}. Wrap a TensorDictModule as "
            f'lambda td: module(td)["state_value"].'
        )
    return value
