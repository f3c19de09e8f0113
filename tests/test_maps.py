"""Pictures of skills, searches and episodes over the map of their environment, or without one."""

from __future__ import annotations

from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from torchrl_hmcts.envs import LabMazeEnv, WaterworldMazeEnv, maze_from_text
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.planners.drawing import OPTION_COLORS
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_option_env
from torchrl_hmcts.trainers.figures.maps import (
    FeatureMap,
    LabMap,
    WaterworldMap,
    plot_search,
    plot_skill_fan,
    write_episode_gif,
)

PUSH = TensorDictModule(lambda skill: skill, ["skill"], ["action"])  # skill z: thrust z


def has_color(picture: np.ndarray, color: Any) -> bool:
    return bool((np.abs(picture[..., :3].astype(int) - np.array(color)) < 24).all(-1).sum() > 40)


@pytest.fixture(scope="module")
def solved() -> Any:
    """A corridor that option 3 (to the right) leads along, its search and its plan."""
    maze, _, _ = maze_from_text(".....\n#####")
    env = make_option_env(PUSH, maze[None], option_steps=15)
    start = env.base_env.make_state(0, (0.5, 0.5), (4.5, 0.5))
    novelty = RadiusNovelty("position", 0.5)
    planner = MCTSPlanner(env, novelty=novelty, budget=SearchBudget(expansions=60))
    plan = planner.plan(start)
    states = [start.clone().set("position", torch.tensor([x, 0.5])) for x in (0.5, 1.0, 2.0, 4.5)]
    return env.base_env, planner.last_search, plan, states


@pytest.mark.parametrize("kind", ["maze", "features"])
def test_an_episode_and_its_search_are_drawn_with_a_map_and_without(
    kind: str, solved: Any, tmp_path
) -> None:
    env, search, plan, states = solved
    drawing = WaterworldMap(env) if kind == "maze" else FeatureMap(env, "position")
    write_episode_gif(drawing, states, [3, 3, 3], plan, tmp_path / "a.gif")
    frames = iio.imread(tmp_path / "a.gif")
    assert len(frames) == 3  # every second state, and the last
    assert has_color(frames[-1], OPTION_COLORS[3])
    plot_search(drawing, search, tmp_path / "a.png")
    assert has_color(iio.imread(tmp_path / "a.png"), OPTION_COLORS[3])


def test_a_fan_of_skills_begins_in_the_middle_of_an_open_room_and_of_a_maze(tmp_path) -> None:
    env = WaterworldMazeEnv(observation=False)
    rooms = WaterworldMap(env).rooms(8)
    (_, (room, starts)), (_, (maze, _)) = rooms.items()
    assert not room.env.mazes.any()
    assert torch.equal(maze.env.mazes[0], env.mazes[0])
    assert starts["position"].tolist() == [[env.width / 2, env.height / 2]] * 8
    plot_skill_fan(PUSH, rooms, tmp_path / "a.png", num_skills=4, steps=30)
    picture = iio.imread(tmp_path / "a.png")
    assert all(has_color(picture, OPTION_COLORS[skill]) for skill in range(4))
    again = FeatureMap(env, "position").rooms(8)
    plot_skill_fan(PUSH, again, tmp_path / "b.png", num_skills=4, steps=3)
    assert iio.imread(tmp_path / "b.png").std() > 10


def test_rooms_of_the_lab_have_headings_of_their_own_and_cells_as_units() -> None:
    env = LabMazeEnv(maze_seeds=[1])
    (room, starts), _ = LabMap(env).rooms(6).values()
    middle = torch.tensor([env.layout.columns, env.layout.rows]) / 2
    assert torch.allclose(room.points(starts), middle, atol=0.51)
    assert len(set(room.env.read_state(starts)["heading"][:, 0].tolist())) == 6
    picture = room.picture(starts[0], [(room.points(starts[:2]).numpy(), np.zeros((1, 3)))])
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
