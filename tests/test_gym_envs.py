"""The Gymnasium side: registration, Gymnasium's own checker, seeds, states, bad input."""

from __future__ import annotations

import json
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs import PendulumEnv

from torchrl_hmcts.envs import (
    GridworldMazeEnv,
    TorchRLGymnasiumEnv,
    WaterworldMazeEnv,
    maze_from_text,
)
from torchrl_hmcts.envs.gym_envs import register_envs

IDS = {
    "torchrl_hmcts/GridworldMaze-v0": (GridworldMazeEnv, 5),
    "torchrl_hmcts/WaterworldMaze-v0": (WaterworldMazeEnv, 4),
}


@pytest.fixture(params=IDS)
def env_id(request):
    return request.param


def test_gymnasium_checker_passes(env_id):
    env = gymnasium.make(env_id, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_spaces_are_those_of_the_torchrl_env(env_id):
    env_class, num_actions = IDS[env_id]
    env = gymnasium.make(env_id)
    assert isinstance(env.unwrapped.env, env_class)
    assert env.action_space == gymnasium.spaces.Discrete(num_actions)
    assert env.observation_space.shape == (66,)
    spec = env.unwrapped.env.observation_spec["observation"]
    assert np.array_equal(env.observation_space.low, spec.space.low.numpy())
    assert np.array_equal(env.observation_space.high, spec.space.high.numpy())


def test_same_seed_same_episode(env_id):
    def episode(seed):
        env = gymnasium.make(env_id)
        observations = [env.reset(seed=seed)[0]]
        observations += [env.step(action % 4)[0] for action in range(20)]
        return np.stack(observations)

    assert np.array_equal(episode(1), episode(1))
    assert not np.array_equal(episode(1), episode(2))


def test_a_reset_without_seed_goes_on_to_another_maze(env_id):
    env = gymnasium.make(env_id)
    first, _ = env.reset(seed=0)
    second, _ = env.reset()
    assert not np.array_equal(first, second)


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


def test_vector_envs_run_it(env_id):
    envs = gymnasium.make_vec(env_id, num_envs=2, vectorization_mode="sync")
    observation, _ = envs.reset(seed=0)
    assert observation.shape == (2, 66)
    assert envs.step(envs.action_space.sample())[0].shape == (2, 66)
    envs.close()


def test_registering_again_is_harmless():
    before = {env_id: gymnasium.spec(env_id) for env_id in IDS}
    register_envs()
    assert {env_id: gymnasium.spec(env_id) for env_id in IDS} == before


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

    def test_without_a_render_mode_nothing_is_drawn(self):
        env = TorchRLGymnasiumEnv(GridworldMazeEnv())
        env.reset(seed=0)
        assert env.render() is None


def test_a_window_shows_every_step(env_id, monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gymnasium.make(env_id, render_mode="human").unwrapped
    plain = gymnasium.make(env_id, render_mode="rgb_array")
    for each in (env, plain):
        each.reset(seed=0)
        each.step(1)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, plain.render())
    assert env.render() is None
    env.close()
    assert pygame.display.get_surface() is None


def test_a_window_without_pygame_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"torchrl_hmcts\[gym\]"):
        TorchRLGymnasiumEnv(GridworldMazeEnv(), "human")
