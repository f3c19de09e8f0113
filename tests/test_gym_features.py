"""MiniGrid: features that are pairs with the pose, options that turn and go, and plans of them."""

from __future__ import annotations

import pickle
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip("minigrid")
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Ball, Box, Door, Key
from minigrid.minigrid_env import MiniGridEnv

from torchrl_hmcts.envs import GridFeatures, GridMoves, GridView, OptionPool, SettableGymEnv
from torchrl_hmcts.envs.gym.features import features_of
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.envs.gym.snapshots import SnapshotError
from torchrl_hmcts.planners import MCTSPlanner, SearchBudget, WidthNovelty

LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE, DONE = range(7)
CARRIED, DOOR, KEY, BALL, BOX, THERE, TOGETHER = 0, 1, 13 + 4, 19, 25 + 2, 31, 32
POSES = 5 * 24 + 1


class Hand(MiniGridEnv):
    """Six columns, four rows: the agent (7, facing right), a key below it (13), ball and door.

    ::

        W W W W W W
        W > . B D W      a red ball beside a locked yellow door
        W K X . W W      a yellow key, a blue box that hides a yellow key
        W W W W W W
    """

    def __init__(self) -> None:
        space = MissionSpace(mission_func=lambda: "none")
        super().__init__(mission_space=space, width=6, height=4, max_steps=50)

    def _gen_grid(self, width: int, height: int) -> None:
        self.grid = Grid(width, height)
        self.grid.wall_rect(0, 0, width, height)
        self.put_obj(Key("yellow"), 1, 2)
        self.put_obj(Box("blue", Key("yellow")), 2, 2)
        self.put_obj(Ball("red"), 3, 1)
        self.put_obj(Door("yellow", is_locked=True), 4, 1)
        self.agent_pos, self.agent_dir = (1, 1), 0
        self.mission = "none"


def hand() -> MiniGridEnv:
    env = Hand()
    env.reset(seed=0)
    return env


