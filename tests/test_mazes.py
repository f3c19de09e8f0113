"""Mazes: generation, the pool, text form, shortest paths, bad input."""

from __future__ import annotations

import hashlib
import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_hmcts.envs import (
    free_tiles,
    generate_mazes,
    maze_from_text,
    maze_pool,
    maze_to_text,
    shortest_path_lengths,
)
from torchrl_hmcts.envs.mazes.layouts import check_mazes, draw_mazes, wall_centers

# The pool behind every published figure. If this changes, the figures have to be made again.
GOLDEN_SHA256 = "cba98569ef76344ee619bbfc73b69ce3f545cf2dfba06fde46cb7d988c19d63c"


def reachable_by_hand(maze):
    """Free tiles reached from the first one, by repeated search: slow and obviously right."""
    free = {(r, c) for r, c in itertools.product(*map(range, maze.shape)) if not maze[r, c]}
    reached = {min(free)}
    while True:
        grown = reached | {
            (r, c) for r, c in free if {(r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)} & reached
        }
        if grown == reached:
            return reached == free
        reached = grown


class TestGeneration:
    @settings(max_examples=25, deadline=None)
    @given(
        height=st.integers(3, 12),
        width=st.integers(3, 12),
        seed=st.integers(-(2**31), 2**64),
        complexity=st.floats(0.1, 1),
        density=st.floats(0.5, 1),
    )
    def test_any_size_gives_connected_distinct_mazes(
        self, height, width, seed, complexity, density
    ):
        made = generate_mazes(
            1,
            height=height,
            width=width,
            num_walls=None,
            complexity=complexity,
            density=density,
            seed=seed,
        )
        assert made.shape == (1, height, width)
        assert made.dtype == torch.bool
        assert all(reachable_by_hand(maze) for maze in made)

    @settings(max_examples=20, deadline=None)
    @given(seed=st.integers(0, 2**64 - 1), num_walls=st.integers(28, 32))
    def test_mazes_have_the_wall_count_asked_for_and_are_distinct(self, seed, num_walls):
        made = generate_mazes(20, num_walls=num_walls, seed=seed)
        assert (made.flatten(1).sum(-1) == num_walls).all()
        assert len({maze.numpy().tobytes() for maze in made}) == 20
        check_mazes(made)

    def test_about_half_of_the_draws_have_31_walls_and_31_is_the_mode(self):
        counts = draw_mazes(5000, 9, 9, 0.75, 0.75, np.zeros(1, np.uint64)).flatten(1).sum(-1)
        assert counts.mode().values == 31
        assert 2200 < (counts == 31).sum() < 2450

    def test_on_odd_sizes_grown_walls_never_close_a_ring(self):
        drawn = draw_mazes(500, 9, 9, 0.75, 0.75, np.ones(1, np.uint64))
        assert all(reachable_by_hand(maze) for maze in drawn)

    def test_walls_have_filled_points_at_odd_interior_tiles_only(self):
        drawn = draw_mazes(200, 9, 9, 0.75, 0.75, np.ones(1, np.uint64))
        assert not drawn[:, ::2, ::2].any()  # rooms are never filled

    def test_same_seed_same_mazes_other_seed_other_mazes(self):
        first, again, other = (generate_mazes(10, seed=s) for s in (3, 3, 4))
        assert torch.equal(first, again)
        assert not torch.equal(first, other)

    def test_a_longer_list_begins_with_the_shorter_one(self):
        assert torch.equal(generate_mazes(30, seed=5)[:10], generate_mazes(10, seed=5))

    def test_disconnected_mazes_are_kept_only_on_request(self):
        made = generate_mazes(50, height=8, width=8, num_walls=None, connected=False, seed=0)
        assert not all(reachable_by_hand(maze) for maze in made)

    def test_density_zero_gives_the_empty_maze(self):
        assert not generate_mazes(1, num_walls=0, density=0.0).any()

    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"num_mazes": 0}, "num_mazes must be at least 1, got 0"),
            ({"height": 2}, "at least 3 rows and 3 columns.*height=2"),
            ({"num_walls": 80}, "num_walls=80 leaves no room.*0 to 79"),
            ({"num_walls": -1}, "num_walls=-1"),
            ({"density": float("nan")}, "density must be a finite number >= 0, got nan"),
            ({"complexity": -1.0}, "complexity must be.*got -1.0"),
        ],
    )
    def test_bad_arguments_are_refused_with_their_value(self, kwargs, message):
        with pytest.raises(ValueError, match=message):
            generate_mazes(**{"num_mazes": 1, **kwargs})

    def test_an_unreachable_wall_count_is_an_error_that_names_reachable_ones(self):
        with pytest.raises(RuntimeError, match=r"only 0 distinct .*with 50 walls.*most often 31"):
            generate_mazes(1, num_walls=50)


class TestPool:
    def test_pool_is_the_golden_one_and_is_what_the_algorithm_grows(self):
        bits = np.packbits(maze_pool().numpy()).tobytes()
        assert hashlib.sha256(bits).hexdigest() == GOLDEN_SHA256
        assert torch.equal(maze_pool(), generate_mazes(2342))

    def test_splits_are_disjoint_and_cover_the_pool(self):
        train, test = maze_pool("train"), maze_pool("test")
        assert train.shape == (2000, 9, 9)
        assert test.shape == (342, 9, 9)
        assert torch.equal(torch.cat((train, test)), maze_pool("all"))
        assert len({maze.numpy().tobytes() for maze in maze_pool()}) == 2342
        assert (maze_pool().flatten(1).sum(-1) == 31).all()
        check_mazes(maze_pool())

    def test_changing_a_returned_pool_changes_no_other(self):
        maze_pool().fill_(True)
        assert not maze_pool().all()

    def test_unknown_split_is_refused(self):
        with pytest.raises(ValueError, match="split must be .* got 'valid'"):
            maze_pool("valid")


