"""The goal-based agent in Waterworld: plans, the worker's env, the expert, the pictures."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.envs import (
    WaterworldMazeEnv,
    maze_from_text,
    maze_pool,
    shortest_path_lengths,
)
from torchrl_hmcts.envs.mazes.rendering import DOT_COLOR, PLAYER_COLOR, TARGET_COLOR
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_starts
from torchrl_hmcts.trainers.experiments.waterworld.episodes import (
    GoalTrack,
    play_mazes,
)
from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import (
    TilePlanner,
    make_goal_env,
    make_tile_planner,
    tile_moves,
)
from torchrl_hmcts.trainers.experiments.waterworld.scripted_expert import ScriptedExpert
from torchrl_hmcts.trainers.figures.goals import (
    draw_goals,
    plot_goals,
    plot_macro_env,
    plot_tile_search,
    write_goal_gif,
)
from torchrl_hmcts.trainers.saving.run_state import GeneratorStates, RunningEpisodes

MAZE, PLAYER, TARGET = maze_from_text("P.#\n#..\n..T")
PLANNERS = pytest.mark.parametrize("make", [TilePlanner, make_tile_planner])


def tile(point: torch.Tensor) -> tuple[int, int]:
    """(row, col) of the tile that holds (x, y)."""
    return int(point[1]), int(point[0])


# ------------------------------------------------------------------------------------------ plans


@PLANNERS
def test_plans_are_shortest_paths_on_free_tiles(make: Any) -> None:
    env = WaterworldMazeEnv(observation=False, batch_size=[300], seed=3)
    td = env.reset()
    goals, lengths = make(env).plan_goals(td)
    assert lengths.max() > 25  # some are long
    for i, start in enumerate(td.unbind(0)):
        maze = env.mazes[int(start["maze_index"])]
        player, target = tile(start["position"]), tile(start["target"])
        assert int(lengths[i]) == int(shortest_path_lengths(maze, target)[player])
        path = [player, *map(tile, goals[i, : lengths[i]])]
        assert path[-1] == target
        assert (goals[i, lengths[i] :] == goals[i, lengths[i] - 1]).all()
        for (row, col), (next_row, next_col) in zip(path[:-1], path[1:], strict=True):
            assert abs(row - next_row) + abs(col - next_col) == 1
            assert not maze[next_row, next_col]


@PLANNERS
def test_plans_are_shortest_where_mazes_have_many_ways(make: Any) -> None:
    # Walls that stand alone: very many shortest paths, and a search by visits is led astray.
    mazes = torch.zeros(20, 9, 9, dtype=torch.bool)
    for maze in mazes:
        posts = torch.randperm(16)[:8]
        maze[2 * (posts // 4) + 1, 2 * (posts % 4) + 1] = True
    env = WaterworldMazeEnv(mazes, observation=False, batch_size=[60], seed=0)
    td = env.reset()
    _, lengths = make(env).plan_goals(td)
    for i, start in enumerate(td.unbind(0)):
        far = shortest_path_lengths(mazes[int(start["maze_index"])], tile(start["target"]))
        assert int(lengths[i]) == int(far[tile(start["position"])])


@PLANNERS
def test_a_plan_begins_behind_the_player_s_tile(make: Any) -> None:
    env = WaterworldMazeEnv(MAZE[None], observation=False)
    planner = make(env)
    for position in ([0.3, 0.3], [0.5, 0.5], [0.75, 0.74]):
        goals, lengths = planner.plan_goals(env.make_state(0, [position], (2.5, 2.5)))
        assert lengths.tolist() == [4]
        assert goals[0, 0].tolist() == [1.5, 0.5]
        assert goals[0, -1].tolist() == [2.5, 2.5]


@PLANNERS
def test_on_the_target_s_tile_the_plan_is_the_target(make: Any) -> None:
    env = WaterworldMazeEnv(MAZE[None], observation=False)
    goals, lengths = make(env).plan_goals(env.make_state(0, [[2.3, 2.3]], (2.7, 2.7)))
    assert (goals.tolist(), lengths.tolist()) == ([[[2.5, 2.5]]], [1])


@PLANNERS
def test_a_plan_does_not_depend_on_what_is_planned_beside_it(make: Any) -> None:
    env = WaterworldMazeEnv(maze_pool("test")[:20], batch_size=[6], seed=0)
    td = env.reset()
    planner = make(env)
    goals, lengths = planner.plan_goals(td)
    for i in (5, 0, 3):
        alone, length = planner.plan_goals(td[i : i + 1])
        assert length[0] == lengths[i]
        assert (alone[0] == goals[i, : lengths[i]]).all()


def test_the_moves_are_the_gridworld_s() -> None:
    moves = tile_moves(MAZE[None])[0]
    # Tiles 0 1 2 / 3 4 5 / 6 7 8; walls 2 and 3. Up, down, left, right, none.
    assert moves[0].tolist() == [0, 0, 0, 1, 0]
    assert moves[4].tolist() == [1, 7, 4, 5, 4]


# ----------------------------------------------------------------------------------- worker's env


@pytest.mark.parametrize("batch", [(), (3,)])
def test_specs_of_the_worker_s_env_are_exact(batch: tuple[int, ...]) -> None:
    check_env_specs(make_goal_env(batch_size=batch, seed=0))


def test_the_task_s_reward_comes_with_the_last_goal() -> None:
    env = make_goal_env(maze_pool("test"), observation=False, seed=1)
    for _ in range(3):
        data = env.rollout(1000, ScriptedExpert())
        length, met = int(data["plan_length"][0]), data["next", "num_goals_met"].flatten()
        assert data["next", "task_reward"].flatten().nonzero().flatten().tolist() == [len(data) - 1]
        assert int(met[-1]) == length
        assert int(met[-2]) == length - 1
        total = data["next", "reward"].sum().item()
        assert total == pytest.approx(length - 0.025 * len(data), abs=1e-4)


def test_arguments_reach_the_env_and_the_transform() -> None:
    env = make_goal_env(
        MAZE[None], max_steps=3, batch_size=[2], r_tick=-1.0, num_goals=1, relative=False
    )
    data = env.rollout(9)
    assert data.shape == (2, 3)
    assert "observation" in data.keys()
    assert data["goals"].shape == (2, 3, 2)
    assert data["plan"].shape[-2:] == (7, 2)  # the free tiles
    assert data["next", "reward"].min() <= -1.0
    with pytest.raises(ValueError, match="num_goals >= 1"):
        make_goal_env(num_goals=0)


def test_any_manager_can_be_handed_over() -> None:
    def straight(td: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
        return td["target"].unsqueeze(1), torch.ones(len(td), dtype=torch.int64)

    env = make_goal_env(planner=straight, goal_divergence_threshold=20.0, relative=False, seed=0)
    td = env.reset()
    assert (td["goals"].view(3, 2) == td["target"]).all()


def test_a_start_of_one_s_own_gets_a_fresh_plan() -> None:
    env = make_goal_env(maze_pool("test"), observation=False, seed=0)
    starts = make_starts(env.base_env, 5, seed=0)
    td = env.reset(starts, set_state=True)
    assert (td["position"] == starts["position"]).all()
    ends = td["plan"].gather(1, (td["plan_length"] - 1).unsqueeze(-1).expand(5, 1, 2)).squeeze(1)
    assert (ends == starts["target"]).all()


def test_a_collector_s_running_episodes_go_on_from_a_checkpoint() -> None:
    def collector() -> Collector:
        env = make_goal_env(batch_size=[3], observation=False, max_steps=37, seed=0)
        return Collector(
            env,
            ScriptedExpert(),
            frames_per_batch=60,
            total_frames=120,
            auto_register_policy_transforms=False,
        )

    whole = collector()
    batches = iter(whole)
    next(batches)
    saved = copy.deepcopy(RunningEpisodes(whole).state_dict())
    draws = copy.deepcopy(GeneratorStates(env=whole.env).state_dict())
    second = next(batches)
    resumed = collector()
    RunningEpisodes(resumed).load_state_dict(saved)
    GeneratorStates(env=resumed.env).load_state_dict(draws)
    again = next(iter(resumed))
    assert second["next", "done"].any()  # and plans for the episodes that follow
    for key in second["next"].keys():
        assert (again["next", key] == second["next", key]).all(), key
    whole.shutdown()
    resumed.shutdown()


@pytest.mark.slow  # pytest -m slow tests/test_goal_planning.py
def test_workers_in_processes_plan_for_themselves() -> None:
    env = ParallelEnv(2, make_goal_env)
    try:
        data = env.rollout(30, break_when_any_done=False)
    finally:
        env.close()
    assert (data["plan_length"] >= 1).all()
    assert (data["num_plans"] >= 1).all()


def test_going_to_and_fro_around_a_corner_does_not_pay() -> None:
    maze, player, target = maze_from_text("..P.###\n###..##\n####..#\n#####..\n######.\n######T")
    env = make_goal_env(maze[None], observation=False, max_steps=10_000, r_tick=0.0)
    td = env.reset(
        env.base_env.make_state(0, (player[1] + 0.5, player[0] + 0.5), (6.5, 5.5)), set_state=True
    )
    assert target == (5, 6)
    expert, turned, plans, earned = ScriptedExpert(), False, 1, []
    for _ in range(450):
        turned = (turned and int(td["num_plans"]) == plans) or int(td["goal_index"]) >= 2
        plans = int(td["num_plans"])
        action = expert(td.clone())["action"]
        if turned:  # back the way it came until the manager plans again
            behind = td["plan"][int(td["goal_index"]) - 2] - td["position"]
            way = behind if behind.abs().max() > 0.4 else torch.tensor([-1.0, 0.0])
            action = expert(td.clone().set("goals", way.repeat(3)))["action"]
        td = env.step(td.set("action", action))["next"]
        earned.append(td["reward"].item())
        td = td.exclude("reward", "task_reward")
    assert earned.count(-1.0) >= 5  # it works as intended: goals of a new plan are paid again,
    assert 0.01 < np.mean(earned) < 0.025  # and what they pay is below the tick by default


# ------------------------------------------------------------------------------------- the expert


def test_the_expert_solves_mazes_it_has_never_seen() -> None:
    env = make_goal_env(maze_pool("test"), observation=False, seed=0)
    starts = make_starts(env.base_env, 40, seed=5)
    shortest = env.reset(starts.clone(), set_state=True)["plan_length"]
    episodes = play_mazes(ScriptedExpert(), env, starts)
    assert episodes.summary()["solved_share"] == 1.0
    assert (episodes.base_steps / shortest.squeeze(-1)).mean() < 11.5
    assert not episodes.last["num_divergences"].any()
    assert (episodes.last["num_goals_met"] == shortest).all()


@pytest.mark.parametrize(
    ("goals", "velocity", "action"),
    [
        ([0.0, -1.0, 0.0, -2.0, 0.0, -3.0], [0.0, 0.0], 0),
        ([0.0, 1.0, 0.0, 2.0, 0.0, 3.0], [0.0, 0.0], 1),
        ([-1.0, 0.0, -2.0, 0.0, -3.0, 0.0], [0.0, 0.0], 2),
        ([1.0, 0.0, 2.0, 0.0, 3.0, 0.0], [0.0, 0.0], 3),
        # Before a corner: 0.35 and 0.4 * 1 against 0.2 * 2: the turn comes first.
        ([0.35, 0.0, 0.35, 1.0, 0.35, 2.0], [2.0, 0.0], 1),
        # Too fast for a goal close ahead: 0.1 - 0.2 * 2 < 0.
        ([0.1, 0.0, 0.1, 0.0, 0.1, 0.0], [2.0, 0.0], 2),
    ],
)
def test_the_expert_thrusts_where_the_goals_are(
    goals: list[float], velocity: list[float], action: int
) -> None:
    env = make_goal_env(observation=False, seed=0)
    td = env.reset().update({"goals": torch.tensor(goals), "velocity": torch.tensor(velocity)})
    assert ScriptedExpert()(td)["action"].item() == action


def test_episodes_side_by_side_are_those_one_after_the_other() -> None:
    env = make_goal_env(maze_pool("test"), observation=False, max_steps=60, seed=0)
    starts = make_starts(env.base_env, 5, seed=2)
    episodes = play_mazes(ScriptedExpert(), env, starts, record=True)
    assert 0 < episodes.solved.sum() < 5  # some run out of time
    for i in range(5):
        td = env.reset(starts[i].clone(), set_state=True)
        data = env.rollout(99, ScriptedExpert(), auto_reset=False, tensordict=td)
        last = data["next"][-1]
        assert episodes.base_steps[i] == len(data)
        assert episodes.solved[i] == last["terminated"].item()
        assert episodes.last["num_goals_met"][i] == last["num_goals_met"]
        track = episodes.tracks[i]
        points = torch.cat((data["position"], last["position"][None])).numpy()
        assert (track.positions == points).all()
        assert track.goal_index.tolist()[:-1] == data["goal_index"].flatten().tolist()
        assert track.plan_at(0)[-1].tolist() == starts["target"][i].tolist()


def test_a_track_remembers_each_plan_from_when_it_was_made() -> None:
    def away(td: TensorDictBase) -> TensorDictBase:  # never towards the first goal
        x, y = td["goals"].view(-1, 3, 2)[:, 0].unbind(-1)
        far = torch.where(x.abs() > y.abs(), torch.where(x > 0, 2, 3), torch.where(y > 0, 0, 1))
        return td.set("action", far)

    room = torch.zeros(1, 9, 9, dtype=torch.bool)
    env = make_goal_env(room, observation=False, max_steps=120, seed=0)
    start = env.base_env.make_state([0], [[4.5, 4.5]], (4.5, 0.5))
    episodes = play_mazes(away, env, start, record=True)
    track = episodes.tracks[0]
    assert not episodes.solved[0]
    assert len(track.plans) == episodes.last["num_plans"][0] > 1
    assert episodes.last["num_divergences"][0] == len(track.plans) - 1
    for made, goals in track.plans.items():
        distance = np.linalg.norm(goals[0] - track.positions[made])
        assert distance < 1.6  # planned from there
        if made:
            assert track.plan_at(made - 1) is not goals
            previous = track.plan_at(made - 1)[track.goal_index[made - 1]]
            assert np.linalg.norm(previous - track.positions[made]) > 2.0


# ---------------------------------------------------------------------------------------- pictures


def example() -> tuple[WaterworldMazeEnv, TensorDictBase, GoalTrack]:
    env = make_goal_env(MAZE[None], observation=False, seed=0)
    start = env.base_env.make_state([0], (0.5, 0.5), (2.5, 2.5))
    track = play_mazes(ScriptedExpert(), env, start, record=True).tracks[0]
    return env.base_env, start[0], track


def pixel(image: np.ndarray, x: float, y: float) -> tuple[int, ...]:
    return tuple(image[int(8 + 32 * y), int(8 + 32 * x)].tolist())


def test_goals_are_red_until_they_are_met() -> None:
    env, start, track = example()
    first = draw_goals(env, start, track, 0)
    assert pixel(first, 0.5, 0.5) == PLAYER_COLOR
    goals = track.plan_at(0)
    assert all(pixel(first, x, y) == DOT_COLOR for x, y in goals)
    met = int(np.flatnonzero(track.goal_index == 2)[0])
    later = draw_goals(env, start, track, met)
    assert pixel(later, *goals[0]) != DOT_COLOR
    assert all(pixel(later, x, y) == DOT_COLOR for x, y in goals[2:])
    last = draw_goals(env, start, track, len(track.positions) - 1)
    assert not (last == DOT_COLOR).all(-1).any()
    assert (last == TARGET_COLOR).all(-1).any()


def test_an_episode_becomes_a_picture_and_a_gif(tmp_path: Path) -> None:
    env, start, track = example()
    plot_goals(env, start, track, tmp_path / "goals.png")
    image = iio.imread(tmp_path / "goals.png")
    assert image.shape[1] > 2.5 * image.shape[0]  # three panels
    write_goal_gif(env, start, track, tmp_path / "goals.gif")
    frames = iio.imread(tmp_path / "goals.gif")
    steps = [*range(0, len(track.positions) - 1, 2), len(track.positions) - 1]
    assert frames.shape == (len(steps), 112, 112, 3)
    assert (frames[0].astype(int) - draw_goals(env, start, track, 0)).max() < 60


def test_the_search_and_the_macro_environment_are_drawn(tmp_path: Path) -> None:
    env, start, _ = example()
    plot_macro_env(env, start, tmp_path / "macro.png")
    manager = make_tile_planner(env)
    goals, lengths = manager.plan_goals(start[None])
    search = manager.planner.last_search
    plot_tile_search(env, start, search, goals[0, : int(lengths[0])], tmp_path / "search.png")
    for name, colors in {"macro.png": 2, "search.png": 3}.items():
        image = iio.imread(tmp_path / name)[..., :3]
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10 * colors
        assert (image == PLAYER_COLOR).all(-1).any()
        assert (image == TARGET_COLOR).all(-1).any()


def test_every_python_block_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Path(__file__).parents[1] / "docs" / "algorithms" / "goal_based_agent.md"
    text = page.read_text()
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {}
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert len(blocks) == 4
    for block in blocks:
        exec(compile(block, str(page), "exec"), namespace)  # noqa: S102
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"episode.png"}
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", text):
        assert (page.parent / target).exists(), f"links to {target}, which is missing"
