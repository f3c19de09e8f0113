"""LabMazeEnv beside recordings of DeepMind Lab's engine, and the mazes and numbers behind them."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchrl_hmcts.envs import LabMazeEnv, lab_maze, shortest_path_lengths
from torchrl_hmcts.envs.lab.mazes import MersenneTwister64
from torchrl_hmcts.envs.lab.states import heading_degrees

DATA = Path(__file__).parent / "data" / "lab_recordings.json.gz"
RECORDINGS = {s["name"]: s for s in json.loads(gzip.decompress(DATA.read_bytes()))["sequences"]}


def replay(recording: dict[str, Any]) -> dict[str, np.ndarray]:
    """Plays a recording's actions; after the goal the player appears elsewhere than there."""
    rows = recording["rows"]
    if not any("P" in row for row in rows):  # the start is given
        rows = "\n".join(rows).replace(" ", "P", 1).split("\n")
    env = LabMazeEnv(
        [rows],
        actions=None,
        terminate_on_goal=False,
        max_frames=10**12,
        fps=recording["fps"],
        clock="exact",
        clock_phase=recording["clock_phase"],
        read_outs=(),
    )
    pos, rot, velocity = (np.array(recording[key][0]) for key in ("pos", "rot", "vel_world"))
    td = env.make_state(0, pos[:2].tolist(), float(rot[1]), velocity=velocity[:2].tolist())
    td["turned"][1] = rot[0]
    found: dict[str, list[Any]] = {"pos": [], "rot": [], "vel_world": [], "reward": []}
    for action in [*recording["actions"], None]:
        found["pos"].append([*td["position"].tolist(), 25.125])
        found["vel_world"].append([*td["velocity"].tolist(), 0.0])
        yaw = heading_degrees(td["turned"][:1].numpy(), td["level"][:1].numpy())
        pitch = heading_degrees(td["turned"][1:].numpy(), np.zeros(1, np.int64))
        found["rot"].append([float(pitch[0]), float(yaw[0]), 0.0])
        if action is not None:
            td = env._step(td.set("action", torch.tensor(action)))
            found["reward"].append(float(td["reward"]))
    return {key: np.array(values) for key, values in found.items()}


def test_the_recordings_cover_every_kind_of_movement() -> None:
    groups = {recording["group"] for recording in RECORDINGS.values()}
    assert groups == {"open", "wall", "pillar", "fps", "goal", "solver"}
    assert DATA.stat().st_size < 80_000


@pytest.mark.parametrize("name", RECORDINGS)
def test_the_environment_moves_as_the_engine_did(name: str) -> None:
    recording = RECORDINGS[name]
    ours = replay(recording)
    for key in ("pos", "rot", "vel_world", "reward"):
        assert ours[key].shape == np.shape(recording[key])
    assert np.abs(ours["pos"] - recording["pos"])[:, :2].max() < 0.01  # a cell is 100
    assert (ours["vel_world"] == recording["vel_world"]).all()
    turn = (ours["rot"] - recording["rot"] + 180.0) % 360.0 - 180.0
    assert np.abs(turn).max() < 0.006  # a 65,536th of a turn
    assert (ours["reward"] == recording["reward"]).all()


def test_other_actions_do_not_give_the_recorded_movement() -> None:
    recording = dict(RECORDINGS["solver_9x9_seed1"])
    recording["actions"] = [[-a for a in action] for action in recording["actions"]]
    assert np.abs(replay(recording)["pos"] - recording["pos"]).max() > 50.0


def test_two_phases_of_the_clock_drift_a_few_units_apart() -> None:
    recording = RECORDINGS["open_random_0"]
    other = replay({**recording, "clock_phase": [46, -3]})
    assert 0.1 < np.abs(other["pos"] - recording["pos"])[:, :2].max() < 30.0


@pytest.mark.parametrize("name", ["solver_9x9_seed1", "solver_9x9_seed2"])
def test_the_maze_of_a_seed_is_the_engines(name: str) -> None:
    recording = RECORDINGS[name]
    assert list(lab_maze(recording["seed"])) == recording["rows"]


