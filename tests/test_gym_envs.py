"""The Gymnasium side: registration, Gymnasium's own checker, seeds, states, bad input."""

from __future__ import annotations

import json
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import PendulumEnv

from torchrl_hmcts.envs import (
    GridworldMazeEnv,
    TorchRLGymnasiumEnv,
    WaterworldMazeEnv,
    maze_from_text,
)

IDS = {
    "torchrl_hmcts/GridworldMaze-v0": (GridworldMazeEnv, 5),
    "torchrl_hmcts/WaterworldMaze-v0": (WaterworldMazeEnv, 4),
}


@pytest.fixture(params=IDS)
def env_id(request):
    return request.param


def test_spaces_are_those_of_the_torchrl_env(env_id):
    env_class, num_actions = IDS[env_id]
    env = gymnasium.make(env_id)
    assert isinstance(env.unwrapped.env, env_class)
    assert env.action_space == gymnasium.spaces.Discrete(num_actions)
    assert env.observation_space.shape == (66,)
    spec = env.unwrapped.env.observation_spec["observation"]
    assert np.array_equal(env.observation_space.low, spec.space.low.numpy())
    assert np.array_equal(env.observation_space.high, spec.space.high.numpy())


def test_steps_equal_those_of_the_torchrl_env(env_id):
    env_class, num_actions = IDS[env_id]
    env, plain = gymnasium.make(env_id), env_class()
    observation, info = env.reset(seed=5)
    plain.set_seed(5)
    td = plain.reset()
    for step in range(40):
        assert np.array_equal(observation, td["observation"].numpy())
        assert np.array_equal(info["position"], td["position"].numpy())
        action = step * 7 % num_actions
        observation, reward, terminated, truncated, info = env.step(action)
        td = plain.step(td.set("action", torch.tensor(action)))["next"]
        assert (reward, terminated, truncated) == (
            td["reward"].item(),
            td["terminated"].item(),
            td["truncated"].item(),
        )
        if terminated:
            break


def test_time_limit_is_truncation_and_arrival_is_termination():
    maze, player, target = maze_from_text("P.T\n...")
    env = gymnasium.make("torchrl_hmcts/GridworldMaze-v0", mazes=maze[None], max_steps=3)
    state = env.unwrapped.env.make_state(0, player, target)
    env.reset(options={"state": state})
    assert [env.step(3)[1:4] for _ in range(2)] == [(0.0, False, False), (1.0, True, False)]
    env.reset(options={"state": state})
    assert [env.step(4)[1:4] for _ in range(3)] == [(0.0, False, False)] * 2 + [(0.0, False, True)]


def test_reset_starts_from_a_state_and_leaves_it_unchanged(env_id):
    env = gymnasium.make(env_id)
    state = env.unwrapped.env.reset()
    before = state.clone()
    observation, _ = env.reset(options={"state": state})
    env.step(0)
    assert np.array_equal(observation, before["observation"].numpy())
    assert set(state.keys()) == set(before.keys())
    assert (state == before).all()


def test_info_is_not_changed_by_later_steps(env_id):
    env = gymnasium.make(env_id)
    _, info = env.reset(seed=0)
    kept = {key: value.copy() for key, value in info.items()}
    for action in (0, 1, 2, 3):
        env.step(action)
    assert all(np.array_equal(info[key], kept[key]) for key in kept)


def test_specs_survive_json(env_id):
    assert json.loads(gymnasium.spec(env_id).to_json())["id"] == env_id


def test_module_id_form_of_gymnasium_imports_the_package(tmp_path):
    env_id = "torchrl_hmcts/WaterworldMaze-v0"
    code = f"import gymnasium; print(gymnasium.make('torchrl_hmcts.envs:{env_id}').spec.id)"
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == env_id


class TestBadInput:
    def test_step_and_render_before_reset_are_refused(self):
        env = TorchRLGymnasiumEnv(GridworldMazeEnv(), "rgb_array")
        with pytest.raises(RuntimeError, match=r"step\(\) needs an episode.*reset\(\)"):
            env.step(0)
        with pytest.raises(RuntimeError, match=r"render\(\) needs"):
            env.render()

    @pytest.mark.parametrize("action", [5, -1, 1.5, None])
    def test_an_action_out_of_range_is_refused(self, action):
        env = TorchRLGymnasiumEnv(GridworldMazeEnv())
        env.reset(seed=0)
        with pytest.raises(ValueError, match=rf"integer 0 to 4, got {action}"):
            env.step(action)

    def test_an_unknown_render_mode_is_refused(self):
        with pytest.raises(ValueError, match="got 'ansi'"):
            TorchRLGymnasiumEnv(GridworldMazeEnv(), "ansi")

    def test_an_env_with_continuous_actions_is_refused(self):
        with pytest.raises(ValueError, match="one Categorical action"):
            TorchRLGymnasiumEnv(PendulumEnv())


def test_a_window_shows_every_step(env_id, monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with pytest.warns(UserWarning, match="HumanRendering wrapper is being applied"):
        env = gymnasium.make(env_id, render_mode="human")
    plain = gymnasium.make(env_id, render_mode="rgb_array")
    for each in (env, plain):
        each.reset(seed=0)
        each.step(1)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, plain.render())
    assert env.render() is None
    env.close()
