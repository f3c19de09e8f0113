"""Every environment keeps TorchRL's and Gymnasium's contracts, in one process and in several."""

from __future__ import annotations

import functools
import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import pytest
import torch
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv

import torchrl_hmcts.envs
import torchrl_hmcts.modules
import torchrl_hmcts.testing
from torchrl_hmcts.envs import (
    AtariOptionPool,
    AtariRAMEnv,
    DeepMindLabEnv,
    GridworldMazeEnv,
    LabMazeEnv,
    MujocoBatch,
    OptionPool,
    RepeatActions,
    SettableGymEnv,
    StatelessSimulator,
    WaterworldMazeEnv,
)
from torchrl_hmcts.modules import (
    LandmarkEnv,
    OptionModel,
    OptionModelEnv,
    SkillActor,
    SkillPolicy,
)
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


HAS_ATARI = importlib.util.find_spec("ale_py") is not None
needs_atari = pytest.mark.skipif(not HAS_ATARI, reason="the games come with ale-py")
# The generator of the emulator belongs to no state, so without sticky actions.
ATARI_ENVS: dict[str, Callable[[], EnvBase]] = {
    "atari": functools.partial(AtariRAMEnv, "Pong", repeat_action_probability=0.0),
    "atari_pool": functools.partial(
        AtariOptionPool, "Pong", RepeatActions(3), max_steps=3, num_processes=0
    ),
    "atari_pool_of_processes": functools.partial(
        AtariOptionPool, "Pong", RepeatActions(3), max_steps=3, num_processes=2, record=True
    ),
}


def under_options(make_env: Callable[[], EnvBase], key: str) -> TransformedEnv:
    """The env under options of a small network that reads one entry."""
    env = make_env()
    size = env.full_observation_spec[key].shape[-1]
    with torch.random.fork_rng(devices=[]):  # the same network in every process
        torch.manual_seed(0)
        worker = SkillActor(size, env.action_spec, 3, in_keys=[key], hidden=(8,))
    return TransformedEnv(env, OptionTransform(SkillPolicy(worker, deterministic=True), 3, 4))


@pytest.mark.parametrize("name", MACRO_ENVS)
def test_an_env_keeps_the_contract_of_a_macro_env(name: str) -> None:
    """Specs, episodes that continue, seeds, partial resets and steps, states, batches."""
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


# In Python's own pool a process may start no other, so a pool of processes is in no ParallelEnv.
IN_PROCESSES = [*MACRO_ENVS, *(pytest.param(n, marks=needs_atari) for n in ("atari", "atari_pool"))]


@pytest.mark.slow
@pytest.mark.parametrize("start_method", ["fork", "spawn"])
@pytest.mark.parametrize("name", IN_PROCESSES)
def test_processes_do_the_same_however_they_are_started(name: str, start_method: str) -> None:
    check_parallel_env({**MACRO_ENVS, **ATARI_ENVS}[name], start_methods=[start_method])


@pytest.mark.slow
@pytest.mark.parametrize("start_method", ["fork", "spawn"])
def test_options_in_processes_do_the_same_however_they_are_started(start_method: str) -> None:
    make = functools.partial(under_options, MACRO_ENVS["waterworld"], MAZES["waterworld"][1])
    check_parallel_env(make, start_methods=[start_method])


REGISTERED = [name for name in gymnasium.registry if name.startswith("torchrl_hmcts/")]


@pytest.mark.parametrize("env_id", REGISTERED)
def test_what_is_registered_passes_gymnasiums_checker(env_id: str) -> None:
    env = gymnasium.make(env_id)
    check_gymnasium_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_three_envs_are_registered() -> None:
    assert len(REGISTERED) == 3


@needs_atari
@pytest.mark.parametrize("name", ATARI_ENVS)
def test_an_emulator_keeps_the_contract_of_a_macro_env(name: str) -> None:
    env = ATARI_ENVS[name]()
    check_macro_env(env, num_steps=4)
    env.close()


@needs_atari
@pytest.mark.parametrize("name", ATARI_ENVS)
def test_a_batched_env_of_emulators_keeps_the_contract_of_an_env(name: str) -> None:
    env = SerialEnv(2, ATARI_ENVS[name])
    check_env(env, num_steps=4)
    env.close()


@needs_atari
def test_with_sticky_actions_it_keeps_the_contract_of_an_env() -> None:
    env = AtariRAMEnv("Pong", repeat_action_probability=0.25)
    check_env(env, num_steps=4)
    env.close()


class GoesRight(nn.Module):
    """What an option model's network says of a chain: one place further, and never an end."""

    def __init__(self, out_features: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.tensor([1.0, 0.0, 2.0, -10.0]))

    def forward(self, state: torch.Tensor, option: torch.Tensor) -> torch.Tensor:
        return self.bias * torch.stack((option, *[torch.ones_like(option)] * 3), -1)


def learned_chain() -> OptionModelEnv:
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    env = TransformedEnv(ChainEnv(9), OptionTransform(worker, 2, 2))
    model = OptionModel(GoesRight, ["state", "option"], {"state": ()}, max_duration=2)
    return OptionModelEnv(model, env)


def test_an_env_of_a_learned_model_keeps_the_contract_of_a_macro_env() -> None:
    check_macro_env(learned_chain())


@pytest.fixture
def engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The stand-in for DeepMind Lab's module, importable in other processes too."""
    source = Path(__file__).parent / "lab_stand_in.py"
    (tmp_path / "deepmind_lab.py").write_text(source.read_text())
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("deepmind_lab", None)  # other tests want it missing


LAB = functools.partial(
    DeepMindLabEnv, level="nine", rows=9, columns=9, maze_seeds=[1, 2], max_frames=6
)


@pytest.mark.usefixtures("engine")
def test_the_adapter_of_an_engine_keeps_the_contract_of_an_env() -> None:
    check_env(LAB())


@pytest.mark.usefixtures("engine")
def test_a_batch_of_engines_keeps_the_contract_of_an_env() -> None:
    env = SerialEnv(2, LAB)
    check_env(env)
    env.close()


@pytest.mark.slow
@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("start_method", ["fork", "spawn"])
def test_engines_in_processes_do_the_same(start_method: str) -> None:
    check_parallel_env(LAB, start_methods=[start_method])


def test_no_env_that_is_exported_is_left_out() -> None:
    packages = (torchrl_hmcts.envs, torchrl_hmcts.modules, torchrl_hmcts.testing)
    exported = [getattr(package, n) for package in packages for n in package.__all__]
    envs = {c for c in exported if isinstance(c, type) and issubclass(c, EnvBase)}
    made = [*MACRO_ENVS.values(), *ATARI_ENVS.values(), LAB]
    covered = {make.func if isinstance(make, functools.partial) else make for make in made}
    own_tests = {
        LandmarkEnv,
        OptionModelEnv,
        OptionPool,
        StatelessSimulator,
        SettableGymEnv,
        MujocoBatch,
    }
    assert envs == covered | own_tests
