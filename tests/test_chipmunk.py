"""Chipmunk's part of Waterworld: wall segments by hand, discs that know nothing of each other."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from torchrl_hmcts.envs import maze_from_text, maze_pool
from torchrl_hmcts.envs.mazes.chipmunk import ChipmunkMazes, WallSegment, wall_segments

RADIUS, DAMPING, TIME_STEP = 0.25, 0.2, 0.05
MAZES = maze_pool("test")[:40].numpy()


def segments_of(text):
    return wall_segments(maze_from_text(text)[0].numpy())


def make_mazes(mazes=MAZES):
    return ChipmunkMazes(mazes, radius=RADIUS, damping=DAMPING, time_step=TIME_STEP)


def random_states(n, seed=0, mazes=MAZES):
    """Discs that touch no wall or overlap it a little: maze_index, position, velocity, thrust."""
    rng = np.random.default_rng(seed)
    maze_index = rng.integers(len(mazes), size=n)
    free = [np.argwhere(~mazes[m]) for m in maze_index]
    tile = np.stack([tiles[rng.integers(len(tiles))] for tiles in free])[:, ::-1]
    position = (tile + rng.uniform(0.2, 0.8, (n, 2))).astype(np.float32)
    velocity = rng.uniform(-3, 3, (n, 2)).astype(np.float32)
    thrust = rng.choice([-4.0, 0.0, 4.0], (n, 2)).astype(np.float32)
    return maze_index, position, velocity, thrust


def assert_same(left, right):
    assert all(np.array_equal(a, b) for a, b in zip(left, right, strict=True))


class TestWallSegments:
    def test_a_room_has_four_walls_whose_corners_are_concave(self):
        segments = segments_of("...\n...")
        assert {frozenset((s.start, s.end)) for s in segments} == {
            frozenset(((0.0, 0.0), (3.0, 0.0))),
            frozenset(((0.0, 2.0), (3.0, 2.0))),
            frozenset(((0.0, 0.0), (0.0, 2.0))),
            frozenset(((3.0, 0.0), (3.0, 2.0))),
        }
        assert all(s.before == s.start and s.after == s.end for s in segments)

    def test_a_pillar_has_four_faces_whose_corners_are_convex(self):
        pillar = {s for s in segments_of("...\n.#.\n...") if {0.0, 3.0}.isdisjoint(s.start + s.end)}
        assert pillar == {
            WallSegment((1.0, 1.0), (2.0, 1.0), before=(1.0, 2.0), after=(2.0, 2.0)),  # top
            WallSegment((1.0, 2.0), (2.0, 2.0), before=(1.0, 1.0), after=(2.0, 1.0)),  # bottom
            WallSegment((1.0, 1.0), (1.0, 2.0), before=(2.0, 1.0), after=(2.0, 2.0)),  # left
            WallSegment((2.0, 1.0), (2.0, 2.0), before=(1.0, 1.0), after=(1.0, 2.0)),  # right
        }

    def test_faces_in_a_row_are_one_segment_and_a_step_has_both_kinds_of_corner(self):
        # The floor of row 0 runs from x = 0 to x = 2: concave at the border, convex at its end.
        floor = [s for s in segments_of("...\n##.") if s.start[1] == s.end[1] == 1.0]
        assert floor == [WallSegment((0.0, 1.0), (2.0, 1.0), before=(0.0, 1.0), after=(2.0, 2.0))]

    def test_a_wall_that_changes_sides_is_cut(self):
        line = [s for s in segments_of("#.\n.#") if s.start[1] == s.end[1] == 1.0]
        assert [(s.start, s.end) for s in line] == [
            ((0.0, 1.0), (1.0, 1.0)),
            ((1.0, 1.0), (2.0, 1.0)),
        ]

    @given(arrays(bool, st.tuples(st.integers(1, 6), st.integers(1, 6))))
    def test_segments_are_the_faces_between_free_and_solid_tiles(self, maze):
        solid = np.pad(maze, 1, constant_values=True)
        faces = set()  # (vertical, x, y) of the low end, in tiles
        for row in range(solid.shape[0]):
            for col in range(solid.shape[1]):
                if row and solid[row, col] != solid[row - 1, col]:
                    faces.add((False, col - 1, row - 1))
                if col and solid[row, col] != solid[row, col - 1]:
                    faces.add((True, col - 1, row - 1))
        covered = []
        for (x0, y0), (x1, y1), *_ in wall_segments(maze):
            vertical = x0 == x1
            assert vertical or y0 == y1
            for step in range(int(x1 - x0 + y1 - y0)):
                covered.append(
                    (vertical, int(x0) + step * (not vertical), int(y0) + step * vertical)
                )
        assert len(covered) == len(set(covered))
        assert set(covered) == faces


class TestStep:
    def test_discs_do_not_collide_with_each_other(self):
        mazes = np.zeros((1, 9, 9), dtype=bool)
        position = np.array([[4.5, 4.5], [4.6, 4.5], [4.5, 4.5]], dtype=np.float32)
        velocity = np.array([[2, 0], [-2, 0], [0, 0]], dtype=np.float32)
        zero = np.zeros_like(position)
        x, v = make_mazes(mazes).step(np.zeros(3, dtype=np.int64), position, velocity, zero)
        np.testing.assert_allclose(x, position + velocity * TIME_STEP, atol=1e-6)
        np.testing.assert_allclose(v, velocity * DAMPING**TIME_STEP, atol=1e-6)

    def test_neighbouring_mazes_do_not_touch(self):
        """An empty room next to one full of walls: a disc far out in it flies freely."""
        mazes = np.zeros((5, 9, 9), dtype=bool)
        mazes[[0, 1, 2, 4]] = MAZES[:4]
        physics = make_mazes(mazes)
        physics.step(*random_states(50, mazes=mazes))  # builds the walls of all
        rng = np.random.default_rng(1)
        position = rng.uniform(0.5, 8.5, (100, 2)).astype(np.float32)
        velocity = rng.uniform(-3, 3, (100, 2)).astype(np.float32)
        x, _ = physics.step(np.full(100, 3), position, velocity, 0 * velocity)
        np.testing.assert_allclose(x, position + velocity * TIME_STEP, atol=1e-6)

    def test_no_discs_is_no_error(self):
        states = random_states(3)
        x, v = make_mazes().step(*(array[:0] for array in states))
        assert x.shape == v.shape == (0, 2)


class TestNothingElseMatters:
    def test_growing_and_shrinking_changes_no_result(self):
        physics = make_mazes()
        for n in (1, 300, 2, 300, 5, 1, 64, 65, 3):
            states = random_states(n, seed=n)
            assert_same(physics.step(*states), make_mazes().step(*states))

    @settings(max_examples=30)
    @given(seed=st.integers(0, 10**6), calls=st.lists(st.integers(1, 40), min_size=1, max_size=6))
    def test_a_result_does_not_depend_on_the_calls_before(self, seed, calls):
        physics = make_mazes()
        for call, n in enumerate(calls):
            physics.step(*random_states(n, seed=seed + call))
        states = random_states(10, seed=seed - 1 if seed else 999)
        assert_same(physics.step(*states), make_mazes().step(*states))
