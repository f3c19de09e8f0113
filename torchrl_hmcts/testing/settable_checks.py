"""Checks that an env restores its states to the bit.

Letters: T steps of an episode.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torchrl.data.utils import CloudpickleWrapper
from torchrl.envs import EnvBase

from torchrl_hmcts.testing.contract import ContractError, seeded

Episode = tuple[list[TensorDictBase], list[int]]
"""Steps, and those among them whose states are to be restored."""


def check_settable(
    make_env: Callable[[], EnvBase],
    *,
    num_states: int = 50,
    num_steps: int = 200,
    seed: int = 0,
    other_process: bool = True,
    unread_keys: Sequence[NestedKey] = ("snapshot",),
) -> None:
    """Check that an env set to a state continues as the unbroken run did, to the bit.

    Random episodes are recorded. From states among them the recorded actions are taken again: in
    the env itself, in a second instance and in a second process. Every entry has to be the same.

    Args:
        make_env (callable): makes the env, e.g. ``lambda: SettableGymEnv("CartPole-v1")``.
        num_states (int): states to restore. Default 50.
        num_steps (int): steps from each, or as many as the episode has left. Default 200.
        seed (int): of the episodes and actions. Default 0.
        other_process (bool): whether a second process is tried, which takes some seconds.
        unread_keys (sequence of NestedKey): entries that no step reads as they are, e.g. the bytes
            of a snapshot, in which equal states may differ. Default ``("snapshot",)``.

    Raises:
        ContractError: if an entry differs, with its name and whether the env is deterministic.

    Examples:
        >>> from torchrl_hmcts.envs import SettableGymEnv
        >>> from torchrl_hmcts.testing import check_settable
        >>> check_settable(
        ...     lambda: SettableGymEnv("CartPole-v1"), num_states=5, other_process=False)
    """
    env = make_env()
    name = repr(env) if len(repr(env)) < 120 else type(env).__name__
    episodes = _record(env, num_states, num_steps, seed)
    skipped = {unravel_key(key) for key in unread_keys}
    tried: dict[str, Callable[[], tuple[NestedKey, int] | None]] = {
        "the same instance": lambda: _replay(env, episodes, num_steps, skipped),
        "a second instance": lambda: _replay(make_env(), episodes, num_steps, skipped),
    }
    if other_process:
        tried["a second process"] = lambda: _elsewhere(make_env, episodes, num_steps, skipped)
    for where, replay in tried.items():
        found = replay()
        if found is None:
            continue
        key, step = found
        repeats = _replay(env, episodes, num_steps, skipped, from_reset=seed) is None
        cause = (
            "A part of the state is not stored. Pass a snapshot that stores it, e.g. "
            "snapshot=(read, restore) or snapshot=ReplaySnapshot of SettableGymEnv."
            if repeats
            else "The env is not deterministic: the same seed and actions give another episode. "
            "Plan in it with chance nodes (chance=ProgressiveWidening()), whose outcomes are "
            "sampled."
        )
        raise ContractError(
            f"{name}: in {where}, {step + 1} steps after a state was restored, {key!r} is not "
            f"what the unbroken run gave. {cause}"
        )


def _record(env: EnvBase, num_states: int, num_steps: int, seed: int) -> list[Episode]:
    """Return random episodes, and the steps at which their states are to be restored."""
    generator = torch.Generator().manual_seed(seed)
    env.set_seed(seed)
    episodes: list[Episode] = []
    left = num_states
    while left > 0:
        with seeded(seed + len(episodes)):
            episode = [step.clone() for step in env.rollout(2 * num_steps).unbind(-1)]
        count = min(left, max(1, len(episode) // 4), 10)
        latest = max(1, len(episode) - min(num_steps, len(episode) // 2))
        starts = torch.randint(latest, (count,), generator=generator).tolist()
        episodes.append((episode, starts))
        left -= count
    return episodes


def _replay(
    env: EnvBase,
    episodes: list[Episode],
    num_steps: int,
    skipped: set[NestedKey],
    from_reset: int | None = None,
) -> tuple[NestedKey, int] | None:
    """Take recorded actions again; return the first entry that differs, and after which step."""
    if from_reset is not None:
        env.set_seed(from_reset)
    for episode, starts in episodes:
        for start in starts if from_reset is None else [0]:
            if from_reset is None:
                td = env.reset(episode[start].exclude("next", "action").clone(), set_state=True)
            else:
                td = env.reset()
            for step, right in enumerate(episode[start : start + num_steps]):
                td = env.step(td.set(env.action_key, right.get(env.action_key))).get("next")
                after = right.get("next")
                for key in after.keys(True, True):
                    if unravel_key(key) not in skipped and not _same(td.get(key), after.get(key)):
                        return key, step
                td = td.exclude(*env.reward_keys)
    return None


def _elsewhere(make_env: Callable[[], EnvBase], *work: Any) -> tuple[NestedKey, int] | None:
    """Take recorded actions again in a second process."""
    context = multiprocessing.get_context("spawn")
    replay = CloudpickleWrapper(lambda: _replay(make_env(), *work))  # no shared memory
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            return pool.submit(replay).result()
        except BrokenProcessPool:
            raise ContractError("The second process died while it restored states.") from None


def _same(one: Any, other: Any) -> bool:
    """Whether two entries are equal to the bit; NaN equals NaN."""
    if not isinstance(one, torch.Tensor):
        return bool(one == other)
    equal = (one == other) | ((one != one) & (other != other))
    return bool(equal.all())