class TestText:
    TEXT = "P.#\n.#.\n..T"

    def test_text_is_read_tile_by_tile(self):
        maze, player, target = maze_from_text(self.TEXT)
        assert maze.int().tolist() == [[0, 0, 1], [0, 1, 0], [0, 0, 0]]
        assert (player, target) == ((0, 0), (2, 2))

    def test_maze_to_text_is_the_inverse(self):
        assert maze_to_text(*maze_from_text(self.TEXT)) == self.TEXT
        for maze in maze_pool("test")[:20]:
            assert torch.equal(maze_from_text(maze_to_text(maze))[0], maze)

    def test_spaces_are_free_and_players_optional(self):
        maze, player, target = maze_from_text("\n # \n   \n")
        assert maze.int().tolist() == [[0, 1, 0], [0, 0, 0]]
        assert player is None
        assert target is None

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("..\n...", r"one length.*\[2, 3\]"),
            ("", "one length"),
            ("..\n.x", "Unknown character 'x' at row 1, column 1"),
            ("P.\n.P", r"at most one 'P', found at \(0, 0\) and \(1, 1\)"),
        ],
    )
    def test_bad_text_is_refused(self, text, message):
        with pytest.raises(ValueError, match=message):
            maze_from_text(text)


class TestTiles:
    def test_wall_centers_are_x_y_in_row_major_order(self):
        maze, _, _ = maze_from_text(".#.\n#..")
        assert wall_centers(maze).tolist() == [[1.5, 0.5], [0.5, 1.5]]
        assert wall_centers(maze[None, None]).shape == (1, 1, 2, 2)
        assert wall_centers(maze).dtype == torch.float32

    def test_free_tiles_and_walls_share_the_grid(self):
        pool = maze_pool("test")
        tiles = free_tiles(pool)
        assert tiles.shape == (342, 50)
        assert not pool.flatten(1).gather(1, tiles).any()
        assert free_tiles(maze_from_text(".#.\n#..")[0]).tolist() == [0, 2, 4, 5]


class TestShortestPaths:
    def test_lengths_by_hand(self):
        maze, _, target = maze_from_text(".#T\n.#.\n...")
        assert shortest_path_lengths(maze, target).tolist() == [[6, -1, 0], [5, -1, 1], [4, 3, 2]]

    @settings(max_examples=30, deadline=None)
    @given(
        cells=st.lists(st.booleans(), min_size=20, max_size=20),
        target=st.integers(0, 19),
    )
    def test_lengths_equal_repeated_relaxation(self, cells, target):
        maze = torch.tensor(cells).view(4, 5)
        maze.view(-1)[target] = False
        row, col = divmod(target, 5)
        best = {(row, col): 0}
        for _ in range(20):  # Bellman-Ford: no path is longer than the number of tiles
            for r, c in itertools.product(range(4), range(5)):
                around = [(r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)]
                steps = [best[n] + 1 for n in around if n in best]
                if steps and not maze[r, c]:
                    best[r, c] = min([*steps, best.get((r, c), 99)])
        lengths = shortest_path_lengths(maze, (row, col))
        for r, c in itertools.product(range(4), range(5)):
            assert lengths[r, c] == best.get((r, c), -1)

    def test_tiles_that_no_path_joins_have_minus_one(self):
        maze, _, target = maze_from_text("P#T")
        assert shortest_path_lengths(maze, target).tolist() == [[-1, -1, 0]]

    @pytest.mark.parametrize("tile", [(0, 1), (0, 3), (-1, 0)])
    def test_an_end_in_a_wall_or_outside_is_refused(self, tile):
        maze, _, _ = maze_from_text(".#T")
        with pytest.raises(ValueError, match="target tile .* is a wall or outside the 1x3 maze"):
            shortest_path_lengths(maze, tile)


class TestCheckMazes:
    @pytest.mark.parametrize(
        ("bad", "message"),
        [
            (torch.zeros(1, 3, 3), r"got torch.float32 \[1, 3, 3\]"),
            (torch.zeros(3, 3, dtype=torch.bool), r"torch.bool \[3, 3\].*maze\[None\]"),
            (torch.zeros(0, 3, 3, dtype=torch.bool), r"\[0, 3, 3\]"),
            (np.zeros((1, 3, 3), bool), "a ndarray"),
            (torch.tensor([[[0, 1, 0]], [[0, 0, 0]]]).bool(), "maze 0 has 1, maze 1 has 0"),
            (torch.tensor([[[1, 0, 1]]]).bool(), "at least 2 free tiles.*got 1"),
            (torch.tensor([[[0, 0, 1]], [[0, 1, 0]]]).bool(), r"maze 1 are not connected"),
        ],
    )
    def test_unusable_mazes_are_refused(self, bad, message):
        with pytest.raises(ValueError, match=message):
            check_mazes(bad)
