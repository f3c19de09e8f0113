"""MujocoBatch: batches of MuJoCo envs, equal to Gymnasium's, for training and planning."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.envs import MujocoBatch, SnapshotError
from torchrl_hmcts.envs.gym.families import snapshot_of
from torchrl_hmcts.envs.gym.mujoco import find_physics, repr_of
from torchrl_hmcts.envs.gym.quick import quick_step
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.envs.gym.task import look_at
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty
from torchrl_hmcts.transforms import OptionTransform

pytest.importorskip("gymnasium_robotics", exc_type=ImportError)
pytest.importorskip("ogbench", exc_type=ImportError)
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]
MAZES = ["PointMaze_UMaze-v3", "AntMaze_UMaze-v5", "pointmaze-medium-v0", "antmaze-medium-v0"]


@pytest.mark.parametrize("name", MAZES)
def test_it_steps_observes_rewards_and_ends_as_the_gymnasium_env_to_the_bit(name: str) -> None:
    # To the bit, since the state holds the solver's warm start and each row is stepped by mj_step.
    keywords = {"continuing_task": False} if "Maze_" in name else {}
    batch, env = (
        MujocoBatch(name, dtype=torch.float64, seed=0, **keywords),
        make_gym(name, **keywords),
    )
    env.action_space.seed(0)
    reached = 0
    for seed in range(2):
        env.reset(seed=seed)
        td = batch.read(env)
        if seed:  # beside its goal, which it meets
            goal = td["position"].numpy() + 0.3
            _set_goal(env, goal)
            td = batch.read(env)
        for _ in range(60):
            action = env.action_space.sample()
            observation, reward, terminated, _, _ = env.step(action)
            td = batch.step(td.set("action", torch.tensor(action, dtype=torch.float64)))["next"]
            if not isinstance(observation, dict):
                observation = {"observation": observation}
            for key, value in observation.items():
                assert np.array_equal(td[key].numpy(), value), key
            assert (td["reward"].item(), td["terminated"].item()) == (reward, terminated)
            reached += terminated
            if terminated:
                break
    assert reached == 1


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        ("PointMaze_UMaze-v3", {"continuing_task": False}),
        ("PointMaze_UMaze-v3", {"reward_type": "dense"}),
        ("pointmaze-medium-v0", {}),
    ],
)
def test_a_quick_step_is_that_of_the_env_to_the_bit(name: str, keywords: dict[str, Any]) -> None:
    env, other = (look_at(name, **keywords).task(make_gym(name, **keywords)) for _ in range(2))
    snapshots, step = [snapshot_of(env), snapshot_of(other)], quick_step(other)
    env.action_space.seed(0)
    ended = touched = 0
    for seed in range(2):
        for each in (env, other):
            each.reset(seed=seed)  # at first far from the goal, then beside it
            place = find_physics(each)[1].qpos
            _set_goal(each, place + (0.5 if seed else 50.0))
        for number in range(120):
            if number % 12 == 0:  # long enough to meet a wall
                action = np.ones(2, np.float32) if seed else env.action_space.sample()
            wanted, got = env.step(action), step(action)
            assert repr_of(got) == repr_of(wanted)
            ended += wanted[2]
            touched += find_physics(env)[1].ncon > 1  # it stands on the floor
            for snapshot in snapshots:
                snapshot.note_step(action)
            physics = [s.read()[: 8 * s._numbers] for s in snapshots]
            assert np.array_equal(*physics)
            if wanted[2]:
                break
    assert ended
    assert touched


def test_no_quick_step_where_a_wrapper_or_the_env_is_not_known() -> None:
    for name in ("CartPole-v1", "AntMaze_UMaze-v5", "pointmaze-teleport-v0"):
        assert quick_step(make_gym(name)) is None
    known = make_gym("PointMaze_UMaze-v3")
    assert quick_step(known) is not None
    assert quick_step(gymnasium.wrappers.ClipAction(known)) is None


def _set_goal(env: Any, goal: np.ndarray) -> None:
    if hasattr(env.unwrapped, "set_goal"):
        env.unwrapped.set_goal(goal_xy=goal)
    else:
        env.unwrapped.goal = goal


@pytest.mark.parametrize("name", MAZES[1:3])
def test_a_row_depends_on_nothing_but_its_own_state(name: str) -> None:
    batch = MujocoBatch(name, batch_size=[5], seed=0)
    check_env_specs(batch)
    td = batch.rollout(8)[:, -1].clone()
    threads = MujocoBatch(name, num_threads=2, batch_size=[5], seed=7)
    alone = MujocoBatch(name, seed=1)
    together = batch.step(td)["next", "physics"]
    assert torch.equal(threads.step(td)["next", "physics"], together)
    one = alone.reset(td[3].select("physics", "goal"), set_state=True)
    assert torch.equal(one["position"], td[3]["position"])
    one = alone.step(one.set("action", td[3]["action"]))
    assert torch.equal(one["next", "physics"], together[3])


def test_starts_repeat_with_the_seed_and_differ_from_each_other() -> None:
    starts = [
        MujocoBatch("PointMaze_Large-v3", batch_size=[3], seed=s).reset()["position"]
        for s in (0, 0, 1)
    ]
    assert torch.equal(starts[0], starts[1])
    assert not torch.equal(starts[0], starts[2])
    assert len(starts[0].unique(dim=0)) == 3


def test_a_plan_in_the_batch_reaches_the_goal_of_the_gymnasium_env() -> None:
    name, steps = "pointmaze-medium-v0", 10
    moves = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    worker = TensorDictModule(lambda skill: moves[skill], ["skill"], ["action"])
    env = TransformedEnv(MujocoBatch(name, seed=0), OptionTransform(worker, 4, steps))
    real = make_gym(name)
    real.reset(seed=1, options={"task_id": 3})
    start = env.base_env.read(real)
    plan = MCTSPlanner(env, novelty=RadiusNovelty("position", 1.0)).plan(start)
    assert bool(plan.found)
    ended = False
    for option in plan.options[: int(plan.lengths)]:
        for _ in range(steps):
            if not ended:
                ended = real.step(moves[option].numpy())[2]
    assert ended


def test_what_is_no_function_of_the_state_is_refused_and_told() -> None:
    with pytest.raises(SnapshotError, match="knows the point and ant mazes.*task="):
        MujocoBatch("Hopper-v5")
    with pytest.raises(SnapshotError, match="reset_target=False"):
        MujocoBatch("PointMaze_UMaze-v3", reset_target=True)
    with pytest.raises(SnapshotError, match="SettableGymEnv all"):
        MujocoBatch("pointmaze-teleport-v0")
    with pytest.raises(ValueError, match="num_threads"):
        MujocoBatch("PointMaze_UMaze-v3", num_threads=0)
    batch = MujocoBatch("PointMaze_UMaze-v3")
    state = batch.reset()
    with pytest.raises(SnapshotError, match=r"'physics', float64 \[\*B, 7\]; got torch.float32"):
        batch.reset(state.set("physics", state["physics"].float()), set_state=True)
    with pytest.raises(SnapshotError, match="got nothing"):
        batch.reset(state.exclude("physics"), set_state=True)
    with pytest.raises(SnapshotError, match="another MuJoCo model"):
        batch.read(make_gym("antmaze-medium-v0"))