def pairs(vector: np.ndarray) -> dict[int, tuple[int, int]]:
    """Pose and variable of the columns before the hashes that hold something."""
    return {f: (int(n) % POSES, int(n) // POSES) for f, n in enumerate(vector[:TOGETHER]) if n}


def test_the_vector_of_a_grid_is_what_a_hand_computes() -> None:
    vector = GridFeatures()(hand(), None)
    pose = 5 * 7 + 2  # cell 7, direction 0
    locked_beside_one, hidden = 1 + 2 + 3, 4096
    assert pairs(vector) == {
        CARRIED: (pose, 0),
        DOOR: (pose, locked_beside_one),
        KEY: (pose, 1 + hidden),
        BALL: (pose, 1),
        BOX: (pose, 1),
        THERE: (pose, 4),
    }
    doors, kinds = [locked_beside_one] + [0] * 11, [0] * 18
    kinds[4], kinds[6], kinds[14] = 1 + hidden, 1, 1
    assert vector[TOGETHER] == hash((pose, 0, 4, *doors, *kinds))
    places = {f: int(n) for f, n in enumerate(vector[TOGETHER + 1 :]) if n}
    assert places == {4: hash((pose, 13)), 6: hash((pose, 9)), 14: hash((pose, 14))}
    assert vector.dtype == np.int64
    assert vector.shape == (GridFeatures.width,) == (51,)
    assert GridFeatures.stages == (32, 33)


def test_a_pose_has_a_direction_only_before_things_if_options_turn_by_themselves() -> None:
    env, features = hand(), GridFeatures(directed=False)
    free, down, above_box = 5 * 7 + 1, 5 * 7 + 2 + 1, 5 * 8 + 2 + 1
    seen = [features(env, None)]
    for action in (RIGHT, LEFT, FORWARD, RIGHT):
        env.step(action)
        seen.append(features(env, None))
    assert [pairs(vector)[CARRIED][0] for vector in seen] == [
        free,
        down,
        free,
        5 * 8 + 2,
        above_box,
    ]  # fmt: skip  the ball is in front in the fourth
    assert (seen[0] == seen[2]).all()


def test_what_is_carried_dropped_and_hidden_changes_its_columns() -> None:
    env, features = hand(), GridFeatures()
    for action in (RIGHT, PICKUP):
        env.step(action)
    taken = pairs(features(env, None))
    assert taken[CARRIED][1] == 1 + 4  # a yellow key
    assert (taken[KEY][1], taken[THERE][1]) == (4096, 3)
    for action in (LEFT, DROP):
        env.step(action)
    assert pairs(features(env, None))[KEY][1] == 64 + 4096  # one lies elsewhere
    for action in (PICKUP, RIGHT, DROP):
        env.step(action)
    assert pairs(features(env, None))[KEY][1] == 1 + 4096  # it is back
    for action in (LEFT, FORWARD, RIGHT, TOGGLE):
        env.step(action)
    opened = pairs(features(env, None))
    assert (opened[KEY][1], opened[THERE][1]) == (2, 4)  # two keys, no box
    assert BOX not in opened
    for action in (LEFT, PICKUP):
        env.step(action)
    assert pairs(features(env, None))[DOOR][1] == 1 + 2  # locked, nothing beside it


def test_parts_of_a_mission_that_are_done_are_seen() -> None:
    env = make_gym("BabyAI-BossLevel-v0")
    features = GridFeatures()
    for seed in range(20):
        env.reset(seed=seed)
        mission = env.unwrapped.instrs
        if hasattr(mission, "instr_a"):
            break
    before = features(env, None)
    mission.a_done = "success"
    after = features(env, None)
    assert (before != after).nonzero()[0].tolist() == [THERE, TOGETHER]
    poses = 5 * len(env.unwrapped.grid.grid) + 1
    assert int(after[THERE]) // poses - int(before[THERE]) // poses == 256


@pytest.mark.parametrize("name", ["MiniGrid-ObstructedMaze-1Dlhb-v0", "BabyAI-BossLevel-v0"])
def test_equal_states_have_equal_vectors_and_rows_fit_the_env_with_pictures(name: str) -> None:
    view = SettableGymEnv(partial(viewed, name), features=GridFeatures(), seed=0)
    real = SettableGymEnv(name, features=GridFeatures(), seed=1)
    draws = np.random.default_rng(0)
    td, real_td = view.reset(), real.reset()
    for _ in range(40):
        here = td.select("snapshot", "features")
        real_td = real.reset(real_td.update(here), set_state=True)
        action = torch.tensor(int(draws.integers(7)))
        td = view.step(td.set("action", action))["next"]
        after = real.step(real_td.set("action", action))["next"]
        for key in ("features", "reward", "done", "direction"):
            assert after[key].equal(td[key].to(after[key].dtype)), key
        td, real_td = td.exclude("reward"), after.exclude("reward")
        view.reset(td, set_state=True)
        assert GridFeatures()(view._env, None).tolist() == td["features"].tolist()
        if td["done"]:
            break


def pool_env(pool: Any) -> Any:
    return pool._run.env.unwrapped


def viewed(name: str, moves: bool = True) -> gymnasium.Env:
    return GridView(make_gym(name), moves=moves)


@pytest.mark.parametrize("name", ["MiniGrid-BlockedUnlockPickup-v0", "MiniGrid-FourRooms-v0"])
def test_options_that_the_mask_forbids_change_nothing_but_the_direction(name: str) -> None:
    keywords: dict[str, Any] = {"max_steps": 3, "num_processes": 0, "seed": 0}
    keywords["features"] = GridFeatures(directed=False)
    view = OptionPool(partial(viewed, name), GridMoves(), **keywords)
    real = OptionPool(name, GridMoves(), **keywords)
    draws = np.random.default_rng(0)
    td, real_td = view.reset(), real.reset()
    seen = set()
    for _ in range(60):
        options = torch.arange(8)
        both = [
            pool.step(start.expand(8).clone().set("option", options))["next"]
            for pool, start in ((view, td), (real, real_td))
        ]
        for key in ("features", "reward", "duration", "done"):
            assert both[0][key].equal(both[1][key]), key
        forbidden = ~td["action_mask"]
        poses = 5 * len(pool_env(view).grid.grid) + 1
        single = [part["features"][..., :TOGETHER] for part in (both[0][forbidden], td)]
        assert (single[0] // poses == single[1] // poses).all()
        cells = [(part[..., THERE] % poses - 1) // 5 for part in single]
        assert (cells[0] == cells[1]).all()
        assert not both[0]["reward"][forbidden].any()
        assert not both[0]["done"][forbidden].any()
        changed = (both[0]["features"] != td["features"]).any(-1)
        assert changed[:4][~forbidden[:4]].all()  # to go always leads somewhere, or turns
        seen |= set(changed.nonzero().flatten().tolist())
        option = int(draws.choice(td["action_mask"].numpy().nonzero()[0]))
        td, real_td = (part[option].exclude("reward") for part in both)
        if td["done"]:
            break
    assert seen >= {0, 1, 2, 3}


def test_to_go_is_to_turn_and_to_step_unless_something_is_in_the_way() -> None:
    pool = OptionPool(Hand, GridMoves(), max_steps=3, num_processes=0, seed=0)
    after = pool.step(pool.reset().expand(8).clone().set("option", torch.arange(8)))["next"]
    # right: one step; down: one turn, the key is in the way; left: two turns, a wall; up: one turn
    assert after["duration"].flatten().tolist() == [1, 1, 2, 1, 1, 1, 1, 1]
    assert after["direction"].tolist() == [0, 1, 2, 3, 0, 0, 0, 0]
    env = GridView(Hand())
    mask = env.reset(seed=0)[0]["action_mask"]
    assert mask.tolist() == [True, True, False, False, False, False, False, False]
    env.step(RIGHT)
    assert env.step(DONE)[0]["action_mask"].tolist() == [True, False, False, False] + [
        True,
        False,
        True,
        True,
    ]  # fmt: skip  the key: pick up, no drop, toggle, done
    actions = GridView(Hand(), moves=False).reset(seed=0)[0]["action_mask"]
    assert actions.tolist() == [True, True, True, False, False, False, False]


def test_a_plan_opens_the_door_and_pays_in_the_env_with_pictures() -> None:
    name, keywords = "MiniGrid-DoorKey-6x6-v0", {"max_steps": 3, "num_processes": 0, "seed": 3}
    features = features_of(viewed(name))
    pool = OptionPool(partial(viewed, name), GridMoves(), features=features, **keywords)
    novelty = WidthNovelty("features", stages=features.stages)
    planner = MCTSPlanner(pool, novelty=novelty, budget=SearchBudget(base_steps=3_000), seed=0)
    plan = planner.plan(pool.reset())
    assert plan.found
    real = OptionPool(name, GridMoves(), **keywords)
    td = real.reset()
    for option in plan.options[: int(plan.lengths)]:
        td = real.step(td.set("option", option))["next"]
        paid = td["reward"].item()
        td = td.exclude("reward")
    assert paid > 0.0
    assert td["done"]


def test_features_suit_the_options_and_can_be_sent() -> None:
    name = "MiniGrid-Empty-5x5-v0"
    assert repr(features_of(make_gym(name))) == "GridFeatures(directed=True)"
    assert repr(features_of(viewed(name))) == "GridFeatures(directed=False)"
    assert repr(features_of(viewed(name, False))) == "GridFeatures(directed=True)"
    features = GridFeatures(directed=False)
    features(hand(), None)
    assert repr(pickle.loads(pickle.dumps(features))) == repr(features)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(SnapshotError, match="GridView is for MiniGrid.*got.*CartPole"):
        GridView(gymnasium.make("CartPole-v1"))
    with pytest.raises(ValueError, match="num_actions from 3 to 7; got 9"):
        GridMoves(9)
    with pytest.raises(ValueError, match="reads the direction in MiniGrid's own observation"):
        OptionPool("CartPole-v1", GridMoves(), max_steps=3, num_processes=0)
