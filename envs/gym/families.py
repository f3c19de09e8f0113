"""The kinds of snapshots, and which of them stores an env."""

from __future__ import annotations

from typing import Any

import gymnasium

from torchrl_hmcts.envs.gym.atari import ALESnapshot
from torchrl_hmcts.envs.gym.attributes import AttributeSnapshot
from torchrl_hmcts.envs.gym.classic import ClassicSnapshot
from torchrl_hmcts.envs.gym.minigrid import MiniGridSnapshot
from torchrl_hmcts.envs.gym.mujoco import MujocoSnapshot
from torchrl_hmcts.envs.gym.snapshots import (
    DEFAULT_CAP,
    FunctionSnapshot,
    ReplaySnapshot,
    Snapshot,
)


class ToyTextSnapshot(AttributeSnapshot):
    """Stores the attributes but the tables of transitions and starts, up to 80 kB."""

    skipped_attributes = AttributeSnapshot.skipped_attributes | {
        "P", "desc", "initial_state_distrib", "locs", "locs_colors",
    }  # fmt: skip

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return type(env.unwrapped).__module__.startswith("gymnasium.envs.toy_text")


class Box2DSnapshot(ReplaySnapshot):
    """Replays the episode, each in a new world.

    No other way is exact: the impulses of contacts, from which the next step begins, cannot be set.
    A world that has seen an episode keeps an order of its bodies, so that the next one differs.
    """

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return bool(_worlds(env))

    def note_reset(self, seed: int | None) -> None:
        super().note_reset(seed)
        inner: Any = self.env.unwrapped
        for name, world in _worlds(inner):
            inner._destroy()  # while its bodies have their world
            setattr(inner, name, type(world)(gravity=world.gravity))


def _worlds(env: gymnasium.Env) -> list[tuple[str, Any]]:
    own = vars(env.unwrapped).items()
    return [(name, value) for name, value in own if type(value).__name__ == "b2World"]


KINDS: tuple[Any, ...] = (
    ClassicSnapshot,
    MujocoSnapshot,
    MiniGridSnapshot,
    ALESnapshot,
    Box2DSnapshot,
    ToyTextSnapshot,
    AttributeSnapshot,
)
"""Special kinds first: the first that fits is taken."""


def snapshot_of(env: gymnasium.Env, snapshot: Any = None, *, cap: int = DEFAULT_CAP) -> Snapshot:
    """Return the snapshot that stores an env's state.

    Args:
        env (gymnasium.Env): the env with its wrappers; it is reset.
        snapshot (type, tuple of two functions, or callable, optional): a :class:`Snapshot` class,
            ``(read, restore)`` as in :class:`FunctionSnapshot`, or a function of the env. Default:
            the first kind that fits.
        cap (int): bytes of the attributes in a row at most. Default 65,536.

    Raises:
        SnapshotError: if the state cannot be stored.
        TypeError: if ``snapshot`` is something else.
    """
    if snapshot is None:
        kind = next(kind for kind in KINDS if kind.fits(env))
        room = {"cap": cap} if issubclass(kind, AttributeSnapshot) else {}
        return kind(env, **room)
    if isinstance(snapshot, tuple) and len(snapshot) == 2 and all(map(callable, snapshot)):
        return FunctionSnapshot(env, *snapshot)
    made = snapshot(env) if callable(snapshot) else snapshot
    if not isinstance(made, Snapshot):
        raise TypeError(
            f"snapshot= takes a Snapshot class, or two functions (read, restore); got {snapshot!r}."
        )
    return made
