"""Snapshots of MiniGrid's envs: a reference once an episode, and what has changed since."""

from __future__ import annotations

import io
import pickle
from operator import is_
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from torchrl_hmcts.envs.gym.attributes import AttributeSnapshot, RowUnpickler
from torchrl_hmcts.envs.gym.snapshots import SnapshotError

_UNMOVED = frozenset({"wall", "floor", "goal", "lava"})
_CHANGES = 1_024  # bytes for cells and objects that differ from the reference
_AGENT = ("agent_pos", "agent_dir", "step_count")
_NUMBERS = (int, np.int64)  # kinds of the agent's coordinates and direction


class _Changes(NamedTuple):
    """Changes at the last look."""

    cells: list[Any]
    values: list[Any]
    content: bytes  # that stands for them

    def still(self, cells: list[Any], values: list[Any]) -> bool:
        """Whether nothing has changed since."""
        return (
            bool(self.content)
            and len(values) == len(self.values)
            and all(map(is_, cells, self.cells))
            and all(
                one is other or (type(one) is type(other) is bytes and one == other)
                for one, other in zip(values, self.values, strict=True)
            )
        )


class MiniGridSnapshot(AttributeSnapshot):
    """Stores the grid at the start of the episode, and what differs from it now.

    A copy of the whole grid takes milliseconds. Between two states of an episode only the agent, a
    few cells and objects differ, and restoring changes only these. The reference is part of the
    row, so that a row fits other instances too.
    """

    skipped_attributes = AttributeSnapshot.skipped_attributes | {*_AGENT}
    head = 8

    def __init__(self, env: gymnasium.Env, *, cap: int = 1 << 16) -> None:
        self._reference = b""
        self._cells: list[Any] = []
        self._movable: list[Any] = []
        self._changes = _Changes([], [], b"")
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
        self._unchanged = content = self._pickled()
        row = np.zeros(self.width, np.uint8)
        changes = self._changed()
        sizes = len(self._reference), len(changes), len(content)
        clocks = [clock._elapsed_steps or 0 for clock in self._clocks]
        begin = self._head.size
        whole = self._reference + changes + content
        if begin + len(whole) > len(row):
            raise SnapshotError(
                f"The state of {self.env} has grown to {begin + len(whole):,} bytes, and a row has "
                f"{len(row):,}. Pass cap={2 * (begin + len(whole)):,} or more."
            )
        self._head.pack_into(row.data, 0, *sizes, *self._agent(), *clocks)
        row.data[begin : begin + len(whole)] = whole
        return row

    def restore(self, row: np.ndarray) -> None:
        begin = self._head.size
        first, second, third, *agent = self._head.unpack_from(row.data)
        whole = row[begin : begin + first + second + third].tobytes()
        reference, changes, content = (
            whole[:first],
            whole[first : first + second],
            whole[first + second :],
        )
        if reference != self._reference:
            self._forget()
            self._load_attributes(reference)
            self._unchanged = None
            self._refer(reference)
        for clock, steps in zip(self._clocks, agent[5:], strict=True):
            clock._elapsed_steps = steps
        self._load_content(content)
        if changes != self._changes.content or not self._changes.still(*self._things()):
            self._set_changed(changes)
        self._set_agent(*agent[:5])

    def _agent(self) -> tuple[int, ...]:
        """Where the agent is and looks, the steps it has taken, and the types of these numbers."""
        own: Any = vars(self.env.unwrapped)
        place, direction, steps = map(own.get, _AGENT)
        numbers = *place, direction
        try:
            kinds = [_NUMBERS.index(type(number)) for number in numbers]
            kinds.append((tuple, np.ndarray).index(type(place)))
        except ValueError:
            raise SnapshotError(
                f"The agent of {self.env} is at {place!r} and looks to {direction!r}, which are "
                "not whole numbers. Pass snapshot=AttributeSnapshot."
            ) from None
        code = kinds[0] | kinds[1] << 1 | kinds[2] << 2 | kinds[3] << 3
        return code, *numbers, steps

    def _set_agent(self, code: int, x: int, y: int, direction: int, steps: int) -> None:
        place = _NUMBERS[code & 1](x), _NUMBERS[code >> 1 & 1](y)
        vars(self.env.unwrapped).update(
            agent_pos=np.array(place) if code >> 3 else place,
            agent_dir=_NUMBERS[code >> 2 & 1](direction),
            step_count=steps,
        )

    def _things(self) -> tuple[list[Any], list[Any]]:
        """The cells, and all that is known of objects that move."""
        own = [value for item in self._movable for value in vars(item).values()]
        own = [value.tobytes() if type(value) is np.ndarray else value for value in own]
        return self.env.unwrapped.grid.grid, own  # type: ignore[attr-defined]

    def _changed(self) -> bytes:
        """What differs from the reference: cells, and the attributes of objects that move."""
        grid, own = self._things()
        if self._changes.still(grid, own):
            return self._changes.content
        changed = [
            (i, self._number(now))
            for i, (now, before) in enumerate(zip(grid, self._cells, strict=True))
            if now is not before
        ]
        objects = [  # what one contains as a number
            {**item.__dict__, "contains": self._number(item.contains)} for item in self._movable
        ]
        content = pickle.dumps((changed, objects), protocol=5)
        self._changes = _Changes(list(grid), own, content)
        return content

    def _set_changed(self, changes: bytes) -> None:
        changed, objects = RowUnpickler(io.BytesIO(changes), self._fixed, self._packages).load()
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
        self._changes, self._seen = _Changes([], [], b""), None
        self._known = None, b""
        self._recent.clear()
        for item in self._fixed[self._own_fixed :]:
            self._index.pop(id(item), None)
        del self._fixed[self._own_fixed :]

    def _refer(self, reference: bytes) -> None:
        """Takes the state of now as the reference: its objects get numbers, in a fixed order."""
        self._reference = reference
        own = vars(self.env.unwrapped)
        own["grid"] = _quick(own["grid"])
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
        self._seen = None  # which knew them by what they hold

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


def _quick(item: Any) -> Any:
    """A copy for whose attributes vars() was never asked, which makes each look-up slower."""
    copied = object.__new__(type(item))
    for name, value in vars(item).items():
        setattr(copied, name, value)
    return copied
