"""Gymnasium envs that are set to a state: every family, to the bit, and what cannot be stored."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.envs import AttributeSnapshot, ReplaySnapshot, SettableGymEnv, SnapshotError
from torchrl_hmcts.envs.gym.families import snapshot_of
from torchrl_hmcts.envs.gym.marks import (
    generator_memory,
    generator_state,
    set_generator_state,
)
from torchrl_hmcts.envs.gym.settable import PrivateRandom, make_gym
from torchrl_hmcts.planners import MCTSPlanner, SearchBudget
from torchrl_hmcts.testing import ContractError, check_settable

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]
FAMILIES = [
    ("CartPole-v1", "ClassicSnapshot", None, {}),
    ("Pendulum-v1", "ClassicSnapshot", None, {}),
    ("MountainCar-v0", "ClassicSnapshot", None, {}),
    ("MountainCarContinuous-v0", "ClassicSnapshot", None, {}),
    ("Acrobot-v1", "ClassicSnapshot", None, {}),
    ("FrozenLake-v1", "ToyTextSnapshot", None, {}),  # slips: its generator is part of the state
    ("Taxi-v4", "ToyTextSnapshot", None, {}),
    ("Blackjack-v1", "ToyTextSnapshot", None, {}),  # observes a tuple
    ("LunarLander-v3", "Box2DSnapshot", "Box2D", {}),
    ("BipedalWalker-v3", "Box2DSnapshot", "Box2D", {}),  # keeps one world for all its episodes
    ("MiniGrid-KeyCorridorS3R3-v0", "MiniGridSnapshot", "minigrid", {}),
    ("MiniGrid-Dynamic-Obstacles-6x6-v0", "MiniGridSnapshot", "minigrid", {}),
    ("BabyAI-GoToLocal-v0", "MiniGridSnapshot", "minigrid", {}),
    ("HalfCheetah-v5", "MujocoSnapshot", "mujoco", {}),
    ("Ant-v5", "MujocoSnapshot", "mujoco", {}),  # its reward reads where the body was before
    ("PointMaze_UMaze-v3", "MujocoSnapshot", "gymnasium_robotics", {}),
    ("pointmaze-teleport-v0", "MujocoSnapshot", "ogbench", {}),  # draws from np.random
    (
        "ALE/Breakout-v5",
        "ALESnapshot",
        "ale_py",
        {"repeat_action_probability": 0.0, "obs_type": "ram"},
    ),
]


@pytest.mark.parametrize(("name", "kind", "package", "keywords"), FAMILIES)
def test_steps_after_a_restored_state_are_those_of_the_unbroken_run(
    name: str, kind: str, package: str | None, keywords: dict[str, Any]
) -> None:
    if package is not None:
        pytest.importorskip(package, exc_type=ImportError)
    make = functools.partial(SettableGymEnv, name, **keywords)
    env = make(seed=0)
    assert kind in repr(env)
    check_env_specs(env)
    check_settable(make, num_states=6, num_steps=40, other_process=False)


def test_a_row_fits_another_process() -> None:
    make = functools.partial(SettableGymEnv, "FrozenLake-v1")
    check_settable(make, num_states=3, num_steps=20)


def test_the_time_limit_counts_from_the_restored_step() -> None:
    env = SettableGymEnv("CartPole-v1", max_episode_steps=5, seed=0)
    td = env.reset()
    for _ in range(3):
        td = env.step(td.set("action", torch.tensor(0)))["next"].exclude("reward")
    row = td.clone()
    env.reset()
    td = env.reset(row, set_state=True)
    ends = []
    for _ in range(2):
        td = env.step(td.set("action", torch.tensor(1)))["next"].exclude("reward")
        ends.append(bool(td["truncated"]))
    assert ends == [False, True]


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
def test_replaying_reaches_a_state_as_its_bytes_do(name: str) -> None:
    make = functools.partial(SettableGymEnv, name, snapshot=ReplaySnapshot)
    assert "ReplaySnapshot" in repr(make())
    check_settable(make, num_states=4, num_steps=20, other_process=False, unread_keys=())


def test_a_state_is_stored_by_two_functions_of_the_user() -> None:
    def read(env: gymnasium.Env) -> bytes:
        return np.asarray(env.unwrapped.state, np.float64).tobytes()  # type: ignore[attr-defined]

    def restore(env: gymnasium.Env, row: np.ndarray) -> None:
        env.unwrapped.state = row.view(np.float64).copy()  # type: ignore[attr-defined]

    env = SettableGymEnv("Acrobot-v1", snapshot=(read, restore), seed=0)
    assert env.snapshot.width == 4 * 8
    start = env.reset()
    first = env.step(start.clone().set("action", torch.tensor(2)))["next", "observation"]
    env.reset(start, set_state=True)
    again = env.step(start.clone().set("action", torch.tensor(2)))["next", "observation"]
    assert torch.equal(first, again)


class Drifting(gymnasium.Env):
    """Forgets nothing, but draws each step from a generator that no seed reaches."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, hidden: Any = None) -> None:
        self.hidden = hidden
        self.x = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = 0.0
        return np.array([self.x]), {}

    def step(self, action: int) -> Any:
        self.x += action + (next(self.hidden) if self.hidden is not None else 0.0)
        return np.array([self.x]), 0.0, False, self.x > 20, {}


