"""Agents that act in Waterworld themselves: networks, test episodes, and the experiments' files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase

from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.goals import make_maze_networks
from torchrl_hmcts.trainers.experiments.settings import WaterworldA3CConfig, WaterworldGoalsConfig
from torchrl_hmcts.trainers.experiments.waterworld.episodes import play_mazes
from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import make_goal_env


@pytest.fixture
def env() -> WaterworldMazeEnv:
    """An open room of three by nine tiles."""
    return WaterworldMazeEnv(torch.zeros(1, 3, 9, dtype=torch.bool), max_steps=120, seed=0)


def test_a_network_sees_places_from_the_middle_and_speeds_in_what_thrust_reaches() -> None:
    keys = ["observation", "velocity", "goals"]
    network = make_maze_networks(make_goal_env(), in_keys=keys)[1].module
    seen: list[torch.Tensor] = []
    network.layers[0].register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    size = network.layers[0].in_features - 8
    network(
        torch.tensor([0.0, *[9.0] * (size - 1)]), torch.tensor([2.0, -1.0]), 2.0 * torch.ones(6)
    )
    assert seen[0].tolist() == [-1.0, *[1.0] * (size - 1), 1.0, -0.5, *[1.0] * 6]


def test_at_first_all_actions_are_about_equally_likely(env) -> None:
    actor, _ = make_maze_networks(env, in_keys=["observation", "velocity"])
    probs = actor.get_dist(env.reset()).probs
    torch.testing.assert_close(probs, torch.full((4,), 0.25), atol=0.02, rtol=0.0)


def test_the_same_seed_gives_the_same_networks_and_leaves_the_global_generator_alone(env) -> None:
    before = torch.get_rng_state()
    one, two = (
        make_maze_networks(env, in_keys=["velocity", "observation"], seed=4)[1] for _ in "ab"
    )
    assert torch.equal(before, torch.get_rng_state())
    for a, b in zip(one.parameters(), two.parameters(), strict=True):
        assert torch.equal(a, b)


def to_the_right(td: TensorDictBase) -> TensorDictBase:
    return td.set("action", torch.full(td.batch_size, 3))


def test_each_start_is_played_until_its_own_end(env) -> None:
    starts = env.make_state(
        0, [[1.5, 1.5], [6.5, 1.5], [1.5, 1.5]], [[8.5, 1.5], [8.5, 1.5], [1.5, 0.5]]
    )
    test = play_mazes(to_the_right, env, starts)
    assert test.solved.tolist() == [True, True, False]  # the third target is above its start
    assert test.base_steps[2] == 120
    assert 10 < test.base_steps[1] < test.base_steps[0] < 120
    assert test.last["start"].tolist() == [0, 1, 2]
    assert test.last["step_count"].flatten().tolist() == test.base_steps.tolist()


def test_sampled_tests_repeat_by_their_seed(env) -> None:
    actor, _ = make_maze_networks(env, in_keys=["observation", "velocity"])
    starts = env.make_state(0, [[6.5, 1.5]] * 4, (7.5, 1.5))
    one, again, other = (play_mazes(actor, env, starts, seed=seed) for seed in (1, 1, 2))
    places = [test.last["position"].tolist() for test in (one, again, other)]
    assert places[0] == places[1] != places[2]


@pytest.mark.parametrize("name", ["waterworld_goals", "waterworld_a3c"])
def test_an_experiment_writes_its_folder_and_goes_on_from_it(name: str, tmp_path: Path) -> None:
    words = ["train", f"experiment={name}", f"out={tmp_path}", "toy=true", "seed=2"]
    assert main(words) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["seed"] == 2
    assert metrics["train_base_steps"] == 4_480  # 7 segments of 32 mazes and 20 steps
    assert metrics["test"]["mazes"] == 3
    assert ("num_plans_mean" in metrics["test"]) == (name == "waterworld_goals")
    rows = (tmp_path / "curves.csv").read_text().splitlines()
    assert rows[0] == "name,base_steps,value"
    assert any(row.startswith("eval_solved_share,") for row in rows)
    page = (tmp_path / "index.html").read_text()
    for picture in tmp_path.glob("*.png"):
        assert f'src="{picture.name}"' in page
    assert (tmp_path / "learning.png").stat().st_size > 1000
    assert main([*words, "resume=true"]) == 0  # nothing is left to train
    assert json.loads((tmp_path / "metrics.json").read_text())["train_base_steps"] == 4_480


@pytest.mark.parametrize(
    ("key", "value"),
    [("total_frames", 0), ("num_learners", -1), ("gamma", 1.5), ("learning_rate", 0.0),
     ("test_mazes", 343), ("entropy_coeff", -0.1), ("hidden", 0)],
)  # fmt: skip
def test_a_value_out_of_range_is_refused_by_name(key: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{key}.*{value}"):
        WaterworldA3CConfig(**{key: value})


def test_goals_that_are_met_farther_off_than_strayed_from_are_refused() -> None:
    with pytest.raises(ValueError, match="got 2.5 and 2.0"):
        WaterworldGoalsConfig(goal_met_threshold=2.5)
