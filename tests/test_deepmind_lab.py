"""DeepMindLabEnv over a stand-in of the engine's module: the adapter's shape, not the engine."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.envs import DeepMindLabEnv, LabMazeEnv
from torchrl_hmcts.envs.lab.read_outs import READ_OUTS

FORWARD, NOTHING = 0, 8
NINE: dict[str, Any] = {"level": "nine", "rows": 9, "columns": 9, "maze_seeds": [1, 2], "seed": 0}


@pytest.fixture(autouse=True)
def engine(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The stand-in, importable as ``deepmind_lab``."""
    path = Path(__file__).parent / "lab_stand_in.py"
    spec = importlib.util.spec_from_file_location("lab_stand_in", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(sys.modules, "deepmind_lab", module)
    return module


def play(env: DeepMindLabEnv, td: Any, actions: Any) -> list[Any]:
    steps = []
    for action in actions:
        td = env.step(td.set("action", torch.as_tensor(action)))["next"]
        steps.append(td)
        if td["done"]:
            break
    return steps


@pytest.mark.parametrize("actions", [None, {"run": (0, 0, 0, 1), "turn": (5, 0, 0, 0)}])
def test_specs_hold(actions: Any) -> None:
    env = DeepMindLabEnv(
        **NINE,
        actions=actions,
        read_outs=READ_OUTS,
        config={"width": "8", "height": "4"},
        observations={"RGB_INTERLEAVED": "pixels", "VEL.ROT": "spin"},
    )
    check_env_specs(env)
    assert env.observation_spec["pixels"].shape == (4, 8, 3)
    assert env.rollout(3)["pixels"].dtype == torch.uint8


def test_keys_specs_and_actions_are_those_of_the_simulation() -> None:
    env = DeepMindLabEnv(**NINE)
    other = LabMazeEnv(maze_seeds=[1, 2])
    assert env.observation_spec == other.observation_spec
    assert env.action_spec == other.action_spec
    assert env.reward_spec == other.reward_spec
    assert set(env.rollout(2).keys(True)) == set(other.rollout(2).keys(True))


def test_it_writes_the_state_that_the_engine_is_in(engine: ModuleType) -> None:
    env = DeepMindLabEnv(**NINE, num_steps=5)
    td = env.reset()
    for action in torch.randint(9, (60,)):
        (td,) = play(env, td, [action])
        true = engine.Lab.opened[-1]._td
        torch.testing.assert_close(td["position"], true["position"], atol=1e-4, rtol=0)
        assert (td["velocity"] == true["velocity"]).all()
        for key in ("heading", "body_velocity", "tile_position", "goal"):
            torch.testing.assert_close(td[key], true[key], atol=2e-4, rtol=0)
        assert td["level"][[1, 2, 3]].tolist() == true["level"][[1, 2, 3]].tolist()


def test_the_simulation_goes_on_from_what_it_writes() -> None:
    """One step ahead, the model's clock of 16 ms beside the engine's of 14 and 17."""
    env = DeepMindLabEnv(**NINE)
    steps = play(env, env.reset(), [FORWARD] * 40)
    for before, after in zip(steps[:-1], steps[1:], strict=True):
        state = env.model.reset(before, set_state=True)
        ours = env.model.step(state.set("action", torch.tensor(FORWARD)))["next"]
        assert (ours["position"] - after["position"]).norm() < 1.0
        assert (ours["velocity"] - after["velocity"]).norm() < 12.0


def test_a_step_repeats_frames_and_ends_in_that_of_the_goal(engine: ModuleType) -> None:
    env = DeepMindLabEnv(**NINE, num_steps=10)
    td = env.reset()
    lab = engine.Lab.opened[-1]
    env.step(td.set("action", torch.tensor(FORWARD)))
    assert lab.steps == [([0, 0, 0, 1, 0, 0, 0], 1)] * 10
    goal = torch.from_numpy(env.model.layout.goal[td["maze_index"].item()])
    lab._td["position"] = goal.clone()
    lab.steps.clear()
    after = env.step(td.set("action", torch.tensor(NOTHING)))["next"]
    assert len(lab.steps) == 1
    assert after["reward"].item() == 10.0
    assert after["terminated"]
    assert not after["truncated"]
    with pytest.raises(RuntimeError, match=r"has ended.*Call reset\(\)"):
        env.step(td)


def test_in_the_stock_level_the_goal_begins_the_maze_anew(engine: ModuleType) -> None:
    env = DeepMindLabEnv(**NINE, terminate_on_goal=False)
    td = env.reset()
    lab = engine.Lab.opened[-1]
    apples = env.model.layout.apples[td["maze_index"].item()]
    lab._td["position"] = torch.from_numpy(apples[0].copy())
    (td,) = play(env, td, [NOTHING])
    assert td["reward"].item() == lab._td["reward"].item() >= 1.0
    assert td["level"][1] == lab._td["level"][1]  # the apples that are left
    lab._td["position"] = torch.from_numpy(env.model.layout.goal[td["maze_index"].item()].copy())
    won, anew = play(env, td, [NOTHING] * 2)
    assert won["reward"].item() >= 10.0
    assert not won["done"]
    assert won["level"][2] == 1
    assert anew["level"][2] == 0
    assert anew["level"][1] == lab._td["level"][1]  # all of them


def test_the_end_of_the_engines_episode_truncates(engine: ModuleType) -> None:
    env = DeepMindLabEnv(**NINE, max_frames=120, num_steps=50)
    assert engine.Lab.opened[-1].config["episodeLengthSeconds"] == "2"
    steps = play(env, env.reset(), [FORWARD] * 5)
    assert [td["truncated"].item() for td in steps] == [False, False, True]
    assert steps[-1]["level"][3].item() == 120
    with pytest.raises(RuntimeError, match="has ended"):
        env.step(steps[-1].set("action", torch.tensor(FORWARD)))
    assert env.reset()["level"][3].item() == 0


def test_a_seed_decides_which_mazes_are_played() -> None:
    def mazes(seed: int) -> list[int]:
        env = DeepMindLabEnv(**{**NINE, "maze_seeds": range(20), "seed": seed})
        return [env.reset()["maze_index"].item() for _ in range(6)]

    assert mazes(1) == mazes(1)
    assert mazes(1) != mazes(2)


def test_a_level_whose_mazes_are_others_is_noticed() -> None:
    env = DeepMindLabEnv(level="nine", rows=15, columns=15, maze_seeds=range(60), seed=0)

    def play_on() -> None:
        for _ in range(60):
            env.reset()

    with pytest.raises(RuntimeError, match="no spawn point, of the 15 x 15 maze of seed"):
        play_on()


def test_a_player_inside_a_wall_is_noticed(engine: ModuleType) -> None:
    env = DeepMindLabEnv(**NINE)
    td = env.reset()
    engine.Lab.opened[-1]._td["position"] = torch.tensor([50.0, 50.0])
    with pytest.raises(RuntimeError, match=r"at \[50.0, 50.0\], which is a wall"):
        env.step(td.set("action", torch.tensor(NOTHING)))


def test_it_draws_from_above_and_closes_the_engine(engine: ModuleType) -> None:
    env = DeepMindLabEnv(**NINE)
    assert env.render(env.reset()).shape == (304, 304, 3)
    env.close()
    assert engine.Lab.opened[-1].closed


def test_it_cannot_be_set_to_a_state_and_says_what_can() -> None:
    env = DeepMindLabEnv(**NINE)
    assert not env._supports_set_state
    with pytest.raises(RuntimeError, match=r"env\.model"):
        env._reset(env.reset(), set_state=True)


def test_without_the_module_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "deepmind_lab", None)
    with pytest.raises(ImportError, match=r"'deepmind_lab'.*Bazel.*dmlab-gym.*LabMazeEnv"):
        DeepMindLabEnv()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"maze_seeds": []}, "needs maze_seeds"),
        ({"maze_seeds": [-1]}, r"0 to 2\*\*31 - 1; got \[-1\]"),
        ({"num_steps": 0}, "num_steps >= 1"),
        ({"observations": {"SONAR": "sonar"}}, r"SONAR"),
        ({"observations": {"VEL.ROT": "velocity"}}, "under 'velocity': the key must be free"),
        ({"observations": {"INSTR": "instruction"}}, "and shape .*numbers of a fixed shape"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DeepMindLabEnv(**{**NINE, **arguments})


def test_an_action_out_of_range_is_refused() -> None:
    env = DeepMindLabEnv(**NINE)
    with pytest.raises(ValueError, match="must be 0 to 8; got 9"):
        env.step(env.reset().set("action", torch.tensor(9)))


def test_observations_are_copies(engine: ModuleType) -> None:
    env = DeepMindLabEnv(**NINE, observations={"VEL.ROT": "spin"})
    td = env.reset()
    kept = td.clone()
    play(env, td, [FORWARD] * 5)
    assert np.array_equal(td["spin"].numpy(), kept["spin"].numpy())
    assert (td.select(*kept.keys()) == kept).all()
