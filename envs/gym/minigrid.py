"""Snapshots of MiniGrid's envs: a reference once an episode, and what has changed since."""

from __future__ import annotations

import io
import pickle
from typing import Any

import gymnasium
import numpy as np

from torchrl_hmcts.envs.gym.attributes import AttributeSnapshot, RowUnpickler
from torchrl_hmcts.envs.gym.snapshots import SnapshotError

_UNMOVED = frozenset({"wall", "floor", "goal", "lava"})
_CHANGES = 1_024  # bytes for cells and objects that differ from the reference


class MiniGridSnapshot(AttributeSnapshot):
    """Stores the grid at the start of the episode, and what differs from it now.

    A copy of the whole grid takes milliseconds. Between two states of an episode only a few cells
    and objects differ, and restoring changes only these. The reference is part of the row, so that
    a row fits other instances too.

    Args:
        env (gymnasium.Env): a MiniGrid or BabyAI env with its wrappers.
        cap (int): bytes of the reference at most. Default 65,536.

    Raises:
        SnapshotError: if an attribute cannot be stored.
    """

    def __init__(self, env: gymnasium.Env, *, cap: int = 1 << 16) -> None:
        self._reference = b""
        self._cells: list[Any] = []
        self._movable: list[Any] = []
        super().__init__(env, cap=cap)
        self._own_fixed = len(self._fixed)
        self._room = self.width
        self._refer(self._pickled())
        self.width = self._room + 64 * (len(self._pickled()) // 32 + 2) + _CHANGES

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return any(kind.__name__ == "MiniGridEnv" for kind in type(env.unwrapped).__mro__)

    def note_reset(self, seed: int | None) -> None:
        super().note_reset(seed)
        self._forget()

    def read(self) -> np.ndarray:
        if not self._reference:
            self._refer(self._pickled())
        grid = self.env.unwrapped.grid.grid  # type: ignore[attr-defined]
        changed = [
            (i, self._number(now))
            for i, (now, before) in enumerate(zip(grid, self._cells, strict=True))
            if now is not before
        ]
        objects = [_object_state(item, self._number) for item in self._movable]
        changes = pickle.dumps((changed, objects), protocol=5)
        content = self._pickled()
        row = np.zeros(self.width, np.uint8)
        sizes = len(self._reference), len(changes), len(content)
        clocks = [clock["_elapsed_steps"] or 0 for clock in self._clocks]
        begin = 8 * (3 + len(clocks))
        whole = self._reference + changes + content
        if begin + len(whole) > len(row):
            raise SnapshotError(
                f"The state of {self.env} has grown to {begin + len(whole):,} bytes, and a row has "
                f"{len(row):,}. Pass cap={2 * (begin + len(whole)):,} or more."
            )
        row[:begin].view(np.int64)[:] = *sizes, *clocks
        row[begin : begin + len(whole)] = np.frombuffer(whole, np.uint8)
        return row

    def restore(self, row: np.ndarray) -> None:
        begin = 8 * (3 + len(self._clocks))
        first, second, third, *clocks = row[:begin].view(np.int64).tolist()
        whole = row[begin : begin + first + second + third].tobytes()
        reference = whole[:first]
        if reference != self._reference:
            self._forget()
            self._load_attributes(reference)
            self._refer(reference)
        for clock, steps in zip(self._clocks, clocks, strict=True):
            clock["_elapsed_steps"] = steps
        self._load_attributes(whole[first + second :])
        changes = io.BytesIO(whole[first : first + second])
        changed, objects = RowUnpickler(changes, self._fixed, self._packages).load()
        grid = self.env.unwrapped.grid.grid  # type: ignore[attr-defined]
        grid[:] = self._cells
        for i, number in changed:
            grid[i] = None if number is None else self._fixed[number]
        for item, state in zip(self._movable, objects, strict=True):
            inside = state.get("contains")
            item.__dict__.update(state)
            item.contains = None if inside is None else self._fixed[inside]

    def _forget(self) -> None:
        """Drops the reference of the last episode."""
        self._reference, self._cells, self._movable = b"", [], []
        for item in self._fixed[self._own_fixed :]:
            self._index.pop(id(item), None)
        del self._fixed[self._own_fixed :]

    def _refer(self, reference: bytes) -> None:
        """Takes the state of now as the reference: its objects get numbers, in a fixed order."""
        self._reference = reference
        own = vars(self.env.unwrapped)
        self._cells = list(own["grid"].grid)
        things: list[Any] = [own["grid"]]
        things += [room for row in own.get("room_grid", ()) for room in row]
        waiting = [*self._cells, own.get("carrying")]
        for item in waiting:
            if item is not None and id(item) not in self._index:
                self._index[id(item)] = -1
                things.append(item)
                waiting.append(item.contains)
                if item.type not in _UNMOVED:
                    self._movable.append(item)
        for item in things:
            self._index[id(item)] = len(self._fixed)
            self._fixed.append(item)

    def _number(self, item: Any) -> int | None:
        if item is None:
            return None
        number = self._index.get(id(item))
        if number is None:
            raise SnapshotError(
                f"{self.env} has made a new {item.type} during the episode. Pass "
                "snapshot=AttributeSnapshot, which copies the whole grid."
            )
        return number


def _object_state(item: Any, number: Any) -> dict[str, Any]:
    """The attributes of an object that moves; what it contains as a number."""
    return {**item.__dict__, "contains": number(item.contains)}