# ---------------------------------------------------------------------- random numbers


def test_the_generator_gives_the_published_numbers() -> None:
    """The C++ standard ([rand.predef]) names the 10,000th output of the default seed."""
    random = MersenneTwister64(5489)
    assert [random.next() for _ in range(10_000)][-1] == 9981545732273789042


class Fixed(MersenneTwister64):
    """Gives the numbers it is told."""

    def __init__(self, *numbers: int) -> None:
        self.numbers = list(numbers)

    def next(self) -> int:
        return self.numbers.pop(0)


def test_integers_are_the_high_half_of_a_product() -> None:
    assert Fixed(0b11 << 62).uniform_int(1, 4) == 4  # 3/4 of the way
    assert Fixed((1 << 62) - 1).uniform_int(1, 4) == 1
    assert Fixed((1 << 63) + 1).uniform_int(0, 99) == 50
    assert Fixed(2**64 - 1).uniform_int(-5, 5) == 5


def test_integers_reject_the_numbers_that_would_make_one_more_likely() -> None:
    # 2**64 = 1 mod 3: only a product whose low half is 0 is drawn again.
    random = Fixed(0, 2**63)
    assert random.uniform_int(0, 2) == 1
    assert not random.numbers
    assert Fixed(0).uniform_int(0, 3) == 0  # 4 divides 2**64: nothing is


def test_reals_are_64_bits_below_one() -> None:
    assert Fixed(1 << 62).uniform_real() == 0.25
    assert Fixed(2**64 - 1).uniform_real() == 1.0 - 2.0**-53


# ---------------------------------------------------------------------- mazes


def letters(maze: tuple[str, ...]) -> np.ndarray:
    return np.array([list(row) for row in maze])


@pytest.mark.parametrize(
    ("size", "seeds", "walls", "spawns", "apples", "path"),
    [(9, 600, 47.3, 20.1, 9.8, 10.2), (15, 150, 117.3, 91.5, 11.4, 16.4)],
)
def test_mazes_have_the_statistics_of_the_level(
    size: int, seeds: int, walls: float, spawns: float, apples: float, path: float
) -> None:
    """The border counts; means over the rule were measured on 2,000 and 600 other seeds."""
    counts, paths = [], []
    for seed in range(seeds):
        maze = letters(lab_maze(seed, size, size))
        counts.append([(maze == letter).sum() for letter in "*PAG"])
        goal = tuple(np.argwhere(maze == "G")[0])
        distance = shortest_path_lengths(torch.from_numpy(maze == "*"), goal).numpy()
        assert ((maze == "P") == (distance > 5)).all()
        assert ((maze == "A") == ((distance > 0) & (distance < 5))).all()
        assert goal[0] % 2 == goal[1] % 2 == 1
        assert (distance[1::2, 1::2] >= 0).all()  # every even cell is reached
        paths.append(distance[maze == "P"].mean())
    if size == 9:
        count = np.array(counts)[:, 0]
        assert 42 <= count.min() <= count.max() == 50
        assert np.mean(count == 50) == pytest.approx(0.045, abs=0.03)
    mean = np.mean(counts, 0)
    for value, expected in zip(mean, (walls, spawns, apples, 1.0), strict=True):
        assert value == pytest.approx(expected, rel=0.06)
    assert np.mean(paths) == pytest.approx(path, rel=0.06)


def test_mazes_differ_from_seed_to_seed_and_by_the_mixer_seed() -> None:
    mazes = [lab_maze(seed, mixer_seed=mixer) for seed in range(20) for mixer in (0, 1)]
    assert len(set(mazes)) == 40


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rows": 8}, "odd numbers of rows and columns; got 8, 9"),
        ({"columns": 3}, "columns >= 5; got 3"),
        ({"seed": -1}, "seed >= 0; got -1"),
        ({"mixer_seed": 2**32}, r"mixer_seed below 2\*\*32; got 1, 4294967296"),
    ],
)
def test_bad_sizes_and_seeds_of_mazes_are_refused(arguments: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lab_maze(**{"seed": 1, **arguments})
