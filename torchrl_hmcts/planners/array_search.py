"""Tree search over a transition function on plain arrays: the engine without tensordicts.

Letters: ``B`` roots, ``A`` options, ``m`` outcomes of one wave.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.planners.outcomes import Outcomes, RootStates
from torchrl_hmcts.planners.root_options import halve
from torchrl_hmcts.planners.search import Search
from torchrl_hmcts.planners.settings import SearchSettings
from torchrl_hmcts.planners.structured_states import as_rows
from torchrl_hmcts.planners.tree import LARGEST, MOST_NODES
from torchrl_hmcts.planners.tree_policies import PUCT, CompiledPolicy, TreePolicy

Array = np.ndarray | Tensor

_SIZE = f"must be finite and smaller than {LARGEST:g}, so that sums of them are finite"
_RANGES = {  # lowest, highest, and the rule
    "reward": (-LARGEST, LARGEST, f"rewards {_SIZE}"),
    "value": (-LARGEST, LARGEST, f"values {_SIZE}"),
    "prior": (0.0, LARGEST, "probabilities must be finite and not negative"),
    "discount": (0.0, 1.0, "discounts, gamma ** duration, must be finite and in [0, 1]"),
}


class Root(NamedTuple):
    """The states to search from.

    Attributes:
        prior (Array): ``[B, A]`` float32, probabilities of options; scaled so that those of the
            allowed options sum to 1.
        value (Array): ``[B]`` float32.
        embedding (Array): ``[B, ...]`` the state as the transition function reads it, any dtype; a
            mapping or tuple of such arrays, nested in any way, or a TensorDict; or a list of B
            states of any kind, which no other code may change.

    Example:
        >>> import numpy as np
        >>> prior, value = np.full((1, 2), 0.5, np.float32), np.zeros(1, np.float32)
        >>> root = Root(prior, value, embedding=np.array([[3.0]]))
        >>> root.prior.shape, root.embedding.shape
        ((1, 2), (1, 1))
    """

    prior: Array
    value: Array
    embedding: Any


class Transition(NamedTuple):
    """Outcomes of options: the answer of a transition function.

    Attributes:
        reward (Array): ``[m]`` float32, R.
        discount (Array): ``[m]`` float32, D: gamma ** duration, 0 for a terminal state.
        prior (Array): ``[m, A]`` float32, probabilities of options in the next state, scaled to
            sum to 1.
        value (Array): ``[m]`` float32, of the next state.
        embedding (Array): ``[m, ...]`` of the next state, with the structure, shapes and dtypes of
            the roots'; a list of m states if the roots' is a list.

    Example:
        >>> import numpy as np
        >>> def double(embedding, option):  # every option doubles the state and earns 1
        ...     one = np.ones(len(option), np.float32)
        ...     prior = np.full((len(option), 2), 0.5, np.float32)
        ...     return Transition(one, 0.9 * one, prior, 0 * one, 2 * embedding)
        >>> double(np.array([[3.0]]), np.array([1])).embedding
        array([[6.]])
    """

    reward: Array
    discount: Array
    prior: Array
    value: Array
    embedding: Any


TransitionFunction = Callable[[Any, Any], Transition]


def tree_search(
    root: Root,
    transition: TransitionFunction,
    num_simulations: int,
    *,
    tree_policy: TreePolicy | None = None,
    backup: Literal["mean", "max"] = "mean",
    mask: Array | None = None,
    leaves_per_wave: int = 1,
    exhausted: Literal["skip", "revisit"] = "revisit",
    seed: int = 0,
) -> Search:
    r"""Search from ``B`` states at once with a transition function of your own.

    The counterpart of mctx's ``muzero_policy(params, key, root, recurrent_fn)``, with the planner's
    trees, policies and backups. Every simulation takes one option in one leaf, for all roots in one
    call of ``transition``, and backs up :math:`Q = R + D\, V`.

    Args:
        root: states to search from, NumPy arrays or CPU tensors. The transition function gets the
            same kind as the embedding, or as the prior if the embedding is a list.
        transition: ``transition(embedding [m, ...], option [m] int64) -> Transition`` of contiguous
            float32 arrays. Its arguments are copies; the next call uses their memory again.
        num_simulations: per root.
        tree_policy, backup, leaves_per_wave, exhausted: as in :class:`SearchSettings`, but by
            default ``PUCT()`` and ``"revisit"``.
        mask: bool ``[B, A]``, options that may be taken in the roots. Default: all.
        seed: of the Gumbel noise; root ``b`` draws from ``seed + b``.

    Returns:
        The :class:`Search`; ``search.tree.view().children_visits[:, 0]`` are the visits of the
        roots' options. The tree keeps no states.

    Raises:
        ValueError: if shapes do not fit, a number is out of range or not finite (rewards and
            values are smaller than 1e30, discounts in [0, 1]), or ``Gumbel`` comes with several
            leaves per wave.
        TypeError: if the transition function returns another kind of array than it was given.

    Reference:
        The interface: mctx, in "The DeepMind JAX Ecosystem", 2020.

    Example:
        A chain of five states, of which the last ends the episode with reward 1:

        >>> import numpy as np
        >>> from torchrl_hmcts.planners import Root, Transition, tree_search
        >>> def transition(state, option):
        ...     state = np.clip(state + 2 * option - 1, 0, 4)
        ...     end = (state == 4).astype(np.float32)
        ...     prior = np.full((len(state), 2), 0.5, np.float32)
        ...     return Transition(end, 0.9 * (1 - end), prior, 0 * end, state)
        >>> root = Root(np.full((1, 2), 0.5, np.float32), np.zeros(1, np.float32), np.array([2]))
        >>> search = tree_search(root, transition, num_simulations=30)
        >>> search.tree.view().children_visits[:, 0].argmax(-1)
        tensor([1])
    """
    settings = SearchSettings(
        tree_policy=PUCT() if tree_policy is None else tree_policy,
        backup=backup,
        expand="one",
        leaves_per_wave=leaves_per_wave,
        exhausted=exhausted,
    )
    embedding, of_rows = as_rows(root.embedding, isinstance(root.prior, Tensor))
    root, transition = root._replace(embedding=embedding), of_rows(transition)
    prior, value = _check_root(root)
    num_roots, num_options = prior.shape
    num_simulations = whole_number("tree_search", "num_simulations", num_simulations, least=1)
    if num_simulations >= MOST_NODES:
        raise ValueError(
            f"tree_search makes room for a node per simulation, fewer than {MOST_NODES:,}; got "
            f"num_simulations={num_simulations}."
        )
    settings.check_simulations(num_simulations)
    search = Search(num_roots, num_options, settings, capacity=num_simulations + 1)
    no_masks = np.zeros((0, num_options), np.bool_)
    masks = no_masks if mask is None else np.ascontiguousarray(np.asarray(mask, np.bool_))
    if mask is not None and masks.shape != (num_roots, num_options):
        raise ValueError(f"mask must be bool {[num_roots, num_options]}; got {list(masks.shape)}.")
    if mask is not None and not masks.any(-1).all():
        raise ValueError(
            f"Root {int(np.flatnonzero(~masks.any(-1))[0])} has no option that may be taken: its "
            f"mask is all False. Leave it out of the batch."
        )
    search.plant(RootStates(value, np.zeros(num_roots, np.bool_), prior, masks))
    search.limit(num_simulations)
    search.seed(seed)
    if settings.is_gumbel:
        halve(search, num_simulations)
    loop = _Loop(search, root.embedding, transition, no_masks)
    if isinstance(settings.tree_policy, CompiledPolicy):
        loop.run()
    else:
        loop.run_in_python()
    return search


class _Loop:
    """Moves embeddings between the trees and the transition function, as rows of bytes."""

    def __init__(
        self, search: Search, embedding: Array, transition: TransitionFunction, masks: np.ndarray
    ) -> None:
        self.search, self.transition, self.masks = search, transition, masks
        self.is_tensor = isinstance(embedding, Tensor)
        first = np.ascontiguousarray(_numpy(embedding))
        rows = len(search._wave)
        self.dtype, self.shape = first.dtype, first.shape[1:]
        self.size = self.dtype.itemsize * math.prod(self.shape)
        self.nothing = first[:0]
        self.stored = np.zeros((search.num_roots, search.tree.capacity, self.size), np.uint8)
        self.stored[:, 0] = _bytes(first).reshape(len(first), self.size)
        self.buffer = np.zeros(rows * self.size, np.uint8)
        # Copies: the transition function may write into what it is given.
        self.given = np.zeros(rows, np.int64)
        self.options: Any = self.given
        self.states: Any = self.buffer.view(self.dtype).reshape(rows, *self.shape)
        if self.is_tensor:
            self.states, self.options = map(torch.from_numpy, (self.states, self.options))

    def run(self) -> None:
        from torchrl_hmcts.planners import batch_kernels

        search, tree = self.search, self.search.tree
        transition: Callable[..., Any] = self.transition
        states, options, size = self.states, self.options, len(self.states)
        arrays = (
            tree.nodes,
            tree.edges,
            tree.roots,
            search.record,
            search.gumbel,
            search._wave,
            self.masks,
            self.stored,
            self.buffer,
            self.given,
        )
        at, advance = batch_kernels.handle(*arrays), batch_kernels.advance_at
        if not batch_kernels.COMPILED:

            def advance(at: Any, *outcomes: Any) -> Any:
                return batch_kernels.advance(*arrays, *outcomes)

        # As bytes, any dtype and shape runs the same code; indices are spared the conversion.
        as_bytes = not batch_kernels.COMPILED or self.dtype != np.int64 or self.shape != ()
        none, no_prior = np.zeros(0, np.float32), np.zeros((0, search.num_options), np.float32)
        nothing = _bytes(self.nothing) if as_bytes else self.nothing
        count = advance(at, 0, none, none, none, no_prior, nothing)
        dtype, shape, is_tensor, first = self.dtype, self.shape, self.is_tensor, True
        while count:
            if count == size:
                answer = transition(states, options)
            else:
                answer = transition(states[:count], options[:count])
            try:
                if first:
                    self._check(answer, count)
                    first = False
                reward, discount, prior, value, embedding = answer
                if is_tensor:
                    reward, discount, prior, value, embedding = (
                        x.detach().numpy() for x in (reward, discount, prior, value, embedding)
                    )
                if embedding.dtype is not dtype:  # as bytes it might look right
                    self._check(answer, count)
                if as_bytes:
                    if embedding.shape[1:] != shape:
                        self._check(answer, count)
                    embedding = _bytes(embedding)
                count = advance(at, count, reward, discount, value, prior, embedding)
            except Exception:
                self._check(answer, count)
                raise

    def run_in_python(self) -> None:
        """The same with a tree policy that is not compiled."""
        search = self.search
        states = self.stored.view(self.dtype).reshape(*self.stored.shape[:2], *self.shape)
        active = np.arange(search.num_roots)
        while len(active):
            wave = search.select(active)
            if len(wave):
                state, option = states[wave.roots, wave.nodes], wave.options
                answer = self.transition(
                    *map(torch.from_numpy, (state, option)) if self.is_tensor else (state, option)
                )
                self._check(answer, len(wave))
                reward, discount, prior, value, embedding = map(_numpy, answer)
                done = discount == 0.0
                outcomes = Outcomes(
                    rewards=reward,
                    discounts=discount,
                    durations=np.ones(len(wave), np.int64),
                    done=done,
                    values=np.where(done, np.float32(0.0), value),
                    priors=prior,
                    masks=self.masks,
                )
                states[wave.roots, search.insert(wave, outcomes)] = embedding
            active = active[search.roots["simulations"][active] < search.roots["limit"][active]]
            if not search.revisits_exhausted:
                active = active[~search.exhausted(active)]

    def _check(self, answer: Transition, count: int) -> None:
        """Check what a transition function returns; the compiled loop relies on it."""
        num_options = self.search.num_options
        shapes = {
            "reward": (count,),
            "discount": (count,),
            "prior": (count, num_options),
            "value": (count,),
            "embedding": (count, *self.shape),
        }
        if not isinstance(answer, tuple) or len(answer) != len(shapes):
            raise TypeError(
                f"The transition function returned {type(answer).__name__}; return a Transition of "
                f"{', '.join(shapes)}."
            )
        for (name, shape), array in zip(shapes.items(), answer, strict=True):
            dtype = self.dtype if name == "embedding" else np.dtype(np.float32)
            if not isinstance(array, Tensor if self.is_tensor else np.ndarray):
                raise TypeError(
                    f"The transition function returned {name} as {type(array).__name__}; return "
                    f"what the embedding is, a {'tensor' if self.is_tensor else 'NumPy array'}."
                )
            if isinstance(array, Tensor):
                contiguous = array.is_contiguous() and not array.is_neg()
                same = array.dtype == torch.from_numpy(np.empty(0, dtype)).dtype
            else:
                contiguous, same = array.flags.c_contiguous, array.dtype == dtype
            if tuple(array.shape) != shape or not same or not contiguous:
                order = "" if contiguous else " (not contiguous)"
                got = str(array.dtype).removeprefix("torch.")  # NumPy has no bfloat16
                raise ValueError(
                    f"The transition function returned {name} as {got} {list(array.shape)}"
                    f"{order}; it must be {dtype} {list(shape)} and contiguous."
                )
            if name != "embedding":
                found = f"The transition function returned the {name} {{number}}"
                _check_range(found, name, _numpy(array))


def _check_range(found: str, name: str, array: np.ndarray) -> None:
    """Refuse numbers that no search can use; ``found`` says of which array, with its {number}."""
    low, high, rule = _RANGES[name]
    if array.size and not (low <= float(array.min()) and float(array.max()) <= high):
        bad = array[~((array >= np.float64(low)) & (array <= np.float64(high)))][0]
        raise ValueError(f"{found.format(number=bad)}; {rule}.")


def _bytes(array: np.ndarray) -> np.ndarray:
    return array.reshape(-1).view(np.uint8)


def _numpy(array: Array) -> np.ndarray:
    if not isinstance(array, Tensor):
        return np.asarray(array)
    array = array.detach().cpu().resolve_neg()
    return (array.float() if array.dtype is torch.bfloat16 else array).numpy()


def _check_root(root: Root) -> tuple[np.ndarray, np.ndarray]:
    prior, value = (
        np.ascontiguousarray(_numpy(x), dtype=np.float32) for x in (root.prior, root.value)
    )
    if prior.ndim != 2 or not prior.shape[1]:
        raise ValueError(
            f"The roots' prior must be [B, A]; got {list(prior.shape)}. A is 1 or more."
        )
    for name, array in (("value", value), ("embedding", root.embedding)):
        if array.ndim < 1 or len(array) != len(prior) or (name == "value" and array.ndim > 1):
            raise ValueError(
                f"The roots' {name} must have one row for each of the {len(prior)} rows of the "
                f"prior; got shape {list(array.shape)}."
            )
    if root.embedding.dtype in (torch.bfloat16, np.dtype(object)):
        raise TypeError(
            f"The roots' embedding must be rows of numbers that NumPy has; got "
            f"{root.embedding.dtype}. Pass float32, or a list of states."
        )
    for name, array in (("prior", prior), ("value", value)):
        _check_range(f"The roots' {name} holds {{number}}, which is no {name}", name, array)
    return prior, value
