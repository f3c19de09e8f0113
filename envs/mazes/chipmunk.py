"""Many copies of a disc in many mazes, each in a cell of its own of one Chipmunk space.

Letters: ``M`` mazes, ``H, W`` tiles of a maze, ``n`` discs moved by a call.
"""

from __future__ import annotations

import math
import os
import threading
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["ChipmunkMazes", "WallSegment", "wall_segments"]

Float64Array = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]

_SMALLEST_CAPACITY = 4
_PARKED_CONTACT_FREE = -64.0  # tiles; where unused discs wait, far from every maze
_SLOP = 1e-5  # tiles; how deep a disc in contact stays, so that the contact is found again
_NO_PUSH = 1e9  # tiles; a slop with which no contact pushes
# Added and subtracted, it rounds to 2**-32 tiles per second: contact impulses that Chipmunk caches
# from call to call come to nothing, but for rounding errors of 1e-17.
_ROUNDING = 2.0**20


class WallSegment(NamedTuple):
    """A straight stretch of wall, tiles, and the points its boundary leads to at convex corners.

    ``before`` equals ``start`` (``after`` equals ``end``) where the corner is concave.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    before: tuple[float, float]
    after: tuple[float, float]


def wall_segments(maze: npt.NDArray[np.bool_]) -> list[WallSegment]:
    """Return the faces between free and solid tiles of ``[H, W]``, merged into maximal segments.

    Merged faces have no seams, so a disc that slides along a wall of several tiles meets no corner.
    The outside counts as solid.
    """
    solid = np.pad(np.asarray(maze, dtype=bool), 1, constant_values=True)
    segments: list[WallSegment] = []
    for vertical in (False, True):
        grid = solid.T if vertical else solid
        faces = grid[:-1] ^ grid[1:]  # faces[i, j]: between row i and row i + 1 of the padded grid

        def point(along: float, across: float, vertical: bool = vertical) -> tuple[float, float]:
            return (across, along) if vertical else (along, across)

        for line in range(faces.shape[0]):
            # 2: the solid side is row `line`; 1: it is row `line + 1`; a swap ends a segment.
            side = np.where(faces[line], 1 + grid[line].astype(int), 0)
            start = 0
            for end in range(1, len(side) + 1):
                if end < len(side) and side[end] == side[start]:
                    continue
                if side[start]:
                    solid_row = grid[line] if side[start] == 2 else grid[line + 1]
                    inwards = -1.0 if side[start] == 2 else 1.0
                    a, b, y = float(start - 1), float(end - 1), float(line)
                    segments.append(
                        WallSegment(
                            point(a, y),
                            point(b, y),
                            point(a, y if solid_row[start - 1] else y + inwards),
                            point(b, y if solid_row[end] else y + inwards),
                        )
                    )
                start = end
    return segments


class ChipmunkMazes:
    r"""Discs under thrust in mazes ``[M, H, W]``, as a pure function of position and velocity.

    A call of :meth:`step` sets every disc to the state it is given, advances time by ``time_step``
    and returns the new states: semi-implicit Euler with Chipmunk's ``damping`` d, the share of its
    velocity that a disc keeps after one second without thrust,

    .. math:: x' = x + v\,dt, \qquad v' = v\,d^{dt} + a\,dt,

    followed by Chipmunk's contact impulses with friction and elasticity 0. The depth a disc has
    sunk into a wall is taken back within the same call (a second C step at rest), so that nothing
    Chipmunk keeps between calls changes the next result. Threads take turns, since Chipmunk
    does not hold Python's lock, and a forked process builds a space of its own.

    Reference:
        Pymunk (Chipmunk2D), ``pymunk.batch``.
    """

    def __init__(
        self,
        mazes: npt.NDArray[np.bool_],
        *,
        radius: float,
        damping: float,
        time_step: float,
    ) -> None:
        import pymunk
        from pymunk import batch

        self._pymunk = pymunk
        self._batch = batch
        self._lock, self._process = threading.Lock(), os.getpid()
        self.mazes = np.ascontiguousarray(mazes, dtype=bool)
        self.radius = float(radius)
        self.time_step = float(time_step)
        num_mazes, height, width = self.mazes.shape
        # A power of two keeps position + origin exact for every float32 position.
        cell = float(2 ** math.ceil(math.log2(max(height, width) + 2)))
        columns = max(1, math.ceil(math.sqrt(num_mazes)))
        index = np.arange(num_mazes)
        grid = np.stack([index % columns, index // columns], -1)
        self._origins: Float64Array = grid.astype(np.float64) * cell
        self._built = np.zeros(num_mazes, dtype=bool)

        space = pymunk.Space()
        space.damping = damping
        space.collision_bias = 0.0  # a penetration is undone in one step
        space.collision_persistence = 1
        space.iterations = 2  # contacts of a disc in a grid are orthogonal: one pass solves them
        self._space = space
        self._no_mutual_contact = pymunk.ShapeFilter(group=1)
        self._discs: list[tuple[Any, Any]] = []
        self._capacity = 0
        self._set_in = batch.Buffer()
        self._set_rest = batch.Buffer()
        self._read = batch.Buffer()
        fields = batch.BodyFields
        self._in_fields = fields.POSITION | fields.VELOCITY | fields.FORCE
        self._out_fields = fields.POSITION | fields.VELOCITY

    def __getstate__(self) -> dict[str, Any]:
        return {
            "mazes": self.mazes,
            "radius": self.radius,
            "damping": self._space.damping,
            "time_step": self.time_step,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        mazes = state.pop("mazes")
        self.__init__(mazes, **state)  # type: ignore[misc]

    def _build_mazes(self, maze_index: npt.NDArray[np.int64]) -> None:
        pymunk, space = self._pymunk, self._space
        for index in np.unique(maze_index[~self._built[maze_index]]):
            x, y = self._origins[index]
            for segment in wall_segments(self.mazes[index]):
                start, end, before, after = ((x + u, y + v) for u, v in segment)
                wall = pymunk.Segment(space.static_body, start, end, 0.0)
                # Near a convex corner a disc touches its own face, not the one around the corner.
                wall.set_neighbors(before, after)
                wall.friction = 0.0
                wall.elasticity = 0.0
                space.add(wall)
            self._built[index] = True

    def _resize(self, n: int) -> None:
        """Hold as many discs as a call needs: too few is wrong, too many costs time."""
        pymunk, space = self._pymunk, self._space
        capacity = max(_SMALLEST_CAPACITY, 1 << (n - 1).bit_length())
        while len(self._discs) < capacity:
            body = pymunk.Body(1.0, math.inf)
            circle = pymunk.Circle(body, self.radius)
            circle.friction = 0.0
            circle.elasticity = 0.0
            circle.filter = self._no_mutual_contact
            self._discs.append((body, circle))
        # Chipmunk keeps bodies in the order they were added: add and remove at the end only.
        for disc in self._discs[self._capacity : capacity]:
            space.add(*disc)
        for disc in reversed(self._discs[capacity : self._capacity]):
            space.remove(*disc)
        self._capacity = capacity
        # pymunk.batch walks the moving bodies first and the body that holds the walls last: its row
        # stays zero. Without that row Chipmunk would read past the end of the buffer.
        self._input: Float64Array = np.zeros((capacity + 1, 6))
        self._input[:capacity, 0] = _PARKED_CONTACT_FREE - 2.0 * np.arange(capacity)
        self._input[:capacity, 1] = _PARKED_CONTACT_FREE
        self._parked = self._input.copy()
        self._rest: Float64Array = np.zeros((capacity + 1, 2))
        self._set_in.set_float_buf(self._input)
        self._set_rest.set_float_buf(self._rest)
        self._used = 0

    def step(
        self,
        maze_index: npt.NDArray[np.int64],
        position: Float32Array,
        velocity: Float32Array,
        acceleration: Float32Array,
    ) -> tuple[Float32Array, Float32Array]:
        """Advance ``n`` independent discs by one time step.

        Mazes are int64 ``[n]``; positions (tiles within the maze), velocities and accelerations
        float32 ``[n, 2]``, as are the new positions and velocities that are returned.
        """
        if self._process != os.getpid():  # the space may have been in the middle of a step
            self.__setstate__(self.__getstate__())
        if not len(maze_index):
            return position.copy(), velocity.copy()
        with self._lock:
            return self._step(maze_index, position, velocity, acceleration)

    def _step(
        self, maze_index: Any, position: Any, velocity: Any, acceleration: Any
    ) -> tuple[Float32Array, Float32Array]:
        n = len(maze_index)
        if n > self._capacity or n * 4 < self._capacity:
            self._resize(n)
        if not self._built[maze_index].all():
            self._build_mazes(maze_index)
        origin = self._origins[maze_index]
        state = self._input
        if self._used > n:
            state[n : self._used] = self._parked[n : self._used]
        self._used = n
        active = state[:n]
        np.add(position, origin, out=active[:, 0:2])
        active[:, 2:4] = velocity
        active[:, 4:6] = acceleration

        batch, space, dt = self._batch, self._space, self.time_step
        batch.set_space_bodies(space, self._in_fields, self._set_in)
        space.collision_slop = _SLOP
        space.step(dt)
        read = self._read
        read.clear()
        batch.get_space_bodies(space, batch.BodyFields.VELOCITY, read)
        velocity_out = np.frombuffer(read.float_buf(), dtype=np.float64, count=2 * n)
        new_velocity = (velocity_out.reshape(n, 2) + _ROUNDING - _ROUNDING).astype(np.float32)
        # At rest, the second step only applies the push out of the walls that the first one found.
        # It must not find another one itself: the disc's next state would inherit it.
        batch.set_space_bodies(space, batch.BodyFields.VELOCITY, self._set_rest)
        space.collision_slop = _NO_PUSH
        space.step(dt)
        read.clear()
        batch.get_space_bodies(space, batch.BodyFields.POSITION, read)
        position_out = np.frombuffer(read.float_buf(), dtype=np.float64, count=2 * n)
        new_position = (position_out.reshape(n, 2) - origin).astype(np.float32)
        return new_position, new_velocity
