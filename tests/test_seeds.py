"""Seeds and counts as NumPy hands them out mean what Python's whole numbers mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from torchrl_hmcts.envs import GridworldMazeEnv, LabMazeEnv, WaterworldMazeEnv, lab_maze
from torchrl_hmcts.envs.mazes.layouts import generate_mazes

SEEDS = [np.int64(3), np.int32(3), np.uint64(3), np.uint8(3), np.array(3), torch.tensor(3)]


@pytest.mark.parametrize(
    "seeds",
    [np.arange(3), list(np.arange(3)), tuple(np.arange(3, dtype=np.uint8)), torch.arange(3)],
    ids=lambda seeds: type(seeds).__name__,
)
def test_an_array_of_maze_seeds_is_the_range(seeds: Any) -> None:
    env = LabMazeEnv(maze_seeds=seeds)
    assert env.num_mazes == 3
    assert np.array_equal(env.layout.walls, LabMazeEnv(maze_seeds=range(3)).layout.walls)


@pytest.mark.parametrize("seed", SEEDS, ids=lambda seed: type(seed).__name__ + str(seed.dtype))
def test_mazes_are_those_of_pythons_seed(seed: Any) -> None:
    assert lab_maze(seed, np.int64(7), np.int64(9)) == lab_maze(3, 7, 9)
    assert torch.equal(generate_mazes(2, seed=seed), generate_mazes(2, seed=3))


@pytest.mark.parametrize("seed", SEEDS, ids=lambda seed: type(seed).__name__ + str(seed.dtype))
@pytest.mark.parametrize("make", [WaterworldMazeEnv, GridworldMazeEnv, LabMazeEnv])
def test_episodes_are_those_of_pythons_seed(make: Callable[..., Any], seed: Any) -> None:
    keys = {"maze_seeds": range(4)} if make is LabMazeEnv else {}
    first, same = make(seed=seed, **keys), make(seed=3, **keys)
    assert torch.equal(first.reset()["position"], same.reset()["position"])


@pytest.mark.parametrize("seed", [1.5, -1, 2**32, "1"])
def test_a_seed_that_no_maze_has_is_refused(seed: Any) -> None:
    with pytest.raises((TypeError, ValueError)):
        LabMazeEnv(maze_seeds=[seed])
