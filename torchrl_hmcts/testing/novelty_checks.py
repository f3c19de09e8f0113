"""Checks of novelty tests.

Letters: m states, F features.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from tensordict import TensorDictBase

from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.testing.contract import during, require, require_alone, require_read

_MANY = 10_000
_MEMBERS = ("in_keys", "start", "restart", "features", "accept", "relax")


def check_novelty(novelty: NoveltyTest, states: TensorDictBase) -> None:
    """Check that a novelty test can decide which nodes are worth searching.

    It has the members of :class:`~torchrl_hmcts.planners.NoveltyTest`; its features are numbers,
    one row per state, and of that state only; in an empty tree the first state is novel, and is so
    no more when it comes again; roots know nothing of each other, and forget when they are
    restarted; a search has a copy of its own; relaxing it comes to an end.

    Args:
        novelty (NoveltyTest): the test; it is started again.
        states (TensorDictBase): states ``[m]`` with its ``in_keys``, at least two that differ.

    Raises:
        ContractError: if it cannot.
        ValueError: if there are not two states.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.planners import RadiusNovelty
        >>> from torchrl_hmcts.testing import check_novelty
        >>> states = TensorDict(position=torch.rand(5, 2), batch_size=[5])
        >>> check_novelty(RadiusNovelty("position", 0.1), states)
    """
    name = type(novelty).__name__
    if len(states.batch_size) != 1 or len(states) < 2:
        raise ValueError(
            f"check_novelty needs states [m], two at least; got batch size "
            f"{list(states.batch_size)}."
        )
    missing = [member for member in _MEMBERS if not hasattr(novelty, member)]
    require(
        not missing,
        f"{name} lacks {missing}. A novelty test has the members of "
        "torchrl_hmcts.planners.NoveltyTest.",
    )
    require_read(name, novelty, states, "a state")
    with during(name, "reading features"):
        novelty.start(1)
        features = novelty.features(states.clone())
    _require_array(f"{name}.features", features, (len(states), -1), "biuf")
    require_alone(
        f"{name}.features",
        lambda rows: novelty.features(rows.clone()),
        states,
        features,
        "state",
        "Let them depend on their own state only.",
    )
    _check_accept(name, novelty, features)
    _check_relax(name, novelty)
    statistics: Any = getattr(novelty, "statistics", dict)()
    good = isinstance(statistics, dict) and all(
        isinstance(count, (int, float)) for count in statistics.values()
    )
    require(good, f"{name}.statistics gives {statistics!r}; it must give a dict of numbers.")


def _require_array(what: str, array: object, shape: tuple[int, ...], kinds: str) -> None:
    """Require a NumPy array of a shape, in which -1 is any number, and of kinds of types."""
    got = type(array).__name__
    good = isinstance(array, np.ndarray)
    if isinstance(array, np.ndarray):
        got = f"{array.dtype} {list(array.shape)}"
        good = array.dtype.kind in kinds and len(array.shape) == len(shape)
        good = good and all(want in (-1, n) for want, n in zip(shape, array.shape, strict=True))
    kind = "bool" if kinds == "b" else "numeric"
    require(good, f"{what} gives {got}; it must give a {kind} array {list(shape)}, -1 for any.")


def _check_accept(name: str, novelty: NoveltyTest, features: np.ndarray) -> None:
    m = len(features)

    def ask(test: NoveltyTest, root: int, at: int = 0) -> np.ndarray:
        with during(name, "asked about new states"):
            accepted = test.accept(np.full(m, root), features, np.arange(m) + at)
        _require_array(f"{name}.accept", accepted, (m,), "b")
        return accepted

    novelty.start(3)
    first = ask(novelty, 0)
    require(first[0], f"{name} refuses the first state of an empty tree. Nothing is known there.")
    twice = np.flatnonzero(ask(novelty, 0, at=m) & first)
    require(
        not len(twice),
        f"{name} accepts state {twice[:1]} a second time. Remember what was accepted, or a search "
        "visits the same states again and again.",
    )
    require(
        np.array_equal(ask(novelty, 1), first),
        f"{name}: what root 0 has seen counts for root 1. Keep what is known per root.",
    )
    with during(name, "restarting a root"):
        novelty.restart(0)
    require(
        np.array_equal(ask(novelty, 0), first),
        f"{name}.restart(0) does not forget the states of root 0.",
    )
    require(
        not ask(novelty, 1, at=m)[first].any(),
        f"{name}.restart(0) forgot the states of root 1 too. Forget those of one root.",
    )
    twin = copy.copy(novelty)
    twin.start(3)
    ask(twin, 2)
    require(
        np.array_equal(ask(novelty, 2), first),
        f"{name}: a copy that was started shares what it knows with the original. Assign new "
        "arrays in start(): each search starts a shallow copy.",
    )


def _check_relax(name: str, novelty: NoveltyTest) -> None:
    for _ in range(_MANY):
        with during(name, "relaxed"):
            relaxed = novelty.relax(0)
        require(
            isinstance(relaxed, (bool, np.bool_)),
            f"{name}.relax gives {relaxed!r}; it must give True, or False if it cannot.",
        )
        if not relaxed:
            return
    require(
        False,
        f"{name}.relax(0) was True {_MANY} times. Give False at last, or an exhausted search never "
        "ends.",
    )
