"""States of a search that are structures of arrays, or objects in a list, as arrays of rows.

Letters: ``m`` states of one call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

_Leaves = dict[str, np.ndarray | Tensor]


def as_rows(embedding: Any, as_tensor: bool) -> tuple[Any, Callable[..., Any]]:
    """Return states as an array of rows, and what makes a transition function one of rows."""
    if isinstance(embedding, (np.ndarray, Tensor)):
        return embedding, lambda transition: transition
    if isinstance(embedding, list):
        return _listed(embedding, as_tensor)
    if isinstance(embedding, (Mapping, tuple, TensorDictBase)):
        return _structured(embedding)
    raise TypeError(
        f"The roots' embedding is an array, a mapping or tuple of arrays, or a list of states; got "
        f"a {type(embedding).__name__}."
    )


def _listed(roots: list[Any], as_tensor: bool) -> tuple[Any, Callable[..., Any]]:
    """Keep the states in a list; a row is the place of one."""
    states = list(roots)

    def rows(begin: int) -> Any:
        places = np.arange(begin, len(states))
        return torch.from_numpy(places) if as_tensor else places

    def wrap(transition: Callable[..., Any]) -> Callable[..., Any]:
        def step(places: Any, option: Any) -> Any:
            answer, begin = transition([states[i] for i in places.tolist()], option), len(states)
            following = getattr(answer, "embedding", None)
            if not isinstance(following, list) or len(following) != len(places):
                raise ValueError(
                    f"The transition function got a list of {len(places)} states. It must return a "
                    f"Transition whose embedding is a list of {len(places)} states; got "
                    f"{_described(following)}."
                )
            states.extend(following)
            return answer._replace(embedding=rows(begin))

        return step

    return rows(0), wrap


def _structured(roots: Any) -> tuple[Any, Callable[..., Any]]:
    """Put the arrays of a structure side by side, as bytes."""
    leaves = dict(_leaves(roots))
    kinds = {isinstance(leaf, Tensor) for leaf in leaves.values()}
    if len(kinds) != 1 or not all(isinstance(x, (np.ndarray, Tensor)) for x in leaves.values()):
        got = {path: type(leaf).__name__ for path, leaf in leaves.items()}
        raise TypeError(f"A structure of states holds NumPy arrays only, or tensors; got {got}.")
    as_tensor, arrays = kinds.pop(), {path: _array(leaf) for path, leaf in leaves.items()}
    number = {len(array) if array.ndim else None for array in arrays.values()}
    if len(number) != 1 or None in number:
        shapes = {path: list(array.shape) for path, array in arrays.items()}
        raise ValueError(f"All arrays of a structure need one row for each root; got {shapes}.")
    events = {path: (array.dtype, array.shape[1:]) for path, array in arrays.items()}

    def pack(arrays: Mapping[str, np.ndarray]) -> Any:
        parts = [
            np.ascontiguousarray(array).reshape(len(array), -1).view(np.uint8)
            for array in arrays.values()
        ]
        packed = np.concatenate(parts, 1)
        return torch.from_numpy(packed) if as_tensor else packed

    def unpack(rows: Any) -> Any:
        data, at, found = _array(rows), 0, {}
        for path, (dtype, shape) in events.items():
            size = dtype.itemsize * int(np.prod(shape))
            part = np.ascontiguousarray(data[:, at : at + size]).view(dtype)
            part = part.reshape(len(data), *shape)
            found[path], at = torch.from_numpy(part) if as_tensor else part, at + size
        return _rebuilt(roots, iter(found.values()), len(data))

    def wrap(transition: Callable[..., Any]) -> Callable[..., Any]:
        def step(rows: Any, option: Any) -> Any:
            answer = transition(unpack(rows), option)
            following = dict(_leaves(getattr(answer, "embedding", None)))
            got = {path: _described(leaf) for path, leaf in following.items()}
            like = {path: _described(leaf, len(rows)) for path, leaf in leaves.items()}
            if got != like:
                raise ValueError(
                    f"The transition function must return a Transition whose embedding is built "
                    f"as the roots', {like}; got {got}."
                )
            packed = pack({path: _array(following[path]) for path in leaves})
            return answer._replace(embedding=packed)

        return step

    return pack(arrays), wrap


def _leaves(tree: Any, path: str = "embedding") -> Iterator[tuple[str, Any]]:
    """Yield what a structure is made of, with the path to it."""
    if isinstance(tree, (Mapping, TensorDictBase)):
        for key in tree.keys():
            yield from _leaves(tree[key], f"{path}[{key!r}]")
    elif isinstance(tree, tuple):
        for i, part in enumerate(tree):
            yield from _leaves(part, f"{path}[{i}]")
    else:
        yield path, tree


def _rebuilt(like: Any, leaves: Iterator[Any], number: int) -> Any:
    """Return a structure with other leaves."""
    if isinstance(like, TensorDictBase):
        parts = {key: _rebuilt(like[key], leaves, number) for key in like.keys()}
        return TensorDict(parts, batch_size=[number])
    if isinstance(like, Mapping):
        return {key: _rebuilt(part, leaves, number) for key, part in like.items()}
    if isinstance(like, tuple):
        values = [_rebuilt(part, leaves, number) for part in like]
        return type(like)(*values) if hasattr(like, "_fields") else tuple(values)
    return next(leaves)


def _array(leaf: Any) -> np.ndarray:
    return leaf.detach().cpu().numpy() if isinstance(leaf, Tensor) else leaf


def _described(leaf: Any, number: int | None = None) -> str:
    """Kind, type and shape of an array, as if it had ``number`` rows."""
    if not isinstance(leaf, (np.ndarray, Tensor)):
        return repr(leaf) if leaf is None else f"a {type(leaf).__name__}"
    kind = "tensor" if isinstance(leaf, Tensor) else "array"
    rows = list(leaf.shape) if number is None else [number, *leaf.shape[1:]]
    return f"{kind} {str(leaf.dtype).removeprefix('torch.')} {rows}"