def test_an_env_that_is_not_deterministic_is_told_from_one_whose_state_is_not_stored() -> None:
    class Device(gymnasium.Wrapper):
        def step(self, action: int) -> Any:
            observation, *rest = self.env.step(action)
            return observation + np.random.default_rng().normal(), *rest

    make = functools.partial(SettableGymEnv, lambda: Device(Drifting()))
    with pytest.raises(ContractError, match="not deterministic.*chance"):
        check_settable(make, num_states=2, num_steps=5, other_process=False)
    counted = [0]

    def slip(observation: np.ndarray) -> np.ndarray:
        counted[0] += 1
        return observation + counted[0] % 3

    def make_leaky() -> SettableGymEnv:
        counted[0] = 0
        wrapper = gymnasium.wrappers.TransformObservation
        return SettableGymEnv(lambda: wrapper(Drifting(), slip, None))

    with pytest.raises(ContractError, match="in the same instance"):
        check_settable(make_leaky, num_states=4, num_steps=7, other_process=False)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: SettableGymEnv("CartPol-v1"), ValueError, "Nearest: CartPole-v1"),
        (lambda: SettableGymEnv(3), TypeError, "got 3"),
        (lambda: SettableGymEnv(lambda: "CartPole-v1"), TypeError, "got 'CartPole-v1'"),
        (lambda: SettableGymEnv("FrozenLake-v1", cap=64), SnapshotError, r"cap=64\..*larger cap"),
        (
            lambda: SettableGymEnv(lambda: Drifting(x for x in iter(int, 1))),
            SnapshotError,
            r"Drifting\.hidden is a generator.*snapshot=",
        ),
        (
            lambda: snapshot_of(gymnasium.make("CartPole-v1"), "mujoco"),
            TypeError,
            r"\(read, restore\)",
        ),
    ],
)
def test_what_cannot_be_set_is_refused_with_the_way_out(make: Any, error: Any, words: str) -> None:
    with pytest.raises(error, match=words):
        make()


def test_sticky_atari_is_refused_since_the_held_action_is_hidden() -> None:
    pytest.importorskip("ale_py")
    with pytest.raises(SnapshotError, match="sticky.*AtariRAMEnv"):
        SettableGymEnv("ALE/Pong-v5")


def test_global_generators_are_as_they_were_after_a_step() -> None:
    class Global(Drifting):
        def step(self, action: int) -> Any:
            self.x += np.random.random()
            return np.array([self.x]), 0.0, False, False, {}

    env = SettableGymEnv(Global, seed=0)
    assert isinstance(env._env, PrivateRandom)
    np.random.seed(7)
    run = env.rollout(4)
    drawn = np.random.random()
    np.random.seed(7)
    assert drawn == np.random.random()
    td = env.reset(run[1].exclude("next", "action"), set_state=True)
    after = env.step(td.set("action", run[1]["action"]))["next", "observation"]
    assert torch.equal(after, run[1]["next", "observation"])


def test_the_same_seed_gives_the_same_episodes() -> None:
    one, other = (SettableGymEnv("CartPole-v1", seed=3) for _ in range(2))
    starts = [env.reset()["observation"] for env in (one, other)]
    assert torch.equal(*starts)
    assert not torch.equal(starts[0], one.reset()["observation"])


def test_a_planner_finds_the_way_over_the_ice_and_leaves_the_real_env_alone() -> None:
    make = functools.partial(SettableGymEnv, "FrozenLake-v1", is_slippery=False)
    real = make(seed=0)
    planner = MCTSPlanner(make(), budget=SearchBudget(expansions=2_000), seed=0)
    plan = planner.plan(real.reset())
    assert bool(plan.found)
    assert int(plan.lengths) >= 6  # 3 steps down and 3 to the right
    td = real.reset()
    for action in plan.options[: int(plan.lengths)]:
        td = real.step(td.set("action", action))["next"].exclude("reward")
    assert bool(td["terminated"])
    assert int(td["observation"]) == 15


def test_attributes_that_the_restored_state_lacks_are_removed() -> None:
    env = gymnasium.make("FrozenLake-v1")
    snapshot = AttributeSnapshot(env)
    env.reset(seed=1)
    row = snapshot.read()
    env.step(0)
    env.unwrapped.later = [1, 2]  # type: ignore[attr-defined]
    snapshot.note_step(0)
    snapshot.restore(row)
    assert not hasattr(env.unwrapped, "later")


class Malicious:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def __reduce__(self) -> Any:
        return os.mkdir, (self.folder,)


