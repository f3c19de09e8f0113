"""Every environment keeps TorchRL's and Gymnasium's contracts, in one process and in several."""

from __future__ import annotations

import functools
from collections.abc import Callable

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv

from torchrl_hmcts.envs import GridworldMazeEnv, LabMazeEnv, WaterworldMazeEnv
from torchrl_hmcts.modules import SkillActor, SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, SearchBudget
from torchrl_hmcts.testing import (
    ChainEnv,
    PointMassEnv,
    TableEnv,
    check_env,
    check_macro_env,
    check_parallel_env,
    check_planner,
)
from torchrl_hmcts.transforms import OptionTransform

MAZES: dict[str, tuple[type[EnvBase], str]] = {
    "gridworld": (GridworldMazeEnv, "player_tile"),
    "waterworld": (WaterworldMazeEnv, "velocity"),
    "lab": (LabMazeEnv, "velocity"),
}
MACRO_ENVS: dict[str, Callable[[], EnvBase]] = {
    "gridworld": functools.partial(GridworldMazeEnv, max_steps=6),
    "waterworld": functools.partial(WaterworldMazeEnv, max_steps=6),
    "lab": functools.partial(LabMazeEnv, maze_seeds=range(4), max_frames=6),
    "chain": functools.partial(ChainEnv, 4),
    "point_mass": PointMassEnv,
    "table": functools.partial(
        TableEnv, {(0, 0): (1, 0.0, 2), (1, 0): (0, 0.0, 1), (1, 1): (2, 1.0, 5)}, terminal=[2]
    ),
}


def under_options(make_env: Callable[[], EnvBase], key: str) -> TransformedEnv:
    """The env under options of a small network that reads one entry."""
    env = make_env()
    size = env.full_observation_spec[key].shape[-1]
    worker = SkillActor(size, env.action_spec, 3, in_keys=[key], hidden=(8,))
    return TransformedEnv(env, OptionTransform(SkillPolicy(worker, deterministic=True), 3, 4))


@pytest.mark.parametrize("name", MACRO_ENVS)
def test_an_env_keeps_the_contract_of_a_macro_env(name: str) -> None:
    """Specs, episodes that go on, seeds, partial resets and steps, states, batches."""
    check_macro_env(MACRO_ENVS[name](), num_steps=10)


@pytest.mark.parametrize("name", ["waterworld", "lab"])
def test_an_env_of_options_keeps_it_too(name: str) -> None:
    check_macro_env(under_options(MACRO_ENVS[name], MAZES[name][1]), num_steps=5, tolerance=1e-5)


@pytest.mark.parametrize("name", MACRO_ENVS)
def test_in_a_batched_env_it_keeps_the_contract_of_an_env(name: str) -> None:
    env = SerialEnv(2, MACRO_ENVS[name])
    check_env(env)
    env.close()


@pytest.mark.parametrize("name", MAZES)
def test_a_planner_plans_in_it_and_acts_in_it(name: str) -> None:
    env = MACRO_ENVS[name]()
    check_planner(MCTSPlanner(env, budget=SearchBudget(expansions=3)), env)


def test_processes_that_are_forked_do_the_same() -> None:
    check_parallel_env(MACRO_ENVS["waterworld"], start_methods=["fork"])


@pytest.mark.slow
@pytest.mark.parametrize("start_method", ["fork", "spawn"])
@pytest.mark.parametrize("name", MACRO_ENVS)
def test_processes_do_the_same_however_they_are_started(name: str, start_method: str) -> None:
    check_parallel_env(MACRO_ENVS[name], start_methods=[start_method])


REGISTERED = [name for name in gymnasium.registry if name.startswith("torchrl_hmcts/")]


@pytest.mark.parametrize("env_id", REGISTERED)
def test_what_is_registered_passes_gymnasiums_checker(env_id: str) -> None:
    env = gymnasium.make(env_id)
    check_gymnasium_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_three_envs_are_registered() -> None:
    assert len(REGISTERED) == 3


def test_an_emulator_keeps_the_contract_of_a_macro_env() -> None:
    pytest.importorskip("ale_py")
    from torchrl_hmcts.envs import AtariRAMEnv

    # The generator of the emulator belongs to no state, so without sticky actions.
    env = AtariRAMEnv("Pong", repeat_action_probability=0.0)
    check_macro_env(env, num_steps=4)
    env.close()
