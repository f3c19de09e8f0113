"""GridworldMazeEnv: moves by hand, state in the tensordict, TorchRL's contracts, bad input."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from torchrl_hmcts.envs import (
    GridworldMazeEnv,
    maze_from_text,
    maze_pool,
    shortest_path_lengths,
)
from torchrl_hmcts.envs.mazes.layouts import wall_centers

UP, DOWN, LEFT, RIGHT, NONE = range(5)
STATE_KEYS = {"player_tile", "target_tile", "maze_index", "step_count"}


def small_env(text: str = "P.#\n.#.\n..T", **kwargs):
    maze, player, target = maze_from_text(text)
    env = GridworldMazeEnv(maze[None], **kwargs)
    return env, env.make_state(0, player, target)


def play(env, td, actions):
    """The ("next") tensordicts of a list of actions."""
    steps = []
    for action in actions:
        td = step_mdp(env.step(td.set("action", torch.full(td.shape, action))))
        steps.append(td)
    return steps


class TestMoves:
    def test_next_tiles_of_a_3x3_maze_by_hand(self):
        # Tiles 0 1 2 / 3 4 5 / 6 7 8; walls at 2 and 4.
        env, _ = small_env()
        by_hand = {  # tile: up, down, left, right, none
            0: [0, 3, 0, 1, 0],
            1: [1, 1, 0, 1, 1],
            3: [0, 6, 3, 3, 3],
            5: [5, 8, 5, 5, 5],
            6: [3, 6, 6, 7, 6],
            7: [7, 7, 6, 8, 7],
            8: [5, 8, 7, 8, 8],
        }
        for tile, expected in by_hand.items():
            for action, tile_after in enumerate(expected):
                state = env.make_state(0, divmod(tile, 3), (2, 2))
                (after,) = play(env, state, [action])
                assert after["player_tile"] == tile_after, (tile, action)

    def test_the_target_ends_the_episode_with_reward_one(self):
        env, td = small_env()
        steps = [
            env.step(td.set("action", torch.tensor(action)))["next"]
            for td, action in [(td, DOWN), (env.make_state(0, (2, 1), (2, 2)), RIGHT)]
        ]
        assert [step["reward"].item() for step in steps] == [0.0, 1.0]
        assert [step["terminated"].item() for step in steps] == [False, True]
        assert [step["done"].item() for step in steps] == [False, True]
        assert not steps[1]["truncated"]

    def test_staying_on_the_target_is_rewarded(self):
        env, _ = small_env()
        td = env.make_state(0, (2, 2), (2, 2)).set("action", torch.tensor(NONE))
        assert env.step(td)["next", "reward"] == 1

    def test_episode_is_truncated_at_the_time_limit(self):
        env, td = small_env(max_steps=2)
        first = env.step(td.set("action", torch.tensor(NONE)))
        second = env.step(step_mdp(first).set("action", torch.tensor(NONE)))
        assert not first["next", "done"]
        assert second["next", "truncated"]
        assert second["next", "done"]
        assert not second["next", "terminated"]
        assert second["next", "step_count"] == 2

    def test_reaching_the_target_at_the_time_limit_is_both(self):
        env, td = small_env("P.T", max_steps=2)
        td = play(env, td, [RIGHT])[0]
        last = env.step(td.set("action", torch.tensor(RIGHT)))["next"]
        assert last["terminated"]
        assert last["truncated"]

    @pytest.mark.parametrize("index", range(5))
    def test_walking_the_shortest_path_solves_a_maze(self, index):
        env = GridworldMazeEnv(maze_pool("test"), seed=index)
        td = env.reset()
        maze = env.mazes[td["maze_index"]]
        (row, col), target = (divmod(td[key].item(), 9) for key in ("player_tile", "target_tile"))
        lengths = shortest_path_lengths(maze, target)
        moves = {UP: (-1, 0), DOWN: (1, 0), LEFT: (0, -1), RIGHT: (0, 1)}
        rewards = []
        while left := int(lengths[row, col]):
            after = {a: (row + r, col + c) for a, (r, c) in moves.items()}
            inside = {a: t for a, t in after.items() if 0 <= min(t) and max(t) < 9}
            action = next(a for a, t in inside.items() if lengths[t] == left - 1)
            (row, col) = after[action]
            td = env.step(td.set("action", torch.tensor(action)))["next"]
            rewards.append(td["reward"].item())
        assert rewards == [0.0] * (len(rewards) - 1) + [1.0]


class TestObservation:
    def test_entries_come_in_the_order_of_the_dissertation(self):
        _, td = small_env("P.#\n.#.\n..T")
        assert td["observation"].tolist() == [0.5, 0.5, 2.5, 2.5, 2.5, 0.5, 1.5, 1.5]

    def test_pool_mazes_have_66_entries(self):
        env = GridworldMazeEnv(maze_pool("test"))
        td = env.rollout(3)
        assert td["observation"].shape == (3, 66)
        walls = wall_centers(env.mazes[td["maze_index"]]).flatten(-2)
        assert torch.equal(td["observation"][:, 4:], walls)
        assert torch.equal(td["observation"][:, :2], td["position"])
        assert torch.equal(td["observation"][:, 2:4], td["target"])


class TestReset:
    def test_player_and_target_are_distinct_free_tiles_of_every_maze(self):
        env = GridworldMazeEnv(seed=0)
        td = env.reset(TensorDict(batch_size=[20_000]))
        walls = env.mazes.flatten(1)[td["maze_index"]]
        for key in ("player_tile", "target_tile"):
            assert not walls.gather(1, td[key][:, None]).any()
        assert (td["player_tile"] != td["target_tile"]).all()
        assert len(td["maze_index"].unique()) > 1990
        assert not td["step_count"].any()


class TestState:
    def test_state_from_positions_takes_the_tiles_that_hold_them(self):
        env, _ = small_env()
        td = env.state_from_positions(0, [[0.99, 1.0], [2.01, 2.99]], (1.2, 0.7), step_count=4)
        assert td["player_tile"].tolist() == [3, 8]
        assert td["target_tile"].tolist() == [1, 1]
        assert td["step_count"].tolist() == [[4], [4]]
        assert (env.reset(td.clone(), set_state=True) == td).all()

    def test_made_states_have_what_a_reset_has(self):
        env, td = small_env()
        assert set(td.keys()) == set(env.reset().keys())
        assert env.observation_spec.is_in(td.select(*env.observation_spec.keys()))


class TestBadInput:
    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("maze_index", 1, '"maze_index" = 1 is out of range.*0 to 0'),
            ("maze_index", -1, '"maze_index" = -1'),
            ("player_tile", 9, '"player_tile" = 9 is out of range.*0 to 8'),
            ("player_tile", 2, r'"player_tile" = 2, \(row, col\) = \(0, 2\), is a wall of maze 0'),
            ("target_tile", 4, '"target_tile" = 4.* is a wall'),
            ("step_count", [-3], '"step_count" = -3'),
            ("step_count", 3, r'"step_count" must be torch.int64 \[1\].*got torch.int64 \[\]'),
            ("player_tile", 0.0, '"player_tile" must be torch.int64.*float32'),
            ("position", [float("nan"), 0.5], '"position" = .*nan.* contradicts "player_tile"'),
            ("target", [0.5, 0.5], '"target" = .* contradicts "target_tile"'),
        ],
    )
    def test_bad_state_is_refused_with_its_value(self, key, value, message):
        env, td = small_env()
        with pytest.raises(ValueError, match=message):
            env.reset(td.set(key, torch.tensor(value)), set_state=True)

    @pytest.mark.parametrize(
        ("args", "message"),
        [
            ((0, (0, 3), (2, 2)), r"player tile .* = \[0, 3\] is outside the 3x3 maze"),
            ((0, (0, 0), (1, 1)), "target_tile.* is a wall"),
            ((0, (0.5, 0.5), (2, 2)), "player must be integers.*state_from_positions"),
            ((0, 3, (2, 2)), "player must be integers"),
            ((7, (0, 0), (2, 2)), '"maze_index" = 7'),
        ],
    )
    def test_make_state_refuses_what_is_no_state(self, args, message):
        env, _ = small_env()
        with pytest.raises(ValueError, match=message):
            env.make_state(*args)

    @pytest.mark.parametrize(
        ("position", "message"),
        [
            ((float("nan"), 1.0), "nan.* is not inside"),
            ((3.0, 1.0), "not inside the maze of 3 x 3"),
            ((-0.1, 1.0), "not inside"),
            ((2.5, 0.5), "is a wall"),
        ],
    )
    def test_state_from_positions_refuses_what_is_no_position(self, position, message):
        env, _ = small_env()
        with pytest.raises(ValueError, match=message):
            env.state_from_positions(0, position, (0.5, 0.5))