def test_a_row_that_somebody_else_wrote_executes_nothing(tmp_path: Path) -> None:
    env = gymnasium.make("CartPole-v1")
    snapshot = AttributeSnapshot(env)
    env.unwrapped.x_threshold = Malicious(str(tmp_path / "made"))  # type: ignore[attr-defined]
    snapshot.note_step(0)
    row = snapshot.read()
    snapshot.note_step(0)
    with pytest.raises(SnapshotError, match="mkdir, which is no class of this env"):
        snapshot.restore(row)
    assert not (tmp_path / "made").exists()


def test_a_mujoco_row_follows_every_change_of_an_attribute():
    pytest.importorskip("gymnasium_robotics")
    env = make_gym("PointMaze_Large-v3")
    snapshot = snapshot_of(env)
    env.reset(seed=0)
    inner = env.unwrapped
    goal = inner.goal
    changes = [
        ("weight", 0.0), ("weight", -0.0), ("weight", False), ("weight", 0),
        ("goal", goal.astype(np.float32)), ("goal", np.stack([goal])), ("reset_pos", goal),
    ]  # fmt: skip
    for name, value in changes:
        row = snapshot.read()
        before = vars(inner).get(name)
        setattr(inner, name, value)
        snapshot.note_step(None)
        changed = snapshot.read()
        assert (changed != row).any(), (name, value)
        snapshot.restore(row)
        assert repr(vars(inner).get(name)) == repr(before)
        snapshot.note_step(None)
        snapshot.restore(changed)
        assert repr(vars(inner)[name]) == repr(value)


def test_attributes_that_are_changed_in_place_are_noticed_and_restored() -> None:
    class Held:
        def __init__(self) -> None:
            self.counts = {"left": [0, 0.0], "grid": np.zeros((2, 2))}

    class Changing(Drifting):
        def __init__(self) -> None:
            super().__init__()
            self.held, self.shared = Held(), [np.arange(3)]
            self.again = self.shared[0]

    env = Changing()
    snapshot = AttributeSnapshot(env)
    row = snapshot.read()
    counts = env.held.counts
    for change in (
        lambda: counts["left"].__setitem__(1, -0.0),
        lambda: counts["left"].__setitem__(0, False),
        lambda: counts["grid"].__setitem__((0, 1), 2.0),
        lambda: env.shared.__setitem__(0, np.arange(3)),  # no longer the one of ``again``
        lambda: vars(env.held).update(amounts=vars(env.held).pop("counts")),  # another name
        lambda: env.reset(seed=5),  # another state of the generator
        lambda: env.np_random.random(),
    ):
        snapshot.note_step(None)
        before = snapshot.read()
        change()
        snapshot.note_step(None)
        assert (snapshot.read() != before).any()
    snapshot.restore(row)
    assert repr(env.held.counts) == repr({"left": [0, 0.0], "grid": np.zeros((2, 2))})
    assert env.shared[0] is env.again
    snapshot.note_step(None)
    assert (snapshot.read() == row).all()


def test_the_memory_of_a_generator_is_its_state() -> None:
    one, other = (np.random.default_rng(seed) for seed in (1, 2))
    memory = generator_memory(other)
    if memory is None:  # a NumPy that keeps it elsewhere
        return
    one.integers(3, dtype=np.int32)  # half a number is left
    state = generator_state(one)
    memory[0][:], memory[1][:] = state[:32], state[32:]
    assert (one.integers(9, size=9) == other.integers(9, size=9)).all()
    set_generator_state(other, state)
    assert bytes(memory[0]) + bytes(memory[1]) == state
    assert generator_memory(np.random.Generator(np.random.MT19937(0))) is None


@pytest.mark.parametrize("kind", [tuple, np.array])
def test_minigrid_keeps_the_types_of_the_agents_place(kind: Any) -> None:
    pytest.importorskip("minigrid")
    env = make_gym("MiniGrid-Empty-5x5-v0")
    snapshot = snapshot_of(env)
    snapshot.note_reset(0)
    env.reset(seed=0)
    inner = env.unwrapped
    inner.agent_pos = kind((np.int64(2), 3))
    row = snapshot.read()
    inner.agent_pos, inner.agent_dir, inner.step_count = (1, 1), 2, 7
    snapshot.note_step(None)
    snapshot.restore(row)
    assert repr(inner.agent_pos) == repr(kind((np.int64(2), 3)))
    assert (inner.agent_dir, inner.step_count) == (0, 0)
    inner.agent_pos = (1.5, 1)
    with pytest.raises(SnapshotError, match=r"\(1\.5, 1\).*not whole numbers"):
        snapshot.read()


def test_making_a_maze_does_not_print_the_news_of_other_envs() -> None:
    pytest.importorskip("gymnasium_robotics")
    code = "from torchrl_hmcts.envs.gym.settable import make_gym; make_gym('PointMaze_UMaze-v3')"
    command = [sys.executable, "-W", "ignore", "-c", code]
    ran = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert "Adroit" not in ran.stdout + ran.stderr
